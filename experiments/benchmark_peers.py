"""How fast and how exact is diffrast next to other renderers?

    python experiments/benchmark_peers.py [--quick] [--sizes 256 512 1024] [--repeats 10]

The peers come ready built from the package index (`pip install 'diffrast[peers]'`): DEODR, Mitsuba
3 (llvm_ad_rgb; needs an LLVM library) and Mesa's llvmpipe through moderngl (needs libEGL). One that
is not installed is named, and left out. Each draws five meshes under one directional light, as its
users would (`peers.py`): "forward" ends with the picture on the host, "both" with the derivative of
a squared difference by camera pose, light and object translation, through visible edges where the
renderer can do that (diffrast and DEODR; Mitsuba differentiates the interior only). What is made
once is not timed. Before that, all must have drawn the same picture: one that covers other pixels,
or has other colours, raises. Peers take turns within the repeats, and the minimum counts.

At one size pictures are compared with diffrast's of 256 samples a pixel, jagged ones included, and
the derivatives by the pose, of a sum weighted by a smooth random field, with central differences of
such pictures. DEODR, which has no highlights, is compared with pictures of its own kind.

diffren and jaxrenderer need another version of JAX than diffrast, PyTorch3D is not ready built:
`EARLIER` holds what they once took on such a machine (two cores, no GPU).

Written to `--out`: `benchmark_peers.json`, `.md` (the tables) and `.png` (times over sizes).
Expected: diffrast's pictures are the most exact ones, and its derivative that of the spheres; see
the README for times. A full run takes half an hour to an hour on two cores, most of it compilation.
"""

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import peers
import renderer
from benchmark_raster import scenes as benchmark_scenes
from common import pyplot, save_json
from exactness import qualities
from renderer import Peer, Task, in_floats
from timing import benchmark_options, markdown, minimum_times, three_digits

import diffrast as dr

# Forward, and forward with derivative, in milliseconds at 256², 512² and 1024², measured on another
# day on two cores without a GPU, jax 0.10. "splat" has the derivative through visible edges.
# PyTorch3D took 1,000 to 50,000 ms on the same scenes, jaxrenderer 4,000 to 23,000.
EARLIER = {
    "sphere, 5,120 faces": {
        "diffren": ((7.6, 16), (43, 83), (179, 351)),
        "diffren splat": ((11, 48), (71, 220), (274, 985)),
    },
    "sphere, 81,920 faces": {
        "diffren": ((15, 85), (57, 137), (217, 398)),
        "diffren splat": ((18, 60), (78, 225), (301, 998)),
    },
    "teapot": {
        "diffren": ((6.4, 15), (38, 86), (154, 327)),
        "diffren splat": ((11, 53), (66, 213), (264, 1016)),
    },
    "2,000 large triangles": {
        "diffren": ((33, 38), (131, 171), (503, 678)),
        "diffren splat": ((35, 77), (160, 309), (610, 1330)),
    },
    "height field, 131,072 faces": {
        "diffren": ((15, 118), (59, 176), (180, 409)),
        "diffren splat": ((19, 65), (89, 244), (286, 1008)),
    },
}
OWN: tuple[type[Peer], ...] = (renderer.Diffrast, renderer.DiffrastInterior)


def tasks(size: int) -> dict[str, Task]:
    """The benchmark's scenes; every face is turned to the viewer where both sides can be seen."""
    found = {}
    for name, (mesh, camera) in benchmark_scenes().items():
        closed = name.startswith("sphere")
        if "triangles" in name:
            mesh = turned_to_viewer(mesh, camera)
        found[name] = Task(dr.mesh.with_normals(mesh, weighting="uniform"), camera, size, closed)
    # One surface: DEODR takes every border between patches for an outline.
    teapot = dr.mesh.merge_near_vertices(dr.shapes.teapot(10), 1e-5)
    camera = dr.Camera.perspective(
        eye=(6.5, -6, 5.2), target=(0, 0, 1.4), up=(0, 0, 1), fov_y=0.7, near=0.5, far=40
    )
    found["teapot"] = Task(dr.mesh.with_normals(teapot, weighting="uniform"), camera, size, True)
    return found


def turned_to_viewer(mesh: dr.Mesh, camera: dr.Camera) -> dr.Mesh:
    """The same triangles, each counter-clockwise as seen from the camera."""
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    eye = np.asarray(dr.viewpoint(camera))[:3]
    away = ((eye - corners[:, 0]) * across).sum(axis=1) < 0
    faces = np.where(away[:, None], np.asarray(mesh.faces)[:, ::-1], mesh.faces)
    return dr.Mesh(vertices=mesh.vertices, faces=faces)


# Is it the same picture? --------------------------------------------------------------------------


