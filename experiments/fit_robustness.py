"""From how far away is the camera found, and by which method?

    python experiments/fit_robustness.py

Random starts, turned about the teapot by up to 25 degrees round any axis and up to 15 % nearer or
farther, are fitted to one picture of it, rendered with four times the samples of the fit. Both
methods see the same blurred differences, coarse to fine; lights and material are known. A fit
counts as converged if the rotation ends within 0.2 degrees and the eye within 0.5 % of its
distance, which is a tenth of a pixel of these small pictures.

Expected: all starts converge with Levenberg-Marquardt, in about 18 renders each, each with its
derivative by the seven camera parameters. Adam takes all its steps, 122 renders, and leaves about a
quarter of the starts outside: nearly all of these have found the rotation, but creep along the
valley in which distance and angle of view make up for each other.

Written to `--out`: `fit_robustness.json` with every start, and `fit_robustness.png` with the final
errors by the angle of the start and by the renders used.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import optax
from common import (
    DEFAULT_TARGET,
    View,
    load_problem,
    pyplot,
    random_start_options,
    render_view,
    save_json,
    statistics,
)
from fitting import (
    RADIUS,
    Level,
    fit_level,
    moving,
    residual_function,
)
from jax import Array
from parameters import (
    CAMERA_PARAMETERS,
    Start,
    camera_errors,
    moved_camera,
    start_of,
)

import diffrast as dr

CRITERION = {"rotation_degrees": 0.2, "eye_percent": 0.5}  # a tenth of a pixel of 64


def levels_for(size: int, steps: int) -> list[Level]:
    """Blur by a sixteenth of the picture, then by one pixel, with all seven parameters."""
    return [Level(1, 16, size / 16, steps, False), Level(1, 16, 1.0, steps, True)]


def random_camera(
    generator: np.random.Generator, truth: Start, degrees: float
) -> tuple[dict[str, Any], float]:
    """Return a camera up to so many degrees and 15 % of the distance away, and the angle."""
    axis = generator.normal(size=3)
    angle = np.radians(generator.uniform(0, degrees))
    parameters = np.zeros(CAMERA_PARAMETERS, np.float32)
    parameters[:3] = angle * axis / np.linalg.norm(axis)
    parameters[5] = -np.log(generator.uniform(0.85, 1.15))
    return moved_camera(truth, jnp.asarray(parameters)), float(np.degrees(angle))


def fit_with_lm(start: Start, target: Array, levels: list[Level]) -> tuple[Any, int]:
    """Return parameters and renders of a fit by Levenberg-Marquardt steps."""
    params, renders = {"camera": jnp.zeros(CAMERA_PARAMETERS)}, 0
    for level in levels:
        result = fit_level(start, target, params, level)
        params, renders = result.params, renders + result.renders
    return params, renders


@functools.cache
def adam_loss(height: int, width: int, samples: int) -> Callable[..., Array]:
    """Mean square of the residuals, relative to `scale`."""
    residuals = residual_function(height, width, samples, RADIUS)

    def loss(
        params: Any, start: Start, target: Array, blur: Array, moving: Array, scale: Array
    ) -> Array:
        return jnp.mean(residuals(params, start, target, blur, moving) ** 2) / scale

    return loss


def fit_with_adam(
    start: Start, target: Array, levels: list[Level], optimizers: list[Any]
) -> tuple[Any, int]:
    """Return parameters and renders of a fit by Adam, one optimizer for each level."""
    params, renders = {"camera": jnp.zeros(CAMERA_PARAMETERS)}, 0
    for level, optimizer in zip(levels, optimizers, strict=True):
        result = dr.fit.minimize(
            adam_loss(*target.shape[:2], level.samples),
            params,
            args=(start, target, jnp.float32(level.blur), moving(level), jnp.mean(target**2)),
            optimizer=optimizer,
            steps=level.steps,
        )
        params, renders = result.params, renders + result.renders
    return params, renders


def run(
    out: Path,
    *,
    starts: int = 50,
    size: int = 64,
    degrees: float = 25.0,
    divisions: int = 8,
    adam_steps: int = 60,
    lm_steps: int = 20,
    seed: int = 0,
    progress: bool = False,
) -> dict[str, Any]:
    """Fit from random starts by both methods; see the module's docstring for the result."""
    started = time.perf_counter()
    truth = load_problem(DEFAULT_TARGET).truth
    assert truth is not None
    mesh = dr.shapes.teapot(divisions)
    target = render_view(mesh, truth, size, size, samples=64)
    optimizers = [
        optax.adam(optax.cosine_decay_schedule(rate, adam_steps)) for rate in (0.03, 0.005)
    ]
    methods: dict[str, Callable[[Start], tuple[Any, int]]] = {
        "levenberg_marquardt": lambda start: fit_with_lm(start, target, levels_for(size, lm_steps)),
        "adam": lambda start: fit_with_adam(
            start, target, levels_for(size, adam_steps), optimizers
        ),
    }
    generator = np.random.default_rng(seed)
    true_start = start_of(mesh, truth)
    rows = []
    for number in range(starts):
        camera, angle = random_camera(generator, true_start, degrees)
        start = start_of(mesh, dataclasses.replace(truth, camera=camera))
        row: dict[str, Any] = {
            "angle_degrees": angle,
            "at_start": camera_errors(camera, truth.camera),
        }
        row |= {name: _outcome(start, fit, truth) for name, fit in methods.items()}
        rows.append(row)
        if progress:
            found = [name for name in methods if row[name]["converged"]]
            print(f"start {number + 1} of {starts}, {angle:.0f} degrees: {found}", flush=True)
    report = {
        "criterion": CRITERION,
        "size": size,
        "degrees": degrees,
        "seed": seed,
        "methods": {name: statistics([row[name] for row in rows], CRITERION) for name in methods},
        "seconds": time.perf_counter() - started,
        "starts": rows,
    }
    save_json(out / "fit_robustness.json", report)
    plot_outcomes(out / "fit_robustness.png", rows, list(methods))
    return report


