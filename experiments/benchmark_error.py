"""What does exactness cost? Run time against error, for each setting that trades one for the other.

    python experiments/benchmark_error.py [--quick] [--size 256] [--repeats 10] [--scenes NAME ...]

- "samples": 1, 4 and 16 samples a pixel, with edges and without, on scenes of
  `benchmark_peers.py`, next to DEODR, Mitsuba (with as many samples) and llvmpipe. Derivatives are
  by the camera's pose.
- "precision": the same in float64, with one sample, on the first of the scenes (of "samples" only):
  in a process of its own, which takes no turns with the others.
- "shadows": resolution of the light's map, with edges and without, of a ring's shadow on a floor.
  Derivatives are by the light's direction.
- "filters": of a checkerboard that reaches far away, by how it moves.
- "tessellation": cells along each patch of the teapot, one sample a pixel with edges, by the pose.

The truth is the mean of eight jagged pictures of 64 samples a pixel each, shifted so that all 512
lie apart: of shadows with a map of 2048², which the tests hold against rays cast in float64; of
textures with "nearest"; of the teapot with 32 cells along a patch; of DEODR, which has no
highlights, with Gouraud's shading. Its derivatives are central differences of these pictures' sums,
weighted by eight smooth random fields. How far the truth itself may be off, by its two halves, is
told.

Errors are the root mean square over the picture, and the length of the difference of all eight
derivatives over that of the true ones: 1 is no better than none. A setting is on the front if none
of ours is as fast and as exact.

Written to `--out`: `benchmark_error.json`, `.md` (the fronts, then everything) and `.png`.
Expected: "edges" with one sample is more exact than 16 samples without, and faster; more samples
with edges lower the error further, near to that of the truth. Derivatives of moving outlines need
edges, whatever the samples. Float64 costs more and changes no error. Trilinear filters beat 16
samples, if with anisotropy. Up to 512 rows a finer shadow map helps the picture where there are
edges, and hardly where there are none. Finer meshes lower the error until that of the pixels is
left. How long: twenty minutes on two cores, most of it compilation; `--families` and `--scenes`
choose.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import error_scenes
import jax
import numpy as np
from common import progress_bar, pyplot, save_json
from error_scenes import Contender, Truths
from timing import benchmark_options, markdown, minimum_times, three_digits

FAMILIES = ("samples", "precision", "filters", "tessellation", "shadows")
SCENES = ("sphere, 5,120 faces", "teapot")
KINDS = {"picture": ("forward_ms", "rmse"), "derivative": ("both_ms", "gradient_error")}
LABELS = {
    "samples": "samples a pixel",
    "filters": "samples a pixel, or anisotropy",
    "tessellation": "cells along a patch",
    "shadows": "rows of the map",
}
STYLES = {  # colour and marker of a series
    "edges": ("C0", "o"),
    "no edges": ("C1", "o"),
    "edges, float64": ("C0", "D"),
    "no edges, float64": ("C1", "D"),
    "Mitsuba": ("C2", "s"),
    "DEODR": ("C3", "^"),
    "llvmpipe": ("C4", "v"),
    "nearest": ("C5", "o"),
    "bilinear": ("C8", "o"),
    "trilinear": ("C9", "o"),
}
Point = dict[str, Any]


def measured(contenders: Sequence[Contender], repeats: int, label: str | None) -> list[Point]:
    """Errors and minimum times of contenders, which take turns; a label shows progress."""
    points = []
    each = contenders if label is None else progress_bar(contenders, desc=label)
    for contender in each:  # compiles, too
        fields = range(len(contender.truth.fields))
        slopes = np.stack(list(map(contender.slopes, fields))) if contender.slopes else None
        errors = contender.truth.errors(contender.image(), slopes)
        name = {"series": contender.series, "setting": contender.setting, "peer": contender.peer}
        points.append(name | errors)
    jobs: dict[tuple[int, str], Callable[[], Any]] = {}
    for index, contender in enumerate(contenders):
        jobs[index, "forward_ms"] = contender.image
        if contender.slopes:
            jobs[index, "both_ms"] = partial(contender.slopes, 0)
    for (index, kind), time in minimum_times(jobs, repeats).items():
        points[index][kind] = time
    return points


def mark_fronts(points: Sequence[Point]) -> None:
    """Tell of each point whether one of ours is at least as fast and, to a hundredth, as exact."""
    for kind, keys in KINDS.items():
        ours = {tuple(p[key] for key in keys) for p in points if not p["peer"] and keys[1] in p}
        for point in points:
            if keys[1] in point:
                time, error = (point[key] for key in keys)
                # No derivative at all has an error of 1.
                point[f"{kind}_front"] = error < 1 and not any(
                    t <= time and e <= 1.01 * error and (t, e) != (time, error) for t, e in ours
                )


def in_float64(out: Path, scene: str, size: int, repeats: int, truths: Truths) -> list[Point]:
    """Points of a scene, with one sample, from a process whose numbers have twice the digits."""
    command = [sys.executable, __file__, "--out", str(out), "--scenes", scene, "--quiet", "--alone"]
    numbers = {"size": size, "repeats": repeats, "samples": 1}
    numbers |= {"exact-samples": truths.samples, "pictures": truths.pictures}
    command += [f"--{name}={value}" for name, value in numbers.items()]
    subprocess.run(
        command, check=True, env=os.environ | {"JAX_ENABLE_X64": "1"}, stdout=subprocess.DEVNULL
    )
    found = json.loads((out / "benchmark_error.json").read_text())["panels"][scene]["points"]
    return [point | {"series": f"{point['series']}, float64"} for point in found]


# Run and report -----------------------------------------------------------------------------------


def run(
    out: Path,
    *,
    size: int = 256,
    repeats: int = 10,
    scenes: Sequence[str] = SCENES,
    families: Sequence[str] = FAMILIES,
    sides: Sequence[int] = (1, 2, 4),
    resolutions: Sequence[int] = (128, 512, 2048),
    anisotropies: Sequence[int] = (1, 2, 4),
    divisions: Sequence[int] = (3, 6, 12),
    others: bool = True,
    truths: Truths | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Measure all settings; returns what is written.

    Args:
        out: folder of the results.
        size: rows and columns of the pictures.
        repeats: timed runs of each setting.
        scenes: of the benchmark of peers, for "samples" and (the first one) "precision".
        families: of settings.
        sides: side² samples a pixel.
        resolutions: of shadow maps.
        anisotropies: of trilinear filters.
        divisions: cells along a patch of the teapot.
        others: whether the other renderers are there.
        truths: how exact pictures are drawn.
        progress: show bars.
    """
    truths = truths or Truths()
    report: dict[str, Any] = {"size": size, "repeats": repeats, "missing": {}, "panels": {}}
    makers: dict[str, Callable[[], list[Contender]]] = {}
    if "samples" in families:
        for scene in scenes:
            makers[scene] = partial(
                error_scenes.sample_settings,
                scene,
                size,
                truths,
                sides=sides,
                others=others,
                missing=report["missing"],
            )
    for family, maker in {
        "filters": partial(error_scenes.filter_settings, sides=sides, anisotropies=anisotropies),
        "tessellation": partial(error_scenes.tessellation_settings, divisions=divisions),
        "shadows": partial(error_scenes.shadow_settings, resolutions=resolutions),
    }.items():
        if family in families:
            makers[family] = partial(maker, size, truths)
    for name, make in makers.items():
        contenders = make()
        points = measured(contenders, repeats, name if progress else None)
        if "precision" in families and name == scenes[0]:
            points += in_float64(out / "float64", name, size, repeats, truths)
        mark_fronts(points)
        truth = contenders[0].truth.own_errors() if truths.pictures > 1 else {}
        report["panels"][name] = {"truth": truth, "points": points}
        save_json(out / "benchmark_error.json", report)
        jax.clear_caches()  # programs of other scenes are not needed again
    (out / "benchmark_error.md").write_text(tables(report) + "\n")
    plot(report, out / "benchmark_error.png")
    return report


