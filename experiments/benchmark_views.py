"""How many pictures and gradients a second, for one view and for thousands?

    python experiments/benchmark_views.py [--quick] [--repeats 5]

The teapot and a sphere of 5,120 faces, with edges, seen from all round: first by a compiled call of
`render`, one view after another, then through `stream_views` (pictures, each forgotten when it has
come) and `sum_views` (the gradient of a sum by light and object pose). "gain" is the time of a
single call over that of a view among many. Also measured: the peak of memory, which grows with the
chunk and not with the views; the gain of all cores over one; and that pictures and gradients have
the same bits for chunks of 1, 3 and 16 views and on 1, 2, 4 and 8 devices, made of the CPU.

Expected: on two cores a gain of 1.9 to 2.6 at 64 x 64 and of 1.5 to 2.3 at 256 x 256; a call for
one view takes one or two milliseconds more than `render`.

Written to `--out`: `benchmark_views.json`, `.md` and `.png`. Ten minutes on two cores.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import pyplot
from orbit import orbit_cameras
from timing import benchmark_options, compiled, markdown, minimum_times, write_report

import diffrast as dr

MESHES: dict[str, Callable[[], dr.Mesh]] = {
    "teapot": partial(dr.shapes.teapot, 8),
    "sphere": partial(dr.shapes.icosphere, 4),
}
COUNTS = {64: (1, 16, 256, 4096), 256: (1, 16, 256, 4096)}
GRADIENTS = {64: (1, 16, 256), 256: (1, 16)}
QUICK = {16: (1, 2)}
CHUNKS, DEVICES = (1, 3, 16), (1, 2, 4, 8)


def cameras(mesh: dr.Mesh, count: int) -> dr.Camera:
    """A circle round a mesh that fills the picture's height, or nearly."""
    return orbit_cameras(mesh, count, elevation=0.5, distance=2.0)


def scene_of(mesh: dr.Mesh, direction: Any, offset: Any) -> dr.Scene:
    item = dr.Object(mesh, dr.Material(specular=(0.5,) * 3), dr.linalg.translation(offset))
    light = dr.DirectionalLight(direction=direction, ambient=(0.1,) * 3)
    return dr.Scene(objects=[item], lights=[light])


PARAMETERS = (np.float32([-1, -1, -2]), np.zeros(3, np.float32))
Shared = tuple[dr.Mesh, dr.RenderSettings, tuple[Any, Any]]


def picture(shared: Shared, view: dr.Camera) -> jax.Array:
    mesh, settings, parameters = shared
    return dr.render(scene_of(mesh, *parameters), view, settings)


def gradient(shared: Shared, view: dr.Camera) -> Any:
    """Of the sum of squares by the light's direction and the object's place."""
    mesh, settings, parameters = shared

    def loss(parameters: tuple[Any, Any]) -> jax.Array:
        return jnp.sum(picture((mesh, settings, parameters), view) ** 2)

    return jax.grad(loss)(parameters)


def shared_of(mesh: dr.Mesh, size: int, antialias: bool = True) -> Shared:
    settings = dr.RenderSettings(height=size, width=size, antialias=antialias)
    return mesh, settings, PARAMETERS


def forgotten(shared: Shared, views: dr.Camera) -> None:
    """Draw views and keep none."""
    for _ in dr.views.stream_views(picture, views, shared):
        pass


def jobs_of(
    mesh: dr.Mesh, size: int, counts: Any, gradients: Any, antialias: bool = True
) -> dict[Any, Any]:
    """What is timed: pairs (kind, number of views), where 0 is a single call."""
    shared = shared_of(mesh, size, antialias)
    one = jax.tree.map(lambda x: x[0], cameras(mesh, 1))
    jobs: dict[Any, Callable[[], Any]] = {
        ("picture", 0): compiled(picture, shared, one),
        ("gradient", 0): compiled(gradient, shared, one),
    }
    for count in counts:
        jobs["picture", count] = partial(forgotten, shared, cameras(mesh, count))
    for count in gradients:
        views = cameras(mesh, count)
        jobs["gradient", count] = partial(dr.views.sum_views, gradient, views, shared)
    return jobs


def peak_megabytes() -> float:
    """The most that this process has had in memory; on Unix."""
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def throughput(
    meshes: dict[str, Callable[[], dr.Mesh]],
    counts: dict[int, Any],
    gradients: dict[int, Any],
    repeats: int,
    *,
    antialias: bool,
    progress: bool,
) -> list[dict[str, Any]]:
    """Milliseconds a view, by mesh, size, kind and number of views."""
    rows = []
    for name, make in meshes.items():
        mesh = make()
        for size in counts:
            jobs = jobs_of(mesh, size, counts[size], gradients[size], antialias)
            times = minimum_times(jobs, repeats)
            for (kind, count), time in times.items():
                if count:
                    single = times[kind, 0]
                    row = {"mesh": name, "size": size, "kind": kind, "views": count}
                    row |= {"single_ms": single, "ms": time / count, "gain": count * single / time}
                    rows.append(row)
                    if progress:
                        print(row, flush=True)
    return rows


def memory(size: int, *counts: int) -> dict[str, float]:
    """Peaks after pictures of a few views, and then of more."""
    mesh, found = MESHES["sphere"](), {}
    for count in counts:
        forgotten(shared_of(mesh, size), cameras(mesh, count))
        found[f"{count} views of {size}²"] = peak_megabytes()
    return found


