"""Are materials and lights found together, and what of them cannot be?

    python experiments/fit_materials.py

Three balls of different materials stand on a floor under a directional and a point light. From one
picture with noise of 1/255 a pixel, shapes and camera known, all coefficients are fitted at once:
diffuse and specular reflectance and shininess of each ball, diffuse reflectance of the floor;
colour and direction or position of each light, the point light's attenuation and the ambient
light. The fit is Levenberg-Marquardt on the difference of the pictures, from dull grey balls and
white lights that are turned by 15 degrees and moved by a fifth of their distance.

A picture shows products: if all reflectances double and all lights are halved nothing changes,
channel by channel. So much is known in advance. What else is not identifiable the derivative of the
picture by all parameters tells: parameters along whose combinations the picture does not change, or
so little that noise of 1/255 would move them by more than a tenth (the least singular values). The
report names the parameters that take most part in each. Errors are given after each channel's
scale is fixed by the floor's true reflectance.

Expected: five unidentifiable combinations of 41 parameters, and all five exactly: the scale of each
channel; the strength of the point light against its attenuation, which it is divided by; and the
length of the directional light's direction. All else is known, shininess and the place of the point
light included: after six pictures with derivative, in under a minute on two cores, diffuse
reflectances are right to 0.001, specular ones and the lights' colours to 0.01.

Written to `--out`: `fit_materials.json` with true and found values, and `fit_materials.png` with
target, start, result, their difference, and the singular values.
"""

import argparse
import functools
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import pyplot, save_json, show_fit
from fitting import Patience
from jax import Array
from jax.flatten_util import ravel_pytree

import diffrast as dr

PLACES = ((-1.15, 0.5, 0.1), (0.0, 0.5, -0.3), (1.15, 0.5, 0.2))
CAMERA = dr.Camera.perspective(
    eye=(0.2, 2.0, 4.2), target=(0, 0.3, 0), fov_y=0.75, near=0.5, far=20
)
BALL = dr.shapes.icosphere(4, 0.5)
FLOOR = dr.Object(dr.shapes.plane(4.0, 3.0), None, dr.linalg.rotation_x(-np.pi / 2))
EXACT = 100.0  # moved so many times its size by noise, a combination has no effect at all
NOISE = 1 / 255

Params = dict[str, Any]
TRUTH: Params = {
    "diffuse": jnp.array([[0.7, 0.2, 0.1], [0.15, 0.5, 0.25], [0.2, 0.25, 0.7]]),
    "specular": jnp.array([[0.5, 0.5, 0.5], [0.2, 0.2, 0.2], [0.7, 0.6, 0.3]]),
    "log_shininess": jnp.log(jnp.array([12.0, 5.0, 30.0])),
    "floor": jnp.array([0.5, 0.45, 0.4]),
    "sun": jnp.array([0.7, 0.65, 0.5]),
    "direction": jnp.array([-0.5, -1.0, -0.6]),
    "lamp": jnp.array([0.6, 0.8, 1.2]),
    "position": jnp.array([1.5, 2.2, 1.6]),
    "attenuation": jnp.array([0.3, 0.25]),
    "ambient": jnp.array([0.15, 0.15, 0.2]),
}


def start_of(truth: Params) -> Params:
    """Return where the fit starts: dull grey under white lights from elsewhere."""
    return {
        "diffuse": jnp.full_like(truth["diffuse"], 0.4),
        "specular": jnp.full_like(truth["specular"], 0.3),
        "log_shininess": jnp.log(jnp.full(3, 10.0)),
        "floor": jnp.full(3, 0.4),
        "sun": jnp.full(3, 0.7),
        "direction": dr.linalg.so3_exp((0.2, 0.1, -0.15)) @ truth["direction"],
        "lamp": jnp.full(3, 0.7),
        "position": truth["position"] + jnp.array([-0.3, 0.3, 0.3]),
        "attenuation": jnp.array([0.5, 0.2]),
        "ambient": jnp.full(3, 0.2),
    }