def _outcome(start: Start, fit: Callable[[Start], tuple[Any, int]], truth: View) -> dict[str, Any]:
    """Fit from a start, and return errors, renders, seconds and whether it converged."""
    before = time.perf_counter()
    params, renders = fit(start)
    errors = camera_errors(moved_camera(start, params["camera"]), truth.camera)
    converged = all(errors[key] <= limit for key, limit in CRITERION.items())
    seconds = time.perf_counter() - before
    return {"converged": converged, "renders": renders, "seconds": seconds, **errors}


def plot_outcomes(path: Path, rows: list[dict[str, Any]], methods: list[str]) -> None:
    """Draw the final errors against the angle of the start, and against the renders used."""
    plt = pyplot()
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    for name in methods:
        errors = [row[name]["eye_percent"] for row in rows]
        for axis, values in (
            (axes[0], [row["angle_degrees"] for row in rows]),
            (axes[1], [row[name]["renders"] for row in rows]),
        ):
            axis.semilogy(values, errors, "o", alpha=0.6, label=name.replace("_", "-"))
    for axis, label in zip(axes, ("angle of the start (degrees)", "renders"), strict=True):
        axis.axhline(CRITERION["eye_percent"], color="0.6", zorder=0)
        axis.set_xlabel(label)
    axes[1].set_xscale("log")
    axes[0].set_ylabel("eye error at the end (% of its distance)")
    axes[0].legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = random_start_options(__doc__, "fit_robustness", starts=50, size=64)
    parser.add_argument("--degrees", type=float, default=25.0, help="turn the starts by up to")
    options = vars(parser.parse_args())
    report = run(options.pop("out"), progress=not options.pop("quiet"), **options)
    for name, found in report["methods"].items():
        print(name, found)


if __name__ == "__main__":
    main()
