"""How long do rasterising and shading take, and how long compiling?

    python experiments/benchmark_raster.py [--size 512] [--repeats 30] [--out results/raster.json]

Scenes: spheres of 5,120 and 81,920 faces, 2,000 large random triangles in about 30 layers, a
height field of 131,072 faces. Each picture is checked before it is timed: every face id that the
rasteriser reports must cover its pixel. The minimum and the median over the repeats are printed;
`rasterize` is face ids, barycentrics and 1/w, `ids` the selection alone, `shade` deferred Phong
shading with a highlight of a fully covered image, `render` everything, with edges and without.
Compile times are of the
first call in a fresh process state (tracing and compiling, not running).
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import diffrast as dr
from diffrast.interpolate import interpolate_columns
from diffrast.light import normalize_columns
from diffrast.raster.coverage import visible_faces
from diffrast.shade import Reflectance, Surface, phong

Timing = dict[str, float]


def measure(function: Callable[..., Any], *arguments: Any, repeats: int) -> Timing:
    """Compile time in seconds, minimum and median run time in milliseconds."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - start
    jax.block_until_ready(compiled(*arguments))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append(1e3 * (time.perf_counter() - start))
    return {
        "minimum_ms": min(times),
        "median_ms": float(np.median(times)),
        "compile_s": compile_seconds,
    }


def scenes() -> dict[str, tuple[dr.Mesh, dr.Camera]]:
    """The benchmark's meshes, each with a camera that sees it whole."""
    ball = dr.Camera.perspective(
        eye=(1.2, 1.0, 3.0), target=(0, 0, 0), up=(0, 1, 0), fov_y=0.7, near=0.1, far=100
    )
    random = np.random.default_rng(0)
    centres = random.uniform(-1, 1, (2000, 1, 3))
    triangles = (centres + random.normal(0, 0.36, (2000, 3, 3))).reshape(-1, 3)
    soup = dr.Mesh(vertices=triangles, faces=np.arange(6000).reshape(-1, 3))
    grid = np.linspace(-1, 1, 257)
    x, z = np.meshgrid(grid, grid)
    heights = 0.15 * np.sin(5 * x) * np.cos(4 * z) + 0.05 * np.sin(13 * x + 9 * z)
    return {
        "sphere, 5,120 faces": (dr.shapes.icosphere(4), ball),
        "sphere, 81,920 faces": (dr.shapes.icosphere(6), ball),
        "2,000 large triangles": (
            soup,
            dr.Camera.perspective(
                eye=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), fov_y=0.7, near=0.1, far=100
            ),
        ),
        "height field, 131,072 faces": (
            dr.shapes.height_field(heights),
            dr.Camera.perspective(
                eye=(0, -2.2, 1.4), target=(0, 0, 0), up=(0, 0, 1), fov_y=0.7, near=0.1, far=100
            ),
        ),
    }


def check(positions_clip: jax.Array, faces: jax.Array, fragments: dr.Fragments) -> float:
    """Refuse a wrong picture; return the share of covered pixels."""
    face = np.asarray(fragments.face)
    covered = face >= 0
    barycentrics = np.asarray(fragments.barycentrics)[covered]
    # Snapping moves an edge by less than a thousandth of a pixel.
    if covered.mean() < 0.1 or barycentrics.min() < -0.05 or faces.shape[0] <= face.max():
        raise AssertionError("the rasteriser's picture is wrong; not timed")
    return float(covered.mean())


