"""Are many cameras, their lens and the light found together, from a picture by each camera?

    python experiments/fit_rig.py
    python experiments/fit_rig.py --views 100 --devices 2

Cameras stand on a dome round the teapot. Each starts turned by up to 4 degrees, shifted by up to
5 % of the picture's height and up to 4 % too near or too far; the angle of view, which they have in
common, starts 5 % too wide, the light 15 degrees off and too dark. All is fitted at once by
Levenberg-Marquardt steps, coarse to fine. What a view says of its own six parameters and of the six
that all have in common, `JᵀJ` and `Jᵀr`, is summed up on the device that draws it, so what leaves a
device does not grow with the picture; the system of all views is then solved camera by camera
(Schur's complement), in time proportional to their number.

Views are drawn on all cores, or split over the first `--devices` devices (on the CPU so many are
made of it); the numbers found are the same to the bit. After each step the state is written to
`--out`: work that was interrupted goes on there.

Expected: for 24 cameras at 96 x 96 all within 0.06 degrees, angle of view and light within 0.02
degrees, in two to three minutes on two cores. Written to `--out`: `fit_rig.json`, and
`fit_rig.png` with some views and the errors of all cameras.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import (
    View,
    check_same,
    progress_bar,
    pyplot,
    render_view,
    save_json,
    save_whole,
    show_fit,
)
from jax import Array
from parameters import Start, appearance_of, camera_errors, moved_camera, start_of, view_errors

import diffrast as dr

OWN = 6  # parameters of a camera: all of `parameters.moved_camera` but the lens
LEVELS = ((4.0, 4), (1.0, 16))  # blur in pixels of a picture of 96 rows, and samples a pixel
PATIENCE = 1e-4  # a level ends with a step that lowers the loss by less than this share of it
DAMPING, LARGEST_DAMPING = 1e-2, 1e6
LENS = {"fov_y": 0.6, "near": 1.0, "far": 40.0}


class Rig(NamedTuple):
    """What all views have in common.

    Attributes:
        start: of one camera; each view has its own rotation and eye.
        common: (6,) the lens, two of the light's direction, and the logarithms of its colour.
        blur: standard deviation in pixels.
    """

    start: Start
    common: Array
    blur: Array


class Shot(NamedTuple):
    """A view: where its camera starts, its six parameters, and its picture."""

    rotation: Array
    eye: Array
    own: Array
    target: Array


class Equations(NamedTuple):
    """Loss and normal equations of views, with a leading axis of these."""

    loss: Any
    own: Any  # (6, 6)
    mixed: Any  # (6, 6), rows of the camera's parameters
    common: Any  # (6, 6)
    own_gradient: Any
    common_gradient: Any


def view_at(rig: Rig, shot: Shot, parameters: Array) -> View:
    """Camera and light of twelve parameters, those of the camera first."""
    start = rig.start._replace(rotation=shot.rotation, eye=shot.eye)
    camera = moved_camera(start, parameters[: OWN + 1])
    color = start.lights[0].diffuse * jnp.exp(parameters[OWN + 3 :])
    move = parameters[OWN + 1 : OWN + 3]
    light = {"move": move, "diffuse": color, "specular": color}
    return View(camera, *appearance_of(start, {"lights": [light]}), start.background)


def picture(rig: Rig, shot: Shot, parameters: Array, size: int, samples: int) -> Array:
    """What a camera sees of the teapot."""
    return render_view(rig.start.mesh, view_at(rig, shot, parameters), size, size, samples)


def normal_equations(samples: int, rig: Rig, shot: Shot) -> Equations:
    """Of the blurred difference of a view's pictures."""
    size = shot.target.shape[0]

    def residuals(parameters: Array) -> Array:
        difference = picture(rig, shot, parameters, size, samples) - shot.target
        return jnp.ravel(dr.fit.gaussian_blur(difference, rig.blur, radius=size // 6))

    found, derivative = jax.linearize(residuals, jnp.concatenate([shot.own, rig.common]))
    columns = jax.vmap(derivative)(jnp.eye(OWN + rig.common.size))
    matrix, gradient = columns @ columns.T, columns @ found
    return Equations(
        jnp.vdot(found, found) / 2,
        matrix[:OWN, :OWN],
        matrix[:OWN, OWN:],
        matrix[OWN:, OWN:],
        gradient[:OWN],
        gradient[OWN:],
    )


EQUATIONS = [partial(normal_equations, samples) for _, samples in LEVELS]  # each compiles once


def target_picture(rig: Rig, shot: Shot) -> Array:
    """The picture that the true camera takes, with 64 samples a pixel."""
    return picture(rig, shot, jnp.concatenate([shot.own, rig.common]), shot.target.shape[0], 64)


def damped(matrix: np.ndarray, damping: float) -> np.ndarray:
    """Raise the diagonal by a share of itself, or of its largest where it is nearly zero."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    largest = np.max(diagonal, axis=-1, keepdims=True)
    raised = np.maximum(diagonal, 1e-6 * np.where(largest > 0, largest, 1))
    return matrix + damping * raised[..., None] * np.eye(matrix.shape[-1])


def step_of(equations: Equations, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The damped step of all cameras' parameters, and of those in common."""
    own, mixed, gradient = (
        np.asarray(x, np.float64) for x in (equations.own, equations.mixed, equations.own_gradient)
    )
    common, common_gradient = (
        np.sum(x, axis=0, dtype=np.float64) for x in (equations.common, equations.common_gradient)
    )
    own, common = damped(own, damping), damped(common, damping)
    solved = np.linalg.solve(own, np.concatenate([mixed, gradient[..., None]], axis=-1))
    both = np.sum(np.swapaxes(mixed, 1, 2) @ solved, axis=0)
    move = -np.linalg.solve(common - both[:, :-1], common_gradient - both[:, -1])
    return -solved[..., -1] - solved[..., :-1] @ move, move


# The dome -----------------------------------------------------------------------------------------


def true_view(turn: float, height: float) -> View:
    """Of a camera round the teapot, z up."""
    way = [np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)]
    eye = 14 * np.array(way) + (0, 0, 1.4)
    light = dr.DirectionalLight(
        direction=(-0.5, 0.4, -1.0), ambient=(0.1,) * 3, diffuse=(0.75, 0.65, 0.55)
    )
    return View(
        camera={"eye": eye, "target": (0, 0, 1.4), "up": (0, 0, 1), **LENS},
        lights=(light,),
        material=dr.Material(specular=(0.3, 0.3, 0.3), shininess=20.0),
        background=jnp.array([0.1, 0.12, 0.2]),
    )


def rig_of(starts: list[Start], target: Array) -> tuple[Rig, Shot]:
    """Cameras that have not moved yet, and what they have in common."""
    rotation, eye = (jnp.stack([getattr(s, name) for s in starts]) for name in ("rotation", "eye"))
    shots = Shot(rotation, eye, jnp.zeros((len(starts), OWN)), target)
    return Rig(starts[0], jnp.zeros(6), jnp.float32(0)), shots


def make_rig(
    mesh: dr.Mesh, views: int, size: int, seed: int, devices: Sequence[jax.Device] | None
) -> tuple[Rig, Shot, list[View]]:
    """Where the fit starts, the cameras there with their pictures, and the truth."""
    generator = np.random.default_rng(seed)
    turns = 2 * np.pi * np.arange(views) / views
    heights = generator.uniform(0.15, 1.0, views)
    truths = [true_view(*place) for place in zip(turns, heights, strict=True)]
    starts = [start_of(mesh, view) for view in truths]
    rig, shots = rig_of(starts, jnp.zeros((views, size, size, 3)))
    target = dr.views.map_views(target_picture, shots, rig, devices=devices)

    turn = generator.normal(size=(views, 3))
    turn *= np.radians(generator.uniform(1, 4, (views, 1))) / np.linalg.norm(turn, axis=1)[:, None]
    shift = generator.uniform(-0.1, 0.1, (views, 2))
    nearer = generator.uniform(-0.04, 0.04, (views, 1))
    wider = np.full((views, 1), np.log(1.05))
    off = jnp.asarray(np.concatenate([turn, shift, nearer, wider], axis=1), jnp.float32)
    cameras = [moved_camera(s, parameters) for s, parameters in zip(starts, off, strict=True)]
    light = starts[0].lights[0]
    away = dr.DirectionalLight(
        direction=dr.fit.direction_update(light.direction, jnp.radians(jnp.array([12.0, -9.0]))),
        ambient=light.ambient,
        diffuse=0.6 * light.diffuse,
    )
    begun = [
        start_of(mesh, View(camera, (away,), true.material, true.background))
        for camera, true in zip(cameras, truths, strict=True)
    ]
    return *rig_of(begun, target), truths


# The fit ------------------------------------------------------------------------------------------


class State(NamedTuple):
    """All that the fit goes on from."""

    level: Any
    step: Any
    damping: Any
    own: np.ndarray
    common: np.ndarray
    losses: np.ndarray  # of all steps taken
    views: Any  # drawn so far


def load_state(path: Path, asked: dict[str, Any], views: int) -> State:
    """What an interrupted fit left, or the start.

    Raises:
        ValueError: if it was asked for something else.
    """
    if not path.exists():
        return State(0, 0, DAMPING, np.zeros((views, OWN)), np.zeros(6), np.zeros(0), 0)
    with np.load(path) as stored:
        check_same(path, "the state of a fit", asked, json.loads(str(stored["asked"])))
        return State(*(stored[name] for name in State._fields))


def save_state(path: Path, state: State, asked: dict[str, Any]) -> None:
    """Write all or nothing."""
    save_whole(path, partial(np.savez, asked=json.dumps(asked), **state._asdict()))


def fit(
    rig: Rig,
    shots: Shot,
    state: State,
    steps: int,
    *,
    devices: Sequence[jax.Device] | None = None,
    told: Callable[[int], Any] = lambda views: None,
) -> Iterator[State]:
    """Go on from a state; yields that after each step, and tells how many views were drawn."""
    unit = shots.target.shape[1] / 96

    def equations_at(state: State) -> Equations:
        blur = jnp.float32(LEVELS[int(state.level)][0] * unit)
        shared = rig._replace(common=jnp.asarray(state.common, jnp.float32), blur=blur)
        moved = shots._replace(own=np.float32(state.own))
        draw = EQUATIONS[int(state.level)]
        parts = []
        for which, part in dr.views.stream_views(draw, moved, shared, devices=devices):
            parts.append(part)
            told(len(which))
        return jax.tree.map(lambda *rows: np.concatenate(rows), *parts)

    while state.level < len(LEVELS):
        here, first = equations_at(state), state.step == 0
        state = state._replace(views=state.views + len(state.own) * first)
        while state.step < steps:
            loss = np.sum(here.loss, dtype=np.float64)
            own, common = step_of(here, float(state.damping))
            moved = state._replace(own=state.own + own, common=state.common + common)
            there = equations_at(moved)
            new = np.sum(there.loss, dtype=np.float64)
            taken = state.step + 1
            if new < loss:
                here, state = there, moved._replace(losses=np.append(state.losses, new))
            elif state.damping > LARGEST_DAMPING:
                taken = steps
            if (1 - PATIENCE) * loss < new < loss:
                taken = steps
            state = state._replace(
                step=taken,
                damping=state.damping * (0.2 if new < loss else 10),
                views=state.views + len(state.own),
            )
            yield state
        state = state._replace(level=state.level + 1, step=0, damping=DAMPING)
    yield state


def run(
    out: Path,
    *,
    views: int = 24,
    size: int = 96,
    divisions: int = 8,
    steps: int = 10,
    seed: int = 0,
    devices: Sequence[jax.Device] | None = None,
    told: Callable[[int], Any] = lambda views: None,
) -> dict[str, Any]:
    """Fit, going on from what is in `out`; see the module's docstring for the result.

    Raises:
        ValueError: if `out` holds the state of another fit.
    """
    out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    asked = {"views": views, "size": size, "divisions": divisions, "steps": steps, "seed": seed}
    mesh = dr.shapes.teapot(divisions)
    state = load_state(out / "fit_rig.npz", asked, views)
    rig, shots, truths = make_rig(mesh, views, size, seed, devices)
    begun_with = int(state.views)
    told(begun_with)
    for following in fit(rig, shots, state, steps, devices=devices, told=told):
        state = following
        save_state(out / "fit_rig.npz", state, asked)
    seconds = time.perf_counter() - began
    common = np.broadcast_to(state.common, (views, state.common.size))
    parameters = np.concatenate([state.own, common], axis=1)
    start, found = (
        [
            view_at(rig, jax.tree.map(lambda x, i=i: x[i], shots), jnp.float32(row))
            for i, row in enumerate(rows)
        ]
        for rows in (np.zeros_like(parameters), parameters)
    )
    report: dict[str, Any] = {
        **asked,
        "losses": state.losses,
        "views_drawn": int(state.views),
        "seconds": seconds,
        "views_a_second": (int(state.views) - begun_with) / seconds,
    }
    for name, ones in (("at_start", start), ("found", found)):
        pairs = zip(ones, truths, strict=True)
        report[name] = {
            "cameras": [camera_errors(view.camera, truth.camera) for view, truth in pairs],
            "light": light_errors(ones[0], truths[0]),
        }
    save_json(out / "fit_rig.json", report)
    plot(out / "fit_rig.png", mesh, report, list(zip(truths, start, found, strict=True)))
    return report


def light_errors(view: View, truth: View) -> dict[str, float]:
    errors = view_errors(view, truth, 1.0)
    return {name: errors[name] for name in ("light_0_degrees", "light_0_diffuse")}


def plot(path: Path, mesh: dr.Mesh, report: dict[str, Any], views: list[tuple[View, ...]]) -> None:
    """Draw target, start, result and difference of two views, and the errors of all cameras."""
    plt, size = pyplot(), report["size"]
    figure = plt.figure(figsize=(12, 10), layout="constrained")
    axes = figure.subplot_mosaic("abcd;efgh;iijj")
    for places, number in (("abcd", 0), ("efgh", len(views) // 2)):
        images = [render_view(mesh, view, size, size, 16) for view in views[number]]
        show_fit([axes[place] for place in places], *images)
    for place, name in (("i", "rotation_degrees"), ("j", "eye_percent")):
        for key, marker in (("at_start", "kx"), ("found", "o")):
            errors = [camera[name] for camera in report[key]["cameras"]]
            axes[place].semilogy(errors, marker, label=key.replace("_", " "))
        axes[place].set_xlabel("number of the camera")
        axes[place].set_ylabel(name.replace("_", " "))
        axes[place].legend(fontsize="small")
    figure.savefig(path, dpi=100)
    plt.close(figure)


def summary(report: dict[str, Any]) -> str:
    """Say in a few lines what was found."""
    lines = [
        f"{report['views']} cameras: {report['views_drawn']} views with derivative,"
        f" {report['seconds']:.0f} s, {report['views_a_second']:.1f} views/s"
    ]
    start, found = report["at_start"], report["found"]
    for name in found["cameras"][0]:
        before, after = ([camera[name] for camera in all_["cameras"]] for all_ in (start, found))
        lines.append(
            f"  {name:20} median {np.median(after):.4f}, largest {max(after):.4f}"
            f" (start {np.median(before):.3f}, {max(before):.3f})"
        )
    for name, value in found["light"].items():
        lines.append(f"  {name:20} {value:.4f} (start {start['light'][name]:.3f})")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results/fit_rig"))
    parser.add_argument("--views", type=int, default=24, help="cameras, one picture each")
    parser.add_argument("--size", type=int, default=96, help="rows and columns of the pictures")
    parser.add_argument("--steps", type=int, default=10, help="at most, of each level of blur")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--devices", type=int, default=0, help="split the views over so many")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    options = vars(parser.parse_args())
    number, quiet = options.pop("devices"), options.pop("quiet")
    if number:
        jax.config.update("jax_num_cpu_devices", number)
    devices = jax.devices()[:number] or None
    if quiet:
        report = run(options.pop("out"), devices=devices, **options)
    else:
        most = len(LEVELS) * (options["steps"] + 1) * options["views"]
        with progress_bar(total=most, unit="view") as bar:
            report = run(options.pop("out"), devices=devices, told=bar.update, **options)
    print(summary(report))


if __name__ == "__main__":
    main()
