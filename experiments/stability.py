"""Is every picture and every derivative finite and right, however a scene is strained?

    python experiments/stability.py                  # 10,000 scenes
    python experiments/stability.py --full           # 100,000, and some of 4096² pixels
    python experiments/stability.py --replay results/stability/FILE.npz

`stress_scenes.py` strains small scenes in fifteen ways, each over a range of magnitudes, and in
several ways at once. Each is drawn in batches under `vmap`, with a derivative forward and one
backward, by all of vertices, normals, camera and lights:

- "plain": Phong's shading, one sample a pixel. Pictures are compared with float64
  (`stress_reference.py`) at the pixels where rounding cannot change which face is seen.
- "edges": the same with anti-aliased edges. Some batches are compared with the library's own
  picture in float64, at the pixels where shaking what is drawn, by as much as rounding moves it,
  changes that picture little, and with a bound of eight times this change.
- "own normals": Gouraud's shading with normals found from the faces, back faces culled.
- "shadows": edges, with a shadow of both lights.

The same scenes with faces in another order, with other corners first, mirrored, scaled, turned by
right angles, and moved anyhow (compared with the float64 picture of that), have the same picture.

Written to `--out`: `stability.json` with counts and worst errors of each stressor by its magnitude,
`stability.png`, and for each kind of failure the first scene, to be drawn again by `--replay`.
Expected: nothing that is not finite. Clear pixels beyond their bound: without edges in one scene of
10,000, most of these under several strains; with edges in one of 200, where rounding decides which
of two surfaces lies behind an edge. At the stressors' own magnitudes clear colours are off by 2e-5
at most, but for an eye within 1e-4 of a face it looks at, and for scenes far from the origin, whose
visible points float32 rounds to 1e-7 of their distance from it. How long it takes: a quarter of an
hour on two busy cores, an hour and a half in full.
"""

import argparse
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import stress_scenes
from common import progress_bar, pyplot, save_json
from stress_measures import GROUPS, Group, Measures, failures, float64_measures, measured, picture
from stress_scenes import CONTINUOUS, NAMES, Case, Parts

LARGE = 4096  # rows and columns
DOUBLED = 8  # batches of "edges" that are drawn in float64, too
Row = dict[str, Any]  # group, stressor, magnitude, and measures


def batches(name: str, scenes: int, batch: int, seed: int) -> Iterator[tuple[list[Case], bool]]:
    """The scenes of a group, in whole batches; and whether they are compared."""
    group = GROUPS[name]
    count = max(1, round(scenes * group.share / batch))
    for index in range(count):
        numbers = range(index * batch, (index + 1) * batch)
        compare = index < np.ceil(count * group.compared)
        yield [stress_scenes.case(number, seed) for number in numbers], compare