def run(size: int = 512, repeats: int = 30) -> dict[str, dict[str, Any]]:
    """Time every scene; returns the figures by scene and stage."""
    with_edges = dr.RenderSettings(height=size, width=size)
    without = dataclasses.replace(with_edges, antialias=False)
    results: dict[str, dict[str, Any]] = {}
    for name, (mesh, camera) in scenes().items():
        positions_clip = dr.world_to_clip(camera, mesh.vertices)
        fragments = dr.rasterize(positions_clip, mesh.faces, height=size, width=size)
        scene = dr.Scene(
            objects=[dr.Object(mesh, dr.Material(specular=(0.5, 0.5, 0.5)))],
            lights=[dr.DirectionalLight(direction=(-1, -1, -2), ambient=(0.1, 0.1, 0.1))],
        )
        layers = overdraw(positions_clip, mesh.faces)
        results[name] = {
            "covered": check(positions_clip, mesh.faces, fragments),
            "layers": layers,
            "ids": measure(
                lambda p, f: visible_faces(p, f, height=size, width=size, cull_backfaces=False),
                positions_clip,
                mesh.faces,
                repeats=repeats,
            ),
            "rasterize": measure(
                lambda p, f: dr.rasterize(p, f, height=size, width=size),
                positions_clip,
                mesh.faces,
                repeats=repeats,
            ),
            "render, no edges": measure(
                lambda s, c: dr.render(s, c, without), scene, camera, repeats=repeats
            ),
            "render": measure(
                lambda s, c: dr.render(s, c, with_edges), scene, camera, repeats=repeats
            ),
        }
    results["covered image"] = {"shade": measure(*shading(size), repeats=repeats)}
    return results


def shading(size: int) -> tuple[Any, ...]:
    """Deferred shading of a picture that is covered everywhere, and its arguments."""
    mesh = dr.shapes.icosphere(4)
    camera = dr.Camera.perspective(
        eye=(0, 0, 1.3), target=(0, 0, 0), up=(0, 1, 0), fov_y=0.5, near=0.1, far=10
    )
    fragments = dr.rasterize(
        dr.world_to_clip(camera, mesh.vertices), mesh.faces, height=size, width=size
    )
    if not bool((fragments.face >= 0).all()):
        raise AssertionError("the shading benchmark's view is not covered")
    barycentrics = [fragments.barycentrics[..., j] for j in range(3)]
    light = dr.DirectionalLight(direction=(-1, -1, -2), ambient=(0.1, 0.1, 0.1))
    material = dr.Material(specular=(0.5, 0.5, 0.5))

    def shade(
        mesh: dr.Mesh, face: jax.Array, barycentrics: list[jax.Array], eye: jax.Array
    ) -> list[jax.Array]:
        attributes = [*mesh.vertices.T, *mesh.normals.T]
        columns = interpolate_columns(attributes, mesh.faces, face, barycentrics)
        to_viewer, _ = normalize_columns([eye[i] - columns[i] for i in range(3)])
        reflectance = Reflectance(
            list(material.ambient),
            list(material.diffuse),
            list(material.specular),
            material.shininess,
        )
        return phong(Surface(columns[3:], columns[:3], to_viewer), reflectance, (light,))

    return shade, mesh, fragments.face, barycentrics, jnp.array([0.0, 0.0, 1.3])


def overdraw(positions_clip: jax.Array, faces: jax.Array) -> float:
    """Summed area of the triangles over that of the picture."""
    x, y, _, w = np.moveaxis(np.asarray(positions_clip)[np.asarray(faces)], -1, 0)
    x, y = x / w, y / w
    twice = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    return float(np.abs(twice).sum() / 8)


def table(results: dict[str, dict[str, Any]]) -> str:
    """The figures as a Markdown table: minimum (median) in milliseconds."""
    lines = ["| scene | stage | minimum ms | median ms | compile s |", "|---|---|---|---|---|"]
    for scene, stages in results.items():
        for stage, timing in stages.items():
            if isinstance(timing, dict):
                lines.append(
                    f"| {scene} | {stage} | {timing['minimum_ms']:.2f} |"
                    f" {timing['median_ms']:.2f} | {timing['compile_s']:.1f} |"
                )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=512, help="rows and columns of the picture")
    parser.add_argument("--repeats", type=int, default=30, help="timed runs of each stage")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    options = parser.parse_args()
    results = run(options.size, options.repeats)
    print(table(results))
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
