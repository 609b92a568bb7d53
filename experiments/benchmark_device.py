"""The whole pipeline on the device that JAX draws with: how fast, and does it see what a CPU sees?

    python experiments/benchmark_device.py [--sizes 64 512 1024] [--views 1 16 128 1024]

First, pixel by pixel, the face ids of each scene on the device and on the CPU. Then milliseconds
of the ids alone, of pictures and of gradients by the camera, the light's direction and the object's
place, with and without edges: of a sphere of 20,480 faces in all sizes, also over a floor on which
its shadow falls, and of the other scenes in the largest. Then views at 64² of a sphere of 5,120
faces at once, under `vmap`. Every number is a minimum, and what is timed ends when the result is
there; "first" is the first call in seconds.

Written to `--out`: `benchmark_device.json`, `.md` and `.png`.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from benchmark_raster import scenes
from benchmark_views import cameras, scene_of
from common import pyplot
from timing import benchmark_options, compiled, markdown, minimum_times, write_report

import diffrast as dr
from diffrast.raster.coverage import visible_faces

SIZES, VIEWS, VIEW_SIZE = (64, 512, 1024), (1, 16, 128, 1024), 64


def all_scenes() -> dict[str, tuple[dr.Mesh, dr.Camera]]:
    """Those of `benchmark_raster`, and the one that is timed in all sizes, first."""
    others = scenes()
    camera = others["sphere, 5,120 faces"][1]
    return {"sphere, 20,480 faces": (dr.shapes.icosphere(5), camera), **others}


def timed(job: Callable[[], Any], repeats: int) -> dict[str, float]:
    """The first call in seconds, and the fastest of the others in milliseconds."""
    start = time.perf_counter()
    jax.block_until_ready(job())
    first = time.perf_counter() - start
    return {"first_s": first, "ms": minimum_times({"": job}, repeats)[""]}


def different_ids(mesh: dr.Mesh, camera: dr.Camera, size: int) -> dict[str, int]:
    """Pixels that show a face, and those that show another one on the CPU."""
    ids = partial(visible_faces, height=size, width=size, cull_backfaces=False)
    arguments = dr.world_to_clip(camera, mesh.vertices), jnp.asarray(mesh.faces)
    here = np.asarray(ids(*arguments))
    cpu = jax.devices("cpu")[0]
    there = np.asarray(ids(*jax.device_put(jax.device_get(arguments), cpu)))
    return {"covered": int((there >= 0).sum()), "different": int((here != there).sum())}


def over_floor(scene: dr.Scene) -> dr.Scene:
    """The scene, and a floor under its first object on which the shadow of that falls."""
    (item,), (light,) = scene.objects, scene.lights
    low, high = jnp.min(item.mesh.vertices, axis=0), jnp.max(item.mesh.vertices, axis=0)
    foot = ((low + high) / 2).at[2].set(low[2])
    size = dr.linalg.scaling(4 * jnp.max(high - low))
    scaled = dr.linalg.compose(dr.linalg.translation(foot), size)
    floor = dr.Object(dr.shapes.plane(1.0, 1.0), transform=scaled)
    return dr.Scene(objects=[item, floor], lights=[replace(light, shadow=dr.Shadow())])


def picture(
    settings: dr.RenderSettings,
    shadow: bool,
    mesh: dr.Mesh,
    camera: dr.Camera,
    direction: Any = (-1.0, -1.0, -2.0),
    offset: Any = (0.0, 0.0, 0.0),
) -> jax.Array:
    scene = scene_of(mesh, direction, offset)
    return dr.render(over_floor(scene) if shadow else scene, camera, settings)


def gradient(settings: dr.RenderSettings, shadow: bool, mesh: dr.Mesh, camera: dr.Camera) -> Any:
    """Of the sum of squares, by the camera, the light's direction and the object's place."""

    def loss(*parameters: Any) -> jax.Array:
        return jnp.sum(picture(settings, shadow, mesh, *parameters) ** 2)

    return jax.grad(loss, (0, 1, 2))(camera, jnp.array([-1.0, -1, -2]), jnp.zeros(3))


def pipelines(
    size: int, antialias: bool, shadows: Sequence[bool]
) -> dict[str, Callable[[dr.Mesh, dr.Camera], Any]]:
    """What draws and differentiates, without and with shadows and edges."""
    kinds = {", no edges": dr.RenderSettings(height=size, width=size, antialias=False)}
    if antialias:
        kinds[""] = dr.RenderSettings(height=size, width=size)
    return {
        f"{what}{', shadow' if shadow else ''}{word}": partial(function, settings, shadow)
        for shadow in shadows
        for what, function in (("picture", picture), ("gradient", gradient))
        for word, settings in kinds.items()
    }


def stages(
    mesh: dr.Mesh, camera: dr.Camera, size: int, antialias: bool, shadows: Sequence[bool]
) -> dict[str, Callable[[], Any]]:
    """What is timed of one view."""
    ids = partial(visible_faces, height=size, width=size, cull_backfaces=False)
    clip, faces = dr.world_to_clip(camera, mesh.vertices), jnp.asarray(mesh.faces)
    jobs: dict[str, Callable[[], Any]] = {"ids": lambda: ids(clip, faces)}
    beside = jax.tree.map(lambda column: column[0], cameras(mesh, 1))  # the shadow is in view
    for what, function in pipelines(size, antialias, shadows).items():
        jobs[what] = compiled(function, mesh, beside if "shadow" in what else camera)
    return jobs


def many(
    mesh: dr.Mesh, count: int, size: int, antialias: bool, shadows: Sequence[bool]
) -> dict[str, Callable[[], Any]]:
    """What is timed of many views at once."""
    views = cameras(mesh, count)
    return {
        what: compiled(jax.vmap(function, (None, 0)), mesh, views)
        for what, function in pipelines(size, antialias, shadows).items()
    }


def run(
    out: Path,
    *,
    sizes: Sequence[int] = SIZES,
    views: Sequence[int] = VIEWS,
    view_size: int = VIEW_SIZE,
    repeats: int = 20,
    known: dict[str, tuple[dr.Mesh, dr.Camera]] | None = None,
    antialias: bool = True,
    shadows: Sequence[bool] = (False, True),
    progress: bool = False,
) -> dict[str, Any]:
    """Compare and measure; return what is written."""
    device = jax.devices()[0]
    report: dict[str, Any] = {"device": device.device_kind, "ids": [], "stages": [], "views": []}

    def add(part: str, row: dict[str, Any]) -> None:
        report[part].append(row)
        if progress:
            print(row, flush=True)

    known = known or all_scenes()
    first = next(iter(known))
    for size in sizes:
        for name, (mesh, camera) in known.items():
            add("ids", {"scene": name, "size": size, **different_ids(mesh, camera, size)})
    for name, (mesh, camera) in known.items():
        for size in sizes if name == first else sizes[-1:]:
            for what, job in stages(mesh, camera, size, antialias, shadows).items():
                if name == first or what in ("ids", "picture", "gradient"):
                    row = {"scene": name, "what": what, "size": size}
                    add("stages", row | timed(job, repeats))
    mesh = dr.shapes.icosphere(4)
    for count in views:
        for what, job in many(mesh, count, view_size, antialias, shadows).items():
            found = timed(job, repeats)
            row = {"what": what, "size": view_size, "views": count, **found}
            add("views", row | {"a_second": 1e3 * count / found["ms"]})
    write_report(out, "benchmark_device", report, table, plot)
    return report


def table(report: dict[str, Any]) -> str:
    """Ids, stages and views, and on which device."""
    parts = {
        "ids": ["scene", "size", "covered", "different"],
        "stages": ["scene", "what", "size", "first_s", "ms"],
        "views": ["what", "size", "views", "first_s", "ms", "a_second"],
    }
    tables = [
        markdown(header, [[row[key] for key in header] for row in report[part]])
        for part, header in parts.items()
    ]
    return "\n\n".join([*tables, f"Device: {report['device']}."])


def plot(report: dict[str, Any], path: Path) -> None:
    """Milliseconds over the pixels of one view, and views a second over their number."""
    plt, first = pyplot(), report["ids"][0]["scene"]
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, part, x, y in zip(
        axes, ("stages", "views"), ("size", "views"), ("ms", "a_second"), strict=True
    ):
        lines: dict[str, list[dict[str, Any]]] = {}
        for row in report[part]:
            if row.get("scene", first) == first:
                lines.setdefault(row["what"], []).append(row)
        for what, rows in lines.items():
            axis.loglog([row[x] for row in rows], [row[y] for row in rows], "o-", label=what)
        axis.set_xlabel({"size": "rows of pixels", "views": "views at once"}[x])
        axis.set_ylabel({"ms": "milliseconds", "a_second": "views a second"}[y])
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small")
    figure.suptitle(report["device"])
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = benchmark_options(__doc__, "benchmark_device", repeats=20)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--views", type=int, nargs="+", default=VIEWS)
    options = vars(parser.parse_args())
    print(table(run(options.pop("out"), progress=not options.pop("quiet"), **options)))


if __name__ == "__main__":
    main()