def scene_of(params: Params) -> dr.Scene:
    """The scene that parameters stand for."""
    materials = [
        dr.Material(
            diffuse=params["diffuse"][i],
            specular=params["specular"][i],
            shininess=jnp.exp(params["log_shininess"][i]),
        )
        for i in range(3)
    ]
    balls = [
        dr.Object(BALL, material, dr.linalg.translation(place))
        for material, place in zip(materials, PLACES, strict=True)
    ]
    floor = dr.Object(FLOOR.mesh, dr.Material(diffuse=params["floor"]), FLOOR.transform)
    constant, quadratic = params["attenuation"]
    attenuation = jnp.stack([constant, jnp.zeros_like(constant), quadratic])
    lights = [
        dr.DirectionalLight(direction=params["direction"], diffuse=params["sun"]),
        dr.PointLight(position=params["position"], diffuse=params["lamp"], attenuation=attenuation),
        dr.AmbientLight(params["ambient"]),
    ]
    return dr.Scene(objects=[*balls, floor], lights=lights)


@functools.partial(jax.jit, static_argnames="size")
def picture(params: Params, size: int) -> Array:
    """Render the scene; edges say nothing of materials."""
    settings = dr.RenderSettings(height=size, width=size, antialias=False)
    return dr.render(scene_of(params), CAMERA, settings)


def residuals(params: Params, target: Array) -> Array:
    """Difference of the pictures."""
    return picture(params, target.shape[0]) - target


def names_of(params: Params) -> list[str]:
    """One name for each number, in the order of `ravel_pytree`."""
    names = []
    for path, leaf in jax.tree.leaves_with_path(params):
        key = path[0].key
        names += [f"{key}{list(map(int, index))}" for index in np.ndindex(leaf.shape)]
    return names


@functools.partial(jax.jit, static_argnames="size")
def jacobian(params: Params, size: int) -> Array:
    """Derivative of all pixels by all parameters, (pixels, parameters)."""
    flat, unravel = ravel_pytree(params)
    return jax.jacfwd(lambda x: picture(unravel(x), size).reshape(-1))(flat)


def identifiability(params: Params, size: int) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """Singular values of the derivative, and the combinations of parameters that stay unknown.

    Parameters are taken relative to their size, so that a change of one is one of 100 %. Noise of
    1/255 a pixel moves a combination by that over its singular value; those that it moves without
    bound come first.
    """
    scale = np.maximum(np.abs(np.asarray(ravel_pytree(params)[0], float)), 0.1)
    derivative = np.asarray(jacobian(params, size), float) * scale
    _, values, rows = np.linalg.svd(derivative, full_matrices=False)
    names, unknown = names_of(params), []
    moved = NOISE / np.maximum(values, 1e-12)
    exact = moved > EXACT
    for distance, row in zip(
        [*moved[exact], *moved[~exact][::-1]],
        [*fewest_parts(rows[exact]), *rows[~exact][::-1]],
        strict=True,
    ):
        if distance < 0.1:
            break
        most = np.argsort(-np.abs(row))[:8]
        taking_part = {names[i]: float(row[i]) for i in most if abs(row[i]) > 0.05}
        unknown.append({"moved_by_noise": float(distance), "parameters": taking_part})
    return values, unknown


def fewest_parts(rows: np.ndarray) -> np.ndarray:
    """Unit vectors that span the same space, each with an entry that the others lack.

    Any mixture of what cannot be known at all is as unknown: this one can be read.
    """
    rows = rows.copy()
    for k in range(len(rows)):
        free = np.abs(rows[k:])
        pivot_row, pivot = np.unravel_index(np.argmax(free), free.shape)
        rows[[k, k + pivot_row]] = rows[[k + pivot_row, k]]
        rows[k] /= rows[k, pivot]
        others = np.arange(len(rows)) != k
        rows[others] -= rows[others, pivot, None] * rows[k]
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def with_scale_fixed(params: Params, truth: Params) -> Params:
    """The same picture with the floor's true reflectance, and unit direction of the sun."""
    ratio = truth["floor"] / params["floor"]
    fixed = dict(params)
    for name in ("diffuse", "specular", "floor"):
        fixed[name] = params[name] * ratio
    for name in ("sun", "lamp", "ambient"):
        fixed[name] = params[name] / ratio
    strength = truth["attenuation"][0] / params["attenuation"][0]
    fixed["attenuation"] = params["attenuation"] * strength
    fixed["lamp"] = fixed["lamp"] * strength
    fixed["direction"] = dr.linalg.normalize(params["direction"])
    return fixed


