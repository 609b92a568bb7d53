"""Can a sphere become a shape that is known from pictures alone?

    python experiments/fit_shape.py
    python experiments/fit_shape.py --compare

All 2562 vertices of a sphere are fitted to twelve shaded views of a body with six knobs and hollows
between them, whose radius is a formula of the direction. The views are rendered from a much finer
mesh with 16 samples a pixel; cameras, lights and material are known. The loss is the mean squared
difference of the pictures, and nothing else: the mesh stays smooth because Adam moves not the
vertices v but u = (I + smoothness L) v with the Laplacian L of the mesh (Nicolet, Jacobson, Jakob:
"Large Steps in Inverse Rendering of Geometry", 2021).

The error is the distance of the vertices from the body's surface, in percent of its mean radius.
`--compare` fits once more without the derivative through what is visible (`antialias=False`).

Expected: from 12 % at the start to 0.17 % on average and 1.1 % at most, in a minute or two on two
cores; the largest errors lie in the hollows, where few views look. From the shading alone the loss
falls by a fifth and then rises above that of the start: nothing tells the outlines where to move.

Written to `--out`: `fit_shape.json` with loss and errors of every step, `fit_shape.png` with some
of the views (target, start, results) and the same curves.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from common import exact_settings, pyplot, save_json
from jax import Array

import diffrast as dr

METHODS = ("visibility", "shading only")
START_RADIUS = 0.7
VIEWS_SHOWN = 4
MATERIAL = dr.Material(diffuse=(0.8, 0.8, 0.8))
LIGHTS = (
    dr.DirectionalLight(direction=(-0.6, -0.5, -1.0), diffuse=(0.9, 0.5, 0.3), ambient=[0.1] * 3),
    dr.DirectionalLight(direction=(0.8, -0.4, 0.6), diffuse=(0.2, 0.6, 0.7)),
    dr.DirectionalLight(direction=(0.1, 1.0, 0.2), diffuse=(0.3, 0.3, 0.5)),
)


def body_radius(direction: Array) -> Array:
    """Distance of the surface from the centre along unit vectors (..., 3)."""
    x, y, z = jnp.moveaxis(direction, -1, 0)
    return 0.35 + 0.65 * (x**4 + y**4 + z**4) + 0.1 * jnp.sin(3 * x + 2 * y - z)


def body(subdivisions: int) -> dr.Mesh:
    """Return a mesh of the shape to be found, its vertices on the surface."""
    unit = dr.shapes.icosphere(subdivisions)
    vertices = unit.vertices * body_radius(unit.vertices)[:, None]
    return dataclasses.replace(unit, vertices=vertices, normals=None)


@jax.jit
def distances(points: Array) -> Array:
    """Distances of points (n, 3) from the surface, to first order: |f| / |gradient of f|."""

    def beyond(point: Array) -> Array:
        return dr.linalg.norm(point) - body_radius(dr.linalg.normalize(point))

    value, gradient = jax.vmap(jax.value_and_grad(beyond))(points)
    return jnp.abs(value) / dr.linalg.norm(gradient)


def cameras_around(count: int) -> dr.Camera:
    """Cameras evenly spread over a sphere (Fibonacci's spiral), stacked."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    across = np.sqrt(1 - height**2)
    eyes = 4 * np.stack([across * np.cos(angle), height, across * np.sin(angle)], axis=1)
    return dr.stack_cameras(
        [
            dr.Camera.perspective(eye=eye, target=(0, 0, 0), fov_y=0.6, near=1, far=10)
            for eye in eyes
        ]
    )


@jax.jit
def pictures(mesh: dr.Mesh, cameras: dr.Camera, settings: dr.RenderSettings) -> Array:
    """Render all views, one after another."""
    scene = dr.Scene(objects=[dr.Object(mesh, MATERIAL)], lights=LIGHTS)
    return jax.lax.map(lambda camera: dr.render(scene, camera, settings), cameras)


def smoothing_matrix(mesh: dr.Mesh, smoothness: float) -> np.ndarray:
    """I + smoothness L, where L sums a vertex's differences from its neighbours."""
    count = mesh.vertices.shape[0]
    first, second = dr.mesh.edge_adjacency(mesh.vertices, mesh.faces).edges.T
    laplacian = np.zeros((count, count))
    laplacian[first, second] = laplacian[second, first] = -1
    laplacian -= np.diag(laplacian.sum(axis=1))
    return np.eye(count) + smoothness * laplacian


def image_loss(
    coordinates: Array,
    inverse: Array,
    sphere: dr.Mesh,
    cameras: dr.Camera,
    targets: Array,
    settings: dr.RenderSettings,
) -> Array:
    """Mean squared difference of the pictures; the vertices are `inverse @ coordinates`."""
    mesh = dataclasses.replace(sphere, vertices=inverse @ coordinates)
    return jnp.mean((pictures(mesh, cameras, settings) - targets) ** 2)


def fit(
    sphere: dr.Mesh,
    cameras: dr.Camera,
    targets: Array,
    *,
    antialias: bool,
    smoothness: float,
    steps: int,
    rate: float,
    progress: bool,
) -> tuple[dr.Mesh, dict[str, Any]]:
    """Return the fitted mesh, and the errors, seconds and curves of the fit."""
    height, width = targets.shape[1:3]
    settings = dr.RenderSettings(height=height, width=width, antialias=antialias)
    matrix = smoothing_matrix(sphere, smoothness)
    inverse = jnp.asarray(np.linalg.inv(matrix), jnp.float32)
    result = dr.fit.minimize(
        image_loss,
        jnp.asarray(matrix @ np.asarray(sphere.vertices), jnp.float32),
        args=(inverse, sphere, cameras, targets, settings),
        optimizer=optax.adam(optax.cosine_decay_schedule(rate, steps)),
        steps=steps,
        record_params=True,
        progress=progress,
    )
    percent = 100 / jnp.mean(body_radius(dr.shapes.icosphere(5).vertices))
    errors = [percent * distances(inverse @ params) for params in result.history.params]
    trace = {
        "loss": result.history.loss,
        "mean_percent": np.array([jnp.mean(error) for error in errors]),
        "max_percent": np.array([jnp.max(error) for error in errors]),
    }
    best = int(np.argmin(result.history.loss))
    report = {
        "at_start": {name: values[0] for name, values in trace.items()},
        "found": {name: values[best] for name, values in trace.items()},
        "seconds": result.seconds,
        "trace": trace,
    }
    return dataclasses.replace(sphere, vertices=inverse @ result.params), report


def run(
    out: Path,
    *,
    size: int = 128,
    views: int = 12,
    subdivisions: int = 4,
    steps: int = 250,
    rate: float = 0.1,
    smoothness: float = 20.0,
    compare: bool = False,
    progress: bool = False,
) -> dict[str, Any]:
    """Fit the sphere; see the module's docstring for the result."""
    cameras = cameras_around(views)
    exact = exact_settings(size)
    targets = pictures(body(5), cameras, exact)
    sphere = dataclasses.replace(dr.shapes.icosphere(subdivisions, START_RADIUS), normals=None)
    meshes, fits = {"start": sphere}, {}
    for name in METHODS[: 1 + compare]:
        meshes[name], fits[name] = fit(
            sphere,
            cameras,
            targets,
            antialias=name == "visibility",
            smoothness=smoothness,
            steps=steps,
            rate=rate,
            progress=progress,
        )
    report = {"size": size, "views": views, "vertices": sphere.vertices.shape[0], "fits": fits}
    save_json(out / "fit_shape.json", report)
    rows = {name: pictures(mesh, cameras, exact) for name, mesh in meshes.items()}
    plot(out / "fit_shape.png", {"target": targets, **rows}, fits)
    return report


def plot(path: Path, rows: dict[str, Array], fits: dict[str, Any]) -> None:
    """Draw the first views of the target and of every mesh, and loss and error by step."""
    plt = pyplot()
    sheet = np.concatenate([np.concatenate([*row[:VIEWS_SHOWN]], axis=1) for row in rows.values()])
    size = sheet.shape[0] / len(rows)
    figure = plt.figure(figsize=(12, 1.6 * len(rows)), layout="constrained")
    axes = figure.subplot_mosaic("aab;aac")
    axes["a"].imshow(np.clip(dr.color.linear_to_srgb(sheet), 0, 1))
    axes["a"].set_yticks(size * (np.arange(len(rows)) + 0.5), list(rows), rotation=90, va="center")
    axes["a"].set_xticks([])
    for name, fitted in fits.items():
        axes["b"].semilogy(fitted["trace"]["loss"], label=name)
        line = axes["c"].semilogy(fitted["trace"]["mean_percent"], label=f"{name}, mean")[0]
        axes["c"].semilogy(
            fitted["trace"]["max_percent"], ":", color=line.get_color(), label=f"{name}, largest"
        )
    axes["b"].set_ylabel("loss")
    axes["c"].set_ylabel("distance (% of radius)")
    axes["c"].set_xlabel("step")
    for axis in (axes["b"], axes["c"]):
        axis.legend(fontsize="small")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results/fit_shape"))
    parser.add_argument("--size", type=int, default=128, help="rows and columns of the pictures")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--subdivisions", type=int, default=4, help="of the icosphere")
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--rate", type=float, default=0.1, help="step size of Adam at the start")
    parser.add_argument("--smoothness", type=float, default=20.0, help="weight of the Laplacian")
    parser.add_argument(
        "--compare", action="store_true", help="fit without the derivative of visibility too"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    options = vars(parser.parse_args())
    report = run(options.pop("out"), progress=not options.pop("quiet"), **options)
    for name, fitted in report["fits"].items():
        start, found = fitted["at_start"], fitted["found"]
        print(
            f"{name}: distance from the surface {found['mean_percent']:.2f} % of the radius on"
            f" average (start {start['mean_percent']:.2f}), at most {found['max_percent']:.2f} %"
            f" (start {start['max_percent']:.2f}), {fitted['seconds']:.0f} s"
        )


if __name__ == "__main__":
    main()