def tables(report: dict[str, Any]) -> str:
    """The settings on the fronts, all of them, and what is missing."""
    parts = [table(report, front=True), table(report)]
    parts += [f"Missing: {message}." for message in report["missing"].values()]
    return "\n\n".join(parts)


def table(report: dict[str, Any], *, front: bool = False) -> str:
    """Times and errors in Markdown; those on a front are bold, or left out are the others."""
    rows = []
    for name, panel in report["panels"].items():
        for point in panel["points"]:
            cells = list(_cells(point))
            if front and (point["peer"] or not any(on for _, on in cells)):
                continue
            texts = [f"**{text}**" if on and text else text for text, on in cells]
            rows.append([name, point["series"], point["setting"], *texts])
        if panel["truth"] and not front:
            truth = panel["truth"]
            errors = three_digits(truth["rmse"]), f"{100 * truth['gradient_error']:.2g} %"
            rows.append([name, "the truth itself, about", "", "", errors[0], "", errors[1]])
    header = ["scene", "renderer", "setting", "picture ms", "rms", "with derivative ms", "error"]
    return markdown(header, rows)


def _cells(point: Point) -> Iterator[tuple[str, bool]]:
    """Time and error of picture and derivative, and whether they are on the front."""
    for kind, keys in KINDS.items():
        for key in keys:
            value, text = point.get(key), ""
            if value is not None:
                percent = key == "gradient_error"
                text = f"{100 * value:.3g} %" if percent else three_digits(float(value))
            yield text, point.get(f"{kind}_front", False)