def run(
    out: Path,
    *,
    scenes: int = 10_000,
    size: int = 16,
    batch: int = 64,
    groups: Iterable[str] = tuple(GROUPS),
    doubled: int = DOUBLED,
    large: int = 0,
    seed: int = 0,
    progress: bool = False,
) -> dict[str, Any]:
    """Draw and judge all scenes; returns what is written.

    Args:
        out: folder of the results.
        scenes: how many.
        size: rows and columns of the pictures.
        batch: scenes drawn at once.
        groups: names of `GROUPS`.
        doubled: batches of "edges" that are compared with float64.
        large: pictures of 4096² pixels.
        seed: of the scenes.
        progress: show a progress bar.
    """
    started = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    groups = list(groups)
    jobs = [(name, *job) for name in groups for job in batches(name, scenes, batch, seed)]
    rows: list[Row] = []
    saved: dict[str, str] = {}
    repeat: list[tuple[list[Case], list[Row], Parts, np.ndarray]] = []

    def note(name: str, cases: list[Case], own: list[Row], measures: Measures) -> None:
        _extend(own, measures)
        for kind, failed in failures(measures):
            for index in np.flatnonzero(failed):
                label = f"{name}, {kind}, {cases[index].stressor}"
                if label not in saved:
                    saved[label] = _save(out, label, name, cases[index], size, batch)

    for name, cases, compare in progress_bar(jobs, unit="batch") if progress else jobs:
        parts = stress_scenes.stacked([case.parts for case in cases])
        measures, images = measured(name, parts, size, compare=compare)
        new = [{"group": name, "stressor": c.stressor, "magnitude": c.magnitude} for c in cases]
        note(name, cases, new, measures)
        rows += new
        if name == "edges" and len(repeat) < doubled:
            repeat.append((cases, new, parts, images))
    if repeat:
        all_cases, all_rows, all_parts, all_images = zip(*repeat, strict=True)
        doubles = float64_measures(all_parts, all_images, size)
        for cases, new, measures in zip(all_cases, all_rows, doubles, strict=True):
            note("edges", cases, new, measures)
    report = {
        "scenes": {name: sum(row["group"] == name for row in rows) for name in groups},
        "size": size,
        "seed": seed,
        "large": [_large(number, seed) for number in range(large)],
        "seconds": time.perf_counter() - started,
        "failures": saved,
        "totals": {name: _totals(rows, group=name) for name in groups},
        "stressors": {
            stressor: {name: _by_magnitude(rows, stressor, name) for name in groups}
            for stressor in NAMES
        },
    }
    save_json(out / "stability.json", report)
    plot(report, out / "stability.png")
    return report


def _extend(rows: list[Row], measures: Measures) -> None:
    for index, row in enumerate(rows):
        row |= {key: float(values[index]) for key, values in measures.items()}


def _large(number: int, seed: int) -> Row:
    """A picture of 4096² pixels, without and with edges, and derivatives of its mean square."""
    case = stress_scenes.case(number, seed)
    given = {key: part for key, part in case.parts.items() if key not in CONTINUOUS}
    varied = {key: case.parts[key] for key in CONTINUOUS}
    row: Row = {"stressor": case.stressor, "magnitude": case.magnitude}
    for name in ("plain", "edges"):

        def loss(varied: Any, group: Group = GROUPS[name]) -> Any:
            image = picture(varied | given, group, LARGE)[0]
            return jnp.mean(image**2), jnp.sum(~jnp.isfinite(image))

        (_, wrong), slopes = jax.jit(jax.value_and_grad(loss, has_aux=True))(varied)
        row[f"{name}: value not finite"] = int(wrong)
        parts = jax.tree.leaves(slopes)
        row[f"{name}: backward not finite"] = int(sum(np.sum(~np.isfinite(p)) for p in parts))
    return row


def _totals(rows: list[Row], **wanted: Any) -> dict[str, Any]:
    """Scenes with failures, and mean and worst of all other measures."""
    rows = [row for row in rows if all(row[key] == value for key, value in wanted.items())]
    found: dict[str, Any] = {"scenes": len(rows)}
    keys = dict.fromkeys(key for row in rows for key in row)
    for key in [key for key in keys if key not in ("group", "stressor", "magnitude")]:
        values = np.array([row[key] for row in rows if key in row])
        if key.endswith(("not finite", "wrong")):
            found[key] = int((values > 0).sum())
        else:
            found[key] = {"mean": values.mean(), "worst": values.max()}
    return found


def _by_magnitude(rows: list[Row], stressor: str, group: str) -> list[dict[str, Any]]:
    own = [row for row in rows if (row["stressor"], row["group"]) == (stressor, group)]
    magnitudes = sorted({row["magnitude"] for row in own})
    return [{"magnitude": m} | _totals(own, magnitude=m) for m in magnitudes]


# Failed scenes ------------------------------------------------------------------------------------


def _save(out: Path, label: str, group: str, case: Case, size: int, batch: int) -> str:
    name = label.replace(", ", "-").replace(" ", "_").replace(":", "") + ".npz"
    parts = {f"part {key}": part for key, part in case.parts.items()}
    about = {"stressor": case.stressor, "magnitude": case.magnitude}
    np.savez(out / name, group=group, size=size, batch=batch, **about, **parts)  # type: ignore[arg-type]
    return name