def cores_gain(size: int, count: int, repeats: int) -> dict[str, float]:
    """Milliseconds a view on the cores that this process may use."""
    mesh = MESHES["sphere"]()
    times = minimum_times(jobs_of(mesh, size, [count], [count]), repeats)
    return {kind: times[kind, count] / count for kind in ("picture", "gradient")}


def same_bits(size: int, count: int) -> dict[str, list[int]]:
    """Compare pictures and gradients of all chunks and devices.

    Raises:
        AssertionError: if a bit differs.
    """
    mesh = MESHES["sphere"]()
    shared, views = shared_of(mesh, size), cameras(mesh, count)
    want = np.asarray(dr.views.map_views(picture, views, shared))
    sums = dr.views.sum_views(gradient, views, shared)
    for chunk in CHUNKS:
        got = dr.views.map_views(picture, views, shared, chunk=chunk)
        np.testing.assert_array_equal(got, want)
    for number in DEVICES:
        devices = jax.devices()[:number]
        got = dr.views.map_views(picture, views, shared, devices=devices)
        np.testing.assert_array_equal(got, want)
        total = dr.views.sum_views(gradient, views, shared, devices=devices)
        jax.tree.map(np.testing.assert_array_equal, total, sums)
    return {"chunks": list(CHUNKS), "devices": list(DEVICES)}


PARTS: dict[str, Callable[..., Any]] = {"cores": cores_gain, "bits": same_bits, "memory": memory}


def elsewhere(part: str, *arguments: Any, cores: int | None = None) -> Any:
    """What a part finds in a process of its own, on so many cores."""
    call = [sys.executable, __file__, "--part", part, json.dumps(arguments), str(cores or 0)]
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": str(max(DEVICES) if part == "bits" else 1)}
    done = subprocess.run(call, check=True, stdout=subprocess.PIPE, env=environment)
    return json.loads(done.stdout)


def run(
    out: Path,
    *,
    meshes: dict[str, Callable[[], dr.Mesh]] = MESHES,
    counts: dict[int, Any] = COUNTS,
    gradients: dict[int, Any] = GRADIENTS,
    repeats: int = 5,
    antialias: bool = True,
    elsewhere_too: bool = hasattr(os, "sched_setaffinity"),
    progress: bool = False,
) -> dict[str, Any]:
    """Measure, if wanted also what needs own processes (on Linux); return what is written."""
    report: dict[str, Any] = {}
    if elsewhere_too:
        small, large, cores = min(counts), max(counts), len(os.sched_getaffinity(0))
        report = {
            "same_bits": elsewhere("bits", small, 2 * max(DEVICES) + 3),
            "peak_megabytes": elsewhere("memory", large, *counts[large][1:]),
            "cores": {n: elsewhere("cores", small, 64, repeats, cores=n) for n in (1, cores)},
        }
    report["throughput"] = throughput(
        meshes, counts, gradients, repeats, antialias=antialias, progress=progress
    )
    write_report(out, "benchmark_views", report, table, plot)
    return report


def table(report: dict[str, Any]) -> str:
    """Times, then the rest in words."""
    header = ["mesh", "size", "what", "views", "single call ms", "ms a view", "gain", "a second"]
    rows = []
    for row in report["throughput"]:
        words = [row["mesh"], f"{row['size']}²", row["kind"], row["views"]]
        rows.append([*words, row["single_ms"], row["ms"], row["gain"], 1e3 / row["ms"]])
    lines = [markdown(header, rows), ""]
    if "cores" in report:
        one, *_, all_ = report["cores"].values()
        gains = ", ".join(f"{kind} {one[kind] / all_[kind]:.2f}" for kind in one)
        lines.append(f"{max(report['cores'])} cores over one: {gains}.")
        peaks = [f"{name} {peak:.0f}" for name, peak in report["peak_megabytes"].items()]
        lines.append(f"Peak of memory, MB: {', '.join(peaks)}.")
        same = report["same_bits"]
        lines.append(f"Same bits for chunks of {same['chunks']} and on {same['devices']} devices.")
    return "\n".join(lines)


def plot(report: dict[str, Any], path: Path) -> None:
    """Views a second over their number; dashed for single calls."""
    plt = pyplot()
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, kind in zip(axes, ("picture", "gradient"), strict=True):
        lines: dict[tuple[str, int], list[dict[str, Any]]] = {}
        for row in report["throughput"]:
            if row["kind"] == kind:
                lines.setdefault((row["mesh"], row["size"]), []).append(row)
        for (mesh, size), rows in lines.items():
            rate = [1e3 / row["ms"] for row in rows]
            (line,) = axis.loglog(
                [row["views"] for row in rows], rate, "o-", label=f"{mesh} {size}²"
            )
            axis.axhline(1e3 / rows[0]["single_ms"], ls="--", lw=1, color=line.get_color())
        axis.set_xlabel("views in one call")
        axis.set_ylabel(f"{kind}s a second")
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = benchmark_options(__doc__, "benchmark_views", repeats=5)
    parser.add_argument("--quick", action="store_true", help="few and small")
    parser.add_argument("--part", nargs=3, help=argparse.SUPPRESS)
    options = vars(parser.parse_args())
    part = options.pop("part")
    if part is not None:
        name, arguments, cores = part
        if cores != "0":  # before the backend starts, which takes what it may
            os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(cores)])
        print(json.dumps(PARTS[name](*json.loads(arguments))))
        return
    if options.pop("quick"):
        options |= {"counts": QUICK, "gradients": QUICK, "antialias": False}
    print(table(run(options.pop("out"), progress=not options.pop("quiet"), **options)))


if __name__ == "__main__":
    main()