def errors_of(params: Params, truth: Params) -> dict[str, float]:
    """Largest absolute error of each group, after the scales are fixed."""
    found, wanted = with_scale_fixed(params, truth), with_scale_fixed(truth, truth)
    return {name: float(jnp.max(jnp.abs(found[name] - wanted[name]))) for name in truth}


def run(
    out: Path,
    *,
    size: int = 96,
    steps: int = 40,
    seed: int = 0,
    noise: float = NOISE,
    progress: bool = False,
) -> dict[str, Any]:
    """Fit materials and lights; see the module's docstring for the result."""
    began = time.perf_counter()
    target = picture(TRUTH, size)
    grain = np.random.default_rng(seed).normal(size=target.shape)
    target = target + jnp.asarray(noise * grain, jnp.float32)
    start = start_of(TRUTH)
    result = dr.fit.least_squares(
        residuals,
        start,
        args=(target,),
        steps=steps,
        tolerance=1e-7,
        callback=Patience(),
        progress=progress,
    )
    values, unknown = identifiability(TRUTH, size)
    report = {
        "size": size,
        "noise": noise,
        "seed": seed,
        "parameters": len(values),
        "unidentifiable": unknown,
        "singular_values": values,
        "errors_at_start": errors_of(start, TRUTH),
        "errors": errors_of(result.params, TRUTH),
        "loss": result.loss,
        "renders": result.renders,
        "found": with_scale_fixed(result.params, TRUTH),
        "true": TRUTH,
        "seconds": time.perf_counter() - began,
    }
    save_json(out / "fit_materials.json", report)
    images = [target, picture(start, size), picture(result.params, size)]
    plot(out / "fit_materials.png", images, values, len(unknown))
    return report


def plot(path: Path, images: list[Array], values: np.ndarray, unknown: int) -> None:
    """Draw target, start, result and difference, and the singular values."""
    plt = pyplot()
    figure = plt.figure(figsize=(12, 6), layout="constrained")
    axes = figure.subplot_mosaic("abcd;eeee")
    show_fit([axes[place] for place in "abcd"], *images)
    known = len(values) - unknown
    axes["e"].semilogy(np.arange(known), values[:known], "o", label="identifiable")
    axes["e"].semilogy(
        np.arange(known, len(values)), np.maximum(values[known:], 1e-8), "rx", label="not"
    )
    axes["e"].set_xlabel("combination of parameters")
    axes["e"].set_ylabel("change of the picture for 100 %")
    axes["e"].legend(fontsize="small")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results/fit_materials"))
    parser.add_argument("--size", type=int, default=96, help="rows and columns of the picture")
    parser.add_argument("--steps", type=int, default=40, help="at most")
    parser.add_argument("--noise", type=float, default=NOISE, help="standard deviation a pixel")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    options = vars(parser.parse_args())
    report = run(options.pop("out"), progress=not options.pop("quiet"), **options)
    for name, error in report["errors"].items():
        print(f"{name}: error {error:.4f} (start {report['errors_at_start'][name]:.4f})")
    print(f"not identifiable: {len(report['unidentifiable'])} combinations")
    for item in report["unidentifiable"]:
        parts = ", ".join(f"{share:+.2f} {name}" for name, share in item["parameters"].items())
        print(f"  moved by noise {item['moved_by_noise']:.3g}: {parts}")
    print(f"{report['renders']} pictures with derivative, {report['seconds']:.0f} s")


if __name__ == "__main__":
    main()