def replay(path: Path) -> dict[str, float]:
    """Draw a saved scene again, in a batch of such scenes, and measure it."""
    with np.load(path) as file:
        parts = {key.removeprefix("part "): file[key] for key in file if key.startswith("part ")}
        group, size, batch = str(file["group"]), int(file["size"]), int(file["batch"])
    copies = stress_scenes.stacked([parts] * batch)
    measures, images = measured(group, copies, size, compare=GROUPS[group].compared > 0)
    if group == "edges":
        measures |= float64_measures([copies], [images], size)[0]
    return {key: float(values[0]) for key, values in measures.items()}


# Output -------------------------------------------------------------------------------------------

LINES = {  # label, group, measure, statistic
    "picture, worst": ("plain", "error", "worst"),
    "pixels not clear": ("plain", "share unclear", "mean"),
    "directions apart, worst": ("plain", "directions apart", "worst"),
    "edges: directions apart, worst": ("edges", "directions apart", "worst"),
    "edges: picture, worst": ("edges", "float64: error", "worst"),
}


def plot(report: dict[str, Any], path: Path) -> None:
    """Errors of each stressor over its magnitudes; what is zero lies at the bottom."""
    plt = pyplot()
    columns = 4
    rows = -(-len(NAMES) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(15, 3 * rows), layout="constrained")
    for axis, (stressor, by_group) in zip(axes.flat, report["stressors"].items(), strict=False):
        for label, (group, measure, statistic) in LINES.items():
            known = [cell for cell in by_group.get(group, []) if measure in cell]
            values = [max(cell[measure][statistic], 1e-9) for cell in known]
            places = [cell["magnitude"] for cell in known]
            axis.plot(places, values, "o-", markersize=3, label=label)
        places = sorted({cell["magnitude"] for cells in by_group.values() for cell in cells})
        sizes = [abs(magnitude) for magnitude in places if magnitude] or [1.0]
        if max(sizes) > 50 * min(sizes):
            axis.set_xscale("symlog", linthresh=min(sizes))
            shown = places[:: -(-len(places) // 5)]
            axis.set_xticks(shown, [f"{magnitude:g}" for magnitude in shown])
            axis.minorticks_off()
        axis.set_yscale("log")
        axis.set_ylim(5e-10, 2)
        axis.set_title(stressor)
        axis.grid(alpha=0.3)
    axes.flat[0].legend(fontsize=7)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results") / "stability")
    parser.add_argument("--scenes", type=int, default=10_000)
    parser.add_argument("--size", type=int, default=16, help="rows and columns of the pictures")
    parser.add_argument("--batch", type=int, default=64, help="scenes drawn at once")
    parser.add_argument("--groups", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--doubled", type=int, default=DOUBLED, help="batches drawn in float64")
    parser.add_argument("--large", type=int, default=0, help="pictures of 4096² pixels")
    parser.add_argument("--full", action="store_true", help="100,000 scenes and 2 large pictures")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--replay", type=Path, metavar="FILE", help="draw a failed scene again")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    options = vars(parser.parse_args())
    file = options.pop("replay")
    if file is not None:
        for name, value in replay(file).items():
            print(f"{name}: {value:.6g}")
        return
    if options.pop("full"):
        options |= {"scenes": 100_000, "doubled": 64, "large": 2}
    report = run(options.pop("out"), progress=not options.pop("quiet"), **options)
    for name, found in report["totals"].items():
        print(f"{name}:")
        for key, value in found.items():
            shown = value if isinstance(value, int) else f"{value['worst']:.3g} at worst"
            print(f"    {key}: {shown}")
    for label, name in report["failures"].items():
        print(f"failed: {label}, see {name}")


if __name__ == "__main__":
    main()
