"""How far is each stage of the renderer from what the machine could do?

    python experiments/benchmark_stages.py [--size 512] [--repeats 30]

Each stage runs alone, on arrays that lie in memory, as the renderer runs it: vertices to clip
space, face ids, barycentrics, the same with normals and positions, Phong shading with a
highlight, edges, a shadow map and its look-up; and each that is differentiable once more with its
pull-back of a random cotangent ("both"). A stage's bound is the larger of two times: the bytes that
it must read and write once over the speed at which the same compiler copies a picture, and its
multiply-adds (an estimate: 60 a face, 10 a tested pixel and face, and what shading a point takes)
over the speed of a long polynomial on an array in the cache.

Expected: 1 would be perfect; stages near 2 are limited by memory, and one far above the others is
where work is lost.

Written to `--out`: `benchmark_stages.json`, `.md` and `.png`.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from benchmark_raster import check, overdraw, scenes
from common import pyplot
from timing import benchmark_options, compiled, markdown, minimum_times, write_report

import diffrast as dr
from diffrast.geometry import clip_positions, draw, visible_points, world_geometry
from diffrast.raster.coverage import faces_and_depths, visible_faces
from diffrast.raster.evaluate import Drawn, all_pixels, evaluate
from diffrast.shade import Reflectance, Surface, phong
from diffrast.shadows import cast, receive

SHADOW_SIZE = 512
FLOAT = 4  # bytes
STEPS, SMALL = 512, 1 << 14  # of a polynomial, and of the array that it is evaluated on


class Stage(NamedTuple):
    """A stage alone.

    Attributes:
        function: of the arguments.
        arguments: the differentiable ones first.
        traffic: bytes that must be read and written once.
        multiply_adds: that must be done.
        differentiable: how many of the arguments.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    traffic: float
    multiply_adds: float
    differentiable: int = 0


def stages(mesh: dr.Mesh, camera: dr.Camera, size: int) -> dict[str, Stage]:
    """The stages of one picture, each with what the ones before it made."""
    light = dr.DirectionalLight(
        direction=(-1, -1, -2), ambient=(0.1, 0.1, 0.1), shadow=dr.Shadow(resolution=SHADOW_SIZE)
    )
    material = dr.Material(specular=(0.5, 0.5, 0.5))
    scene = dr.Scene(objects=[dr.Object(mesh, material)], lights=[light])
    geometry = world_geometry(scene, "phong")
    clip = clip_positions(geometry, camera)
    points = visible_points(*draw(scene, geometry, camera, clip, size, size, cull_backfaces=False))
    fragments = dr.rasterize(clip, mesh.faces, height=size, width=size)
    covered = check(clip, mesh.faces, fragments) * size**2
    vertices, faces, pixels = mesh.vertices.shape[0], mesh.faces.shape[0], float(size**2)
    tested = overdraw(clip, mesh.faces) * pixels
    shadows, _ = jax.jit(cast)(scene.lights, geometry, mesh.topology.neighbors, points)
    map_clip = dr.world_to_clip(camera, mesh.vertices)

    def see(p: jax.Array, face: jax.Array, attributes: tuple[jax.Array, ...]) -> Any:
        return evaluate(Drawn(p, mesh.faces, attributes), all_pixels(face, p.dtype))

    columns = [*points.normal, *points.position]

    def shade(columns: list[jax.Array], to_viewer: list[jax.Array]) -> list[jax.Array]:
        reflectance = Reflectance(
            list(material.ambient),
            list(material.diffuse),
            list(material.specular),
            material.shininess,
        )
        return phong(Surface(columns[:3], columns[3:], to_viewer), reflectance, (light,))

    wide = dr.rasterize(clip, mesh.faces, height=size, width=size, border=1)
    image = jnp.where(wide.face[..., None] >= 0, 0.5 + 0.5 * wide.barycentrics, 0)

    def antialias(image: jax.Array, clip: jax.Array, face: jax.Array) -> jax.Array:
        return dr.antialias(image, clip, mesh.faces, face, topology=mesh.topology)

    def look_up(points: Any, shadows: Any) -> Any:
        return receive(scene.lights, shadows, points)

    return {
        "vertices to clip space": Stage(
            lambda v, m: dr.world_to_clip(dr.Camera(view=m, projection=camera.projection), v),
            (mesh.vertices, camera.view),
            FLOAT * 7 * vertices,
            16 * vertices,
            2,
        ),
        "face ids": Stage(
            lambda p, f: visible_faces(p, f, height=size, width=size, cull_backfaces=False),
            (clip, mesh.faces),
            FLOAT * (4 * vertices + 3 * faces + pixels),
            60 * faces + 10 * tested,
        ),
        "barycentrics, 1/w": Stage(
            lambda p, face: see(p, face, ())[:2],
            (clip, points.face),
            FLOAT * (4 * vertices + 3 * faces + 5 * pixels),
            30 * covered,
            1,
        ),
        "with normals and positions": Stage(
            lambda attributes, p, face: see(p, face, attributes),
            ((geometry.normals, geometry.positions), clip, points.face),
            FLOAT * (10 * vertices + 3 * faces + 11 * pixels),
            48 * covered,
            2,
        ),
        "Phong shading": Stage(
            shade, (columns, columns[3:]), FLOAT * (6 + 3) * pixels, 90 * pixels, 2
        ),
        "edges": Stage(
            antialias, (image, clip, wide.face), FLOAT * (4 * vertices + 7 * pixels), 0, 2
        ),
        "shadow map": Stage(
            lambda p, f: faces_and_depths(p, f, size=SHADOW_SIZE),
            (map_clip, mesh.faces),
            FLOAT * (4 * vertices + 3 * faces + 2 * SHADOW_SIZE**2),
            60 * faces + 10 * tested * SHADOW_SIZE**2 / pixels,
        ),
        "shadow look-up": Stage(
            look_up,
            (points, shadows),
            FLOAT * (9 * pixels + SHADOW_SIZE**2),
            40 * covered,
        ),
    }