# Plot ---------------------------------------------------------------------------------------------


def plot(report: dict[str, Any], path: Path) -> None:
    """Error over time, pictures above derivatives, three scenes side by side."""
    plt = pyplot()
    panels = report["panels"]
    columns = min(3, len(panels))
    bands = -(-len(panels) // columns)
    figure, axes = plt.subplots(
        2 * bands, columns, figsize=(4 * columns, 6 * bands), squeeze=False, layout="constrained"
    )
    for axis in axes.flat:
        axis.axis("off")
    known: dict[str, Any] = {}
    for index, (name, panel) in enumerate(panels.items()):
        band, column = divmod(index, columns)
        for axis, kind in zip(axes[2 * band : 2 * band + 2, column], KINDS, strict=True):
            axis.axis("on")
            known |= draw_panel(axis, panel, kind)
        labels = LABELS.get(name, LABELS["samples"])
        axes[2 * band, column].set_title(f"{name}\nnumbers: {labels}", fontsize=10)
    notes = "filled: none of ours is as fast and as exact;\nbest is the lower left corner"
    options = {"fontsize": 9, "title": notes, "title_fontsize": 9}
    if len(panels) % columns:
        axes[-2, -1].legend(known.values(), known, loc="upper left", **options)
    else:
        figure.legend(known.values(), known, loc="outside lower center", ncols=4, **options)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_panel(axis: Any, panel: dict[str, Any], kind: str) -> dict[str, Any]:
    """The points of one scene, joined by series; returns the legend's handles."""
    time, error = KINDS[kind]
    handles = {}
    for point in panel["points"]:
        if error in point:
            series = [p for p in panel["points"] if p["series"] == point["series"]]
            color, marker = STYLES[point["series"]]
            x, y = ([p[key] for p in series] for key in (time, error))
            style = "--" if point["peer"] else "-"
            axis.loglog(x, y, style, color=color, linewidth=1)
            face = color if point[f"{kind}_front"] else "white"
            place = point[time], point[error]
            axis.plot(*place, marker, color=color, markerfacecolor=face, markersize=6)
            offset = {"textcoords": "offset points", "xytext": (5, 3)}
            axis.annotate(point["setting"], place, fontsize=8, color=color, **offset)
            (handles[point["series"]],) = axis.plot([], [], style + marker, color=color)
    if panel["truth"]:
        handles["error of the truth itself, about"] = axis.axhline(
            panel["truth"][error], color="gray", linestyle=":"
        )
    axis.grid(alpha=0.3)
    axis.margins(x=0.15)
    axis.set_xlabel("ms" if kind == "picture" else "ms, with derivative", fontsize=9)
    axis.set_ylabel("picture: rms error" if kind == "picture" else "derivative: relative error")
    return handles


def main() -> None:
    parser = benchmark_options(__doc__, "benchmark_error", repeats=10)
    parser.add_argument("--size", type=int, default=256, help="rows and columns of the pictures")
    parser.add_argument("--scenes", nargs="+", default=SCENES, metavar="SCENE")
    parser.add_argument("--families", nargs="+", default=FAMILIES, choices=FAMILIES)
    parser.add_argument("--samples", type=int, nargs="+", default=[1, 4, 16], help="squares")
    parser.add_argument("--exact-samples", type=int, default=64, help="a pixel of true pictures")
    parser.add_argument("--pictures", type=int, default=8, help="that are averaged to true ones")
    parser.add_argument("--alone", action="store_true", help="our samples only")
    parser.add_argument("--quick", action="store_true", help="one scene, small, few settings")
    options = vars(parser.parse_args())
    truths = Truths(options.pop("exact_samples"), options.pop("pictures"))
    options["sides"] = [round(count**0.5) for count in options.pop("samples")]
    if options.pop("alone"):
        options |= {"families": ["samples"], "others": False}
    if options.pop("quick"):
        truths = Truths(16, 2)
        options |= {"size": 64, "repeats": 3, "scenes": SCENES[:1], "sides": [1, 2]}
        options |= {"resolutions": [128], "anisotropies": [1, 4], "divisions": [4, 8]}
    progress = not options.pop("quiet")
    print(tables(run(options.pop("out"), truths=truths, progress=progress, **options)))


if __name__ == "__main__":
    main()
