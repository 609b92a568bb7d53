"""Is a light found from the shadow that it casts, and from nothing else?

    python experiments/fit_light_from_shadow.py

A ring hangs above a floor, outside of the picture: only its shadow is seen. The direction of a
directional light, or the position of a point light, is fitted to one picture (16 samples a pixel)
by Levenberg-Marquardt steps on the difference of the pictures, blurred less and less, with the
renderer's derivative by where the shadow falls. The light's strength is fitted too, and is wrong at
the start, so that the floor's brightness tells little of the light. A direction counts as found
within 0.5 degrees, from starts 5 to 15 degrees away; a position within 1 % of its distance from
the ring, from starts 6 to 20 % of that away.

Expected: all 20 starts of both are found, with median errors of 0.01 degrees and 0.02 % (five
minutes in all on two cores, most of it compilation).

Written to `--out`: `fit_light_from_shadow.json` with every start, and a picture for each light with
one fit (target, start, result, 16 times their difference round grey) and the errors of all starts.
"""

import functools
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import exact_settings, pyplot, random_start_options, save_json, show_fit, statistics
from fitting import Patience
from jax import Array

import diffrast as dr

RING = (1.6, 1.8, 0.5)
PLACED = dr.linalg.compose(dr.linalg.translation(RING), dr.linalg.rotation((1, 0.3, 0.2), 1.4))
OBJECTS = [
    dr.Object(dr.shapes.torus(0.5, 0.14), None, PLACED),
    dr.Object(
        dr.shapes.plane(8.0, 8.0),
        dr.Material(diffuse=(0.8, 0.8, 0.8)),
        dr.linalg.rotation_x(-np.pi / 2),
    ),
]
CAMERA = dr.Camera.perspective(
    eye=(0.4, 2.2, 3.2), target=(0.4, 0, 0), up=(0.05, 1, 0), fov_y=0.6, near=0.5, far=20
)
SHADOW = dr.Shadow(resolution=512)
COLOR = jnp.array([0.8, 0.75, 0.6])
TRUTH = {"direction": jnp.array([-0.6, -1.0, -0.25]), "position": jnp.array([2.6, 3.6, 1.0])}
CRITERION = {"direction": {"degrees": 0.5}, "position": {"percent": 1.0}}
BLURS = (6.0, 2.0, 0.0)  # standard deviations in pixels of 128, one level after another


def light_at(kind: str, start: Array, params: Array) -> dr.DirectionalLight | dr.PointLight:
    """The light that parameters stand for: its motion from a start, and its strength's logarithm.

    A direction turns by two radians across it; a position moves in units of its distance.
    """
    color = jnp.exp(params[-1]) * COLOR
    if kind == "direction":
        across = jnp.linalg.svd(start[None])[2][1:]
        direction = dr.linalg.so3_exp(params[:2] @ across) @ start
        return dr.DirectionalLight(direction=direction, diffuse=color, shadow=SHADOW)
    position = start + dr.linalg.norm(start - jnp.array(RING)) * params[:3]
    return dr.PointLight(position=position, diffuse=color, shadow=SHADOW)


def errors_of(light: dr.DirectionalLight | dr.PointLight) -> dict[str, float]:
    """The angle from the true direction, or the distance from the true position in percent."""
    if isinstance(light, dr.DirectionalLight):
        one, other = dr.linalg.normalize(light.direction), dr.linalg.normalize(TRUTH["direction"])
        angle = jnp.arctan2(dr.linalg.norm(jnp.cross(one, other)), dr.linalg.dot(one, other))
        return {"degrees": float(jnp.degrees(angle))}
    away = dr.linalg.norm(TRUTH["position"] - jnp.array(RING))
    distance = dr.linalg.norm(light.position - TRUTH["position"])
    return {"percent": 100 * float(distance / away)}


@jax.jit
def picture(light: dr.DirectionalLight | dr.PointLight, settings: dr.RenderSettings) -> Array:
    """Render the floor, on which the ring's shadow falls."""
    scene = dr.Scene(objects=OBJECTS, lights=[light, dr.AmbientLight((0.15, 0.15, 0.2))])
    return dr.render(scene, CAMERA, settings)