def with_pull_back(stage: Stage) -> Callable[[], Any]:
    """A job: the stage and its derivative for one random cotangent."""
    count = stage.differentiable
    shapes = jax.eval_shape(stage.function, *stage.arguments)
    random = np.random.default_rng(0)
    cotangent = jax.tree.map(lambda s: jnp.asarray(random.normal(size=s.shape), s.dtype), shapes)

    def both(cotangent: Any, *arguments: Any) -> Any:
        def free(*some: Any) -> Any:
            return stage.function(*some, *arguments[count:])

        value, pull = jax.vjp(free, *arguments[:count])
        return value, pull(cotangent)

    return compiled(both, cotangent, *stage.arguments)


def yardsticks(size: int) -> dict[str, Callable[[], Any]]:
    """Jobs that only move data, as many as a stage does, and that only multiply and add."""

    def polynomial(x: jax.Array) -> jax.Array:
        y = x
        for _ in range(STEPS):
            y = y * x + x
        return y

    moved = jnp.ones((4, size, size))
    return {
        "copy": compiled(lambda x: x + 1, moved),
        "polynomial": compiled(polynomial, jnp.full(SMALL, 0.5)),
    }


def run(
    out: Path,
    *,
    size: int = 512,
    repeats: int = 30,
    only: Sequence[str] | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Time every stage of the scenes; returns what is written."""
    report: dict[str, Any] = {"size": size, "repeats": repeats, "scenes": {}}
    for name, (mesh, camera) in scenes().items():
        if only is not None and name not in only:
            continue
        found = stages(mesh, camera, size)
        jobs = {(key, "alone"): compiled(s.function, *s.arguments) for key, s in found.items()}
        jobs |= {(key, "both"): with_pull_back(s) for key, s in found.items() if s.differentiable}
        jobs |= {(key, "machine"): job for key, job in yardsticks(size).items()}
        times = minimum_times(jobs, repeats)
        if progress:
            print("timed:", name, flush=True)
        report["scenes"][name] = {}
        for key, stage in found.items():
            memory = stage.traffic / (8 * FLOAT * size**2) * times["copy", "machine"]
            arithmetic = stage.multiply_adds / (STEPS * SMALL) * times["polynomial", "machine"]
            bound = max(memory, arithmetic)
            report["scenes"][name][key] = {
                "ms": times[key, "alone"],
                "both_ms": times.get((key, "both")),
                "bytes": stage.traffic,
                "multiply_adds": stage.multiply_adds,
                "bound_ms": bound,
                "bound_by": "memory" if bound == memory else "arithmetic",
                "ratio": times[key, "alone"] / bound,
            }
    write_report(out, "benchmark_stages", report, table, plot)
    return report


def table(report: dict[str, Any]) -> str:
    """Each stage's time, bound and their ratio."""
    header = ["scene", "stage", "ms", "with derivative", "bound ms", "by", "ms / bound"]
    return markdown(
        header,
        [
            [scene, name, s["ms"], s["both_ms"] or "", s["bound_ms"], s["bound_by"], s["ratio"]]
            for scene, by_stage in report["scenes"].items()
            for name, s in by_stage.items()
        ],
    )


def plot(report: dict[str, Any], path: Path) -> None:
    """Times of the stages over their bounds."""
    plt = pyplot()
    scenes = report["scenes"]
    figure, axes = plt.subplots(
        1, len(scenes), figsize=(4 * len(scenes) + 2, 4), squeeze=False, layout="constrained"
    )
    for axis, (scene, by_stage) in zip(axes[0], scenes.items(), strict=True):
        place = np.arange(len(by_stage))
        for key, label, width in (
            ("both_ms", "with derivative", 0.8),
            ("ms", "alone", 0.6),
            ("bound_ms", "bound", 0.4),
        ):
            axis.barh(place, [s[key] or 0 for s in by_stage.values()], width, label=label)
        axis.set_yticks(place, list(by_stage) if axis is axes[0, 0] else [""] * len(by_stage))
        axis.invert_yaxis()
        axis.set_xscale("log")
        axis.set_xlabel(f"ms, {report['size']}² pixels")
        axis.set_title(scene)
    axes[0, -1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = benchmark_options(__doc__, "benchmark_stages", repeats=30)
    parser.add_argument("--size", type=int, default=512, help="rows and columns of the picture")
    parser.add_argument("--only", nargs="+", metavar="SCENE", help="names of scenes")
    options = vars(parser.parse_args())
    print(table(run(options.pop("out"), progress=not options.pop("quiet"), **options)))


if __name__ == "__main__":
    main()