def check_picture(peer: Peer, image: np.ndarray, expected: np.ndarray) -> dict[str, float]:
    """Refuse a picture that differs from ours without edges; how far it does.

    Where pixels at edges are mixed, those are left out that have a neighbour of the other kind.
    """
    covered, wanted = (picture.max(axis=-1) > 0.02 for picture in (image, expected))
    around = np.lib.stride_tricks.sliding_window_view(np.pad(wanted, 1, mode="edge"), (3, 3))
    inner = around.all(axis=(2, 3)) | ~around.any(axis=(2, 3)) | (not peer.samples)
    agreement = float((covered == wanted)[inner].mean())
    seen = inner & covered & wanted
    difference = float(np.abs(image - expected)[seen].sum() / max(3 * seen.sum(), 1))
    if agreement < 0.995 or difference > 0.02 or not seen.any():
        raise AssertionError(
            f"{peer.name} draws another picture, and is not timed: {agreement:.4f} of the pixels"
            f" agree on what is covered, colours differ by {difference:.4f}"
        )
    return {"coverage_agreement": agreement, "color_difference": difference}


def checked(task: Task, which: Sequence[type[Peer]], missing: dict[str, str]) -> list[Peer]:
    """The renderers of a scene, ready; those that are not installed are added to `missing`."""
    found: list[Peer] = []
    for kind in which:
        try:
            found.append(kind(task))
        except renderer.MissingPeerError as error:
            missing[kind.name] = str(error)
    expected = {
        "phong": functools.cache(renderer.DiffrastInterior(task).image),
        "gouraud": functools.cache(renderer.DiffrastGouraud(task).image),
    }
    for peer in found:
        check_picture(peer, in_floats(peer.image()), expected[peer.shading]())
    return found


# How fast? ----------------------------------------------------------------------------------------


def take_turns(found: Sequence[Peer], repeats: int) -> dict[str, dict[str, float | None]]:
    """Minimum times in milliseconds of every renderer, which take turns."""
    target = np.roll(in_floats(found[0].image()), 3, axis=1).astype(np.float32)
    jobs = {(peer.name, "forward_ms"): peer.image for peer in found}
    jobs |= {
        (peer.name, "both_ms"): functools.partial(peer.gradient, target)
        for peer in found
        if peer.differentiable
    }
    times = minimum_times(jobs, repeats)
    return {
        peer.name: {kind: times.get((peer.name, kind)) for kind in ("forward_ms", "both_ms")}
        for peer in found
    }


# Run and report -----------------------------------------------------------------------------------


def run(
    out: Path,
    *,
    sizes: Sequence[int] = (256, 512, 1024),
    only: Sequence[str] | None = None,
    repeats: int = 10,
    exact_size: int = 256,
    samples: int = 256,
    which: Sequence[type[Peer]] = (*OWN, *peers.PEERS),
    progress: bool = False,
) -> dict[str, Any]:
    """Compare pictures, times and errors; returns what is written.

    Args:
        out: folder of the results.
        sizes: rows and columns of the pictures that are timed.
        only: names of scenes; all unless given.
        repeats: timed runs of each.
        exact_size: rows and columns of the pictures that are compared with exact ones; 0: none.
        samples: a pixel of those exact ones.
        which: the renderers.
        progress: print each result as it comes.
    """
    report: dict[str, Any] = {"repeats": repeats, "missing": {}, "times": {}, "errors": {}}
    for name, size, task in _cells(sizes, only, exact_size):
        found = checked(task, which, report["missing"])
        if size in sizes:
            cell = take_turns(found, repeats)
            report["times"].setdefault(name, {})[str(size)] = cell
            if progress:
                print(f"{name}, {size}²: {_line(cell)}", flush=True)
        if size == exact_size:
            report["errors"][name] = qualities(task, found, samples)
            if progress:
                print(errors_table({name: report["errors"][name]}), flush=True)
        report["speed"] = speeds(report["times"])
        save_json(out / "benchmark_peers.json", report)
    (out / "benchmark_peers.md").write_text(tables(report) + "\n")
    if report["times"]:
        plot(report, out / "benchmark_peers.png")
    return report


def _cells(
    sizes: Sequence[int], only: Sequence[str] | None, exact_size: int
) -> Iterator[tuple[str, int, Task]]:
    for size in sorted({*sizes, exact_size} - {0}):
        for name, task in tasks(size).items():
            if only is None or name in only:
                yield name, size, task


def _line(cell: dict[str, dict[str, float | None]]) -> str:
    return "; ".join(f"{name} {_times(times)}" for name, times in cell.items())


def _times(times: dict[str, float | None]) -> str:
    return " / ".join(three_digits(value) for value in times.values() if value is not None)


def speeds(times: dict[str, Any]) -> dict[str, Any]:
    """Best peer's time over ours, for each scene and size, and the geometric mean."""
    cells: dict[str, dict[str, float]] = {}
    own = {kind.name for kind in OWN}
    for name, by_size in times.items():
        for size, cell in by_size.items():
            ratios = {}
            for kind in ("forward_ms", "both_ms"):
                others = [t[kind] for peer, t in cell.items() if peer not in own and t[kind]]
                if others and renderer.Diffrast.name in cell:
                    ratios[kind] = min(others) / cell[renderer.Diffrast.name][kind]
            cells[f"{name}, {size}"] = ratios
    means = {}
    for kind in ("forward_ms", "both_ms"):
        logs = [np.log(ratios[kind]) for ratios in cells.values() if kind in ratios]
        means[kind] = float(np.exp(np.mean(logs))) if logs else None
    return {"best_peer_over_ours": cells, "geometric_mean": means}