def residuals(
    kind: str, params: Array, start: Array, target: Array, blur: Array, settings: dr.RenderSettings
) -> Array:
    """Blurred difference of the pictures."""
    difference = picture(light_at(kind, start, params), settings) - target
    return dr.fit.gaussian_blur(difference, blur, radius=settings.height // 5)


RESIDUALS = {kind: functools.partial(residuals, kind) for kind in TRUTH}  # each compiles once


def random_start(kind: str, generator: np.random.Generator) -> tuple[Array, Array]:
    """A direction or position off the true one, and parameters with a wrong strength."""
    away = generator.normal(size=2 if kind == "direction" else 3)
    away *= generator.uniform(0.3, 1) / np.linalg.norm(away)
    strength = np.log(generator.uniform(0.7, 1.4))
    if kind == "direction":
        across = np.linalg.svd(np.asarray(TRUTH[kind])[None])[2][1:]
        turn = np.radians(15.0) * away @ across
        start = dr.linalg.so3_exp(np.float32(turn)) @ TRUTH[kind]
        return start, jnp.array([0, 0, strength], jnp.float32)
    distance = dr.linalg.norm(TRUTH[kind] - jnp.array(RING))
    start = TRUTH[kind] + 0.2 * distance * jnp.asarray(away, jnp.float32)
    return start, jnp.array([0, 0, 0, strength], jnp.float32)


def fit(
    kind: str, start: Array, params: Array, target: Array, settings: dr.RenderSettings, steps: int
) -> tuple[dr.DirectionalLight | dr.PointLight, dict[str, Any]]:
    """Return the light found, coarse to fine, and its errors, renders and seconds."""
    renders, seconds = 0, 0.0
    for blur in BLURS:
        result = dr.fit.least_squares(
            RESIDUALS[kind],
            params,
            args=(start, target, jnp.float32(blur * settings.height / 128), settings),
            steps=steps,
            tolerance=1e-5,
            callback=Patience(),
        )
        params, renders = result.params, renders + result.renders
        seconds += result.seconds
    found = light_at(kind, start, params)
    errors = errors_of(found)
    converged = all(errors[name] <= limit for name, limit in CRITERION[kind].items())
    return found, {"converged": converged, **errors, "renders": renders, "seconds": seconds}


def run(
    out: Path,
    *,
    kinds: tuple[str, ...] = ("direction", "position"),
    starts: int = 20,
    size: int = 128,
    steps: int = 12,
    seed: int = 0,
    progress: bool = False,
) -> dict[str, Any]:
    """Fit from random starts; see the module's docstring for the result."""
    began = time.perf_counter()
    exact = exact_settings(size)
    settings = dr.RenderSettings(height=size, width=size)
    generator = np.random.default_rng(seed)
    report: dict[str, Any] = {"criterion": CRITERION, "size": size, "seed": seed, "lights": {}}
    for kind in kinds:
        nothing = jnp.zeros(3 if kind == "direction" else 4)
        target = picture(light_at(kind, TRUTH[kind], nothing), exact)
        rows, pairs = [], []
        for number in range(starts):
            start, params = random_start(kind, generator)
            before = light_at(kind, start, params)
            found, outcome = fit(kind, start, params, target, settings, steps)
            pairs.append((before, found))
            rows.append({"at_start": errors_of(before), "found": outcome})
            if progress:
                print(f"{kind}, start {number + 1} of {starts}: {outcome}", flush=True)
        outcomes = [row["found"] for row in rows]
        report["lights"][kind] = statistics(outcomes, CRITERION[kind]) | {"starts": rows}
        images = [target, *(picture(light, exact) for light in pairs[0])]
        plot(out / f"fit_{kind}_from_shadow.png", images, rows, kind)
    report["seconds"] = time.perf_counter() - began
    save_json(out / "fit_light_from_shadow.json", report)
    return report


def plot(path: Path, images: list[Array], rows: list[dict[str, Any]], kind: str) -> None:
    """Draw target, start, result and difference of one fit, and the errors of all starts."""
    path.parent.mkdir(parents=True, exist_ok=True)
    plt = pyplot()
    figure = plt.figure(figsize=(12, 7), layout="constrained")
    axes = figure.subplot_mosaic("abcd;eeee")
    show_fit([axes[place] for place in "abcd"], *images)
    ((name, limit),) = CRITERION[kind].items()
    axes["e"].semilogy([row["at_start"][name] for row in rows], "kx", label="start")
    axes["e"].semilogy([row["found"][name] for row in rows], "o", label="result")
    axes["e"].axhline(limit, color="0.6", zorder=0)
    axes["e"].set_xlabel("number of the start")
    axes["e"].set_ylabel(f"error of the {kind} ({name})")
    axes["e"].legend(fontsize="small")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = random_start_options(__doc__, "fit_light_from_shadow", starts=20, size=128)
    parser.add_argument("--steps", type=int, default=12, help="at most, of each level of blur")
    options = vars(parser.parse_args())
    report = run(options.pop("out"), progress=not options.pop("quiet"), **options)
    for kind, figures in report["lights"].items():
        ((name, _),) = CRITERION[kind].items()
        print(
            f"{kind}: {100 * figures['share_converged']:.0f} % found; median error"
            f" {figures[f'median_{name}']:.4f} {name}, {figures['median_renders']:.0f} pictures"
            f" with derivative, {figures['median_seconds']:.1f} s"
        )


if __name__ == "__main__":
    main()