def tables(report: dict[str, Any]) -> str:
    """Times, errors and what is missing, in Markdown."""
    parts = [times_table(report) if report["times"] else "", errors_table(report["errors"])]
    parts += [f"Missing: {message}." for message in report["missing"].values()]
    return "\n\n".join(part for part in parts if part)


def times_table(report: dict[str, Any]) -> str:
    """Milliseconds, forward / with derivative; the last column is the best peer over ours."""
    times, speed = report["times"], report["speed"]
    names = renderers(times)
    rows = []
    for scene, by_size in times.items():
        for size, cell in by_size.items():
            ratios = speed["best_peer_over_ours"][f"{scene}, {size}"]
            columns = [_times(cell[name]) if name in cell else "" for name in names]
            columns.append(" / ".join(f"{ratio:.2f}" for ratio in ratios.values()))
            rows.append([scene, f"{size}²", *columns])
    means = [f"{mean:.2f}" for mean in speed["geometric_mean"].values() if mean is not None]
    rows.append(["geometric mean", "", *[""] * len(names), " / ".join(means)])
    return markdown(["scene", "size", *names, "best peer / ours"], rows)


def errors_table(errors: dict[str, Any]) -> str:
    """Root mean square and mean error of pictures; error and cosine of derivatives by the pose."""
    rows = []
    for scene, by_peer in errors.items():
        for name, e in by_peer.items():
            slope = ["", ""]
            if "gradient_error" in e:
                slope = [f"{100 * e['gradient_error']:.1f} %", f"{e['gradient_cosine']:.4f}"]
            rows.append([scene, name, f"{e['rmse']:.5f}", f"{e['mean_difference']:.6f}", *slope])
    header = ["scene", "renderer", "picture, rms", "mean", "pose derivative, error", "cosine"]
    return markdown(header, rows) if rows else ""


def renderers(times: dict[str, Any]) -> list[str]:
    """Names of all that were timed, ours first."""
    cells = [cell for by_size in times.values() for cell in by_size.values()]
    return list(dict.fromkeys(name for cell in cells for name in cell))


def plot(report: dict[str, Any], path: Path) -> None:
    """Times over sizes: dashed forward, solid with derivative; dotted what was measured earlier."""
    plt = pyplot()
    times = report["times"]
    figure, axes = plt.subplots(
        1, len(times), figsize=(4 * len(times) + 2, 4), squeeze=False, sharey=True
    )
    names = renderers(times)
    colors = {name: f"C{i}" for i, name in enumerate([*names, "diffren splat"])}
    for axis, (scene, by_size) in zip(axes[0], times.items(), strict=True):
        sizes = [int(size) for size in by_size]
        for name in names:
            cells = [cell.get(name, {}) for cell in by_size.values()]
            for kind, style, fill in (("forward_ms", "o--", "white"), ("both_ms", "o-", None)):
                values = [cell.get(kind) or np.nan for cell in cells]
                axis.loglog(
                    sizes,
                    values,
                    style,
                    color=colors[name],
                    markerfacecolor=fill,
                    label=name if kind == "forward_ms" else None,
                    markersize=4,
                )
        earlier = [both for _, both in EARLIER[scene]["diffren splat"]]
        known = [(s, t) for s, t in zip((256, 512, 1024), earlier, strict=True) if s in sizes]
        if known:
            color = colors["diffren splat"]
            label = "diffren splat (earlier)"
            axis.loglog(*zip(*known, strict=True), "o:", color=color, label=label, markersize=4)
        axis.set_title(scene)
        axis.set_xlabel("rows and columns")
        axis.set_xticks(sizes, [str(size) for size in sizes])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("ms (dashed: forward, solid: with derivative)")
    axes[0, -1].legend(loc="center left", bbox_to_anchor=(1.02, 0.5), fontsize=8)
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)


def main() -> None:
    parser = benchmark_options(__doc__, "benchmark_peers", repeats=10)
    parser.add_argument("--sizes", type=int, nargs="*", default=[256, 512, 1024], metavar="SIZE")
    parser.add_argument("--only", nargs="+", metavar="SCENE", help="names of scenes")
    parser.add_argument("--exact-size", type=int, default=256, help="0: compare no errors")
    parser.add_argument("--samples", type=int, default=256, help="a pixel of exact pictures")
    parser.add_argument("--quick", action="store_true", help="one scene, one small size")
    options = vars(parser.parse_args())
    if options.pop("quick"):
        options |= {"sizes": [64], "only": ["sphere, 5,120 faces"], "repeats": 3}
        options |= {"exact_size": 64, "samples": 64}
    report = run(options.pop("out"), progress=not options.pop("quiet"), **options)
    print(tables(report))


if __name__ == "__main__":
    main()
