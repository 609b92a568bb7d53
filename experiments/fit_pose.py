"""Is the pose of a lattice of thin bars found from one picture?

    python experiments/fit_pose.py
    python experiments/fit_pose.py --compare

The object is full of holes: bars of about four pixels round 4 x 4 x 4 cells, which leave holes of
one to twelve pixels to look through; a fifth of the bars is left out, so that no other pose looks
the same. From random starts, turned by up to 8 degrees round any axis and moved by up to 5 % of the
object's size, its rotation and translation are fitted to one picture (16 samples a pixel) by
Levenberg-Marquardt steps on the difference of the pictures, blurred less and less. A pose counts as
found within 0.1 degrees and 0.1 % of the size. `--compare` does the same without the derivative
through what is visible (`antialias=False`).

Expected: all 20 starts are found, with median errors of 0.01 degrees and 0.02 % of the size, after
about 20 pictures with their derivative by the six parameters (three to four minutes in all on two
cores); what is left is the error of edges with one sample a pixel. From the shading alone none is
found: the derivative by the translation is zero but for rounding.

Written to `--out`: `fit_pose.json` with every start, and `fit_pose.png` with one fit (target,
start, result, 16 times their difference round grey) and the errors of all starts.
"""

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

METHODS = ("visibility", "shading only")
CRITERION = {"rotation_degrees": 0.1, "translation_percent": 0.1}
TRUTH = dr.linalg.se3_exp((0.02, -0.03, 0.01, 0.35, -0.5, 0.15))
CAMERA = dr.Camera.perspective(eye=(0, 0, 3), target=(0, 0, 0), fov_y=0.62, near=1, far=6)
LIGHT = dr.DirectionalLight(direction=(-0.5, -0.7, -1.0), ambient=(0.15, 0.15, 0.15))
MATERIAL = dr.Material(diffuse=(0.8, 0.55, 0.3))
BLURS = (6.0, 2.0, 0.0)  # standard deviations in pixels of 128, one level after another


def lattice(cells: int, missing: float = 0.2, bar: float = 0.22, seed: int = 1) -> dr.Mesh:
    """Bars round cubic cells, of edge length 1 in all, centred.

    Args:
        cells: along each edge.
        missing: share of the bars between two nodes that are left out.
        bar: thickness of the bars, relative to the distance of their middles.
        seed: for the choice of those left out.
    """
    count = 2 * cells + 1
    odd = np.indices((count,) * 3) % 2  # 0: in the plane of nodes, 1: between them
    kept = np.random.default_rng(seed).random((count,) * 3) >= missing
    solid = np.pad((odd.sum(0) == 0) | ((odd.sum(0) == 1) & kept), 1)
    widths = np.where(np.arange(count) % 2 == 0, bar, 1 - bar)
    ends = np.concatenate([[0.0], np.cumsum(widths)])
    planes = ends / ends[-1] - 0.5

    vertices = []
    for axis in range(3):
        u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        for sign in (0, 1):
            bare = np.argwhere(solid & ~np.roll(solid, 1 - 2 * sign, axis=axis)) - 1
            corner = bare + sign * np.eye(3, dtype=int)[axis]
            turn = [0 * u, u, u + v, v] if sign else [0 * u, v, u + v, u]
            vertices.append(planes[corner[:, None] + np.stack(turn)])
    quads = np.arange(4 * sum(map(len, vertices))).reshape(-1, 4)
    faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    mesh = dr.Mesh(vertices=np.concatenate(vertices).reshape(-1, 3), faces=faces)
    return dr.mesh.flat_shaded(mesh)


def placed(start: Array, twist: Array) -> Array:
    """Object to world: `start`, moved and turned in the object's own frame, so round its centre."""
    return start @ dr.linalg.se3_exp(twist)


@jax.jit
def picture(mesh: dr.Mesh, transform: Array, settings: dr.RenderSettings) -> Array:
    """Render the lattice in a pose."""
    scene = dr.Scene(objects=[dr.Object(mesh, MATERIAL, transform)], lights=[LIGHT])
    return dr.render(scene, CAMERA, settings)


def residuals(
    twist: Array,
    start: Array,
    mesh: dr.Mesh,
    target: Array,
    blur: Array,
    settings: dr.RenderSettings,
) -> Array:
    """Blurred difference of the pictures."""
    difference = picture(mesh, placed(start, twist), settings) - target
    return dr.fit.gaussian_blur(difference, blur, radius=settings.height // 5)


def pose_errors(transform: Array) -> dict[str, float]:
    """Angle and distance from the true pose, the latter in percent of the object's size."""
    turn = dr.linalg.so3_log(transform[:3, :3] @ TRUTH[:3, :3].T)
    shift = transform[:3, 3] - TRUTH[:3, 3]
    return {
        "rotation_degrees": float(jnp.degrees(dr.linalg.norm(turn))),
        "translation_percent": 100 * float(dr.linalg.norm(shift)),
    }


def random_pose(generator: np.random.Generator, degrees: float, percent: float) -> Array:
    """Return a pose up to so many degrees and percent of the size away from the truth."""
    twist = generator.normal(size=(2, 3))
    twist *= generator.uniform(size=(2, 1)) / np.linalg.norm(twist, axis=1, keepdims=True)
    twist *= np.array([[percent / 100], [np.radians(degrees)]])
    return placed(TRUTH, jnp.asarray(twist.reshape(6), jnp.float32))


def fit(
    start: Array, mesh: dr.Mesh, target: Array, settings: dr.RenderSettings, steps: int
) -> tuple[Array, dict[str, Any]]:
    """Return the pose found, coarse to fine, and its errors, renders and seconds."""
    twist, renders, seconds = jnp.zeros(6), 0, 0.0
    for blur in BLURS:
        result = dr.fit.least_squares(
            residuals,
            twist,
            args=(start, mesh, target, jnp.float32(blur * settings.height / 128), settings),
            steps=steps,
            tolerance=1e-5,
            callback=Patience(),
        )
        twist, renders = result.params, renders + result.renders
        seconds += result.seconds
    found = placed(start, twist)
    errors = pose_errors(found)
    converged = all(errors[name] <= limit for name, limit in CRITERION.items())
    return found, {"converged": converged, **errors, "renders": renders, "seconds": seconds}


def run(
    out: Path,
    *,
    starts: int = 20,
    size: int = 128,
    cells: int = 4,
    degrees: float = 8.0,
    percent: float = 5.0,
    steps: int = 12,
    seed: int = 0,
    compare: bool = False,
    progress: bool = False,
) -> dict[str, Any]:
    """Fit from random starts; see the module's docstring for the result."""
    began = time.perf_counter()
    mesh = lattice(cells)
    exact = exact_settings(size)
    target = picture(mesh, TRUTH, exact)
    settings = {
        name: dr.RenderSettings(height=size, width=size, antialias=name == "visibility")
        for name in METHODS[: 1 + compare]
    }
    generator = np.random.default_rng(seed)
    rows, pairs = [], []
    for number in range(starts):
        start = random_pose(generator, degrees, percent)
        fits = {name: fit(start, mesh, target, settings[name], steps) for name in settings}
        pairs.append((start, fits["visibility"][0]))
        rows.append({"at_start": pose_errors(start)} | {name: fits[name][1] for name in fits})
        if progress:
            found = [name for name in fits if fits[name][1]["converged"]]
            print(f"start {number + 1} of {starts}: {found}", flush=True)
    report = {
        "criterion": CRITERION,
        "size": size,
        "degrees": degrees,
        "percent": percent,
        "seed": seed,
        "methods": {name: statistics([row[name] for row in rows], CRITERION) for name in settings},
        "seconds": time.perf_counter() - began,
        "starts": rows,
    }
    save_json(out / "fit_pose.json", report)
    before, after = (picture(mesh, pose, exact) for pose in pairs[0])
    plot(out / "fit_pose.png", (target, before, after), rows)
    return report


def plot(path: Path, images: tuple[Array, Array, Array], rows: list[dict[str, Any]]) -> None:
    """Draw target, start, result and difference of one fit, and the errors of all starts."""
    plt = pyplot()
    figure = plt.figure(figsize=(12, 7), layout="constrained")
    axes = figure.subplot_mosaic("abcd;eeff")
    show_fit([axes[place] for place in "abcd"], *images)
    labels = ("rotation error (degrees)", "translation error (% of size)")
    for place, name, label in zip("ef", CRITERION, labels, strict=True):
        axes[place].semilogy([row["at_start"][name] for row in rows], "kx", label="start")
        for method in METHODS[: len(rows[0]) - 1]:
            axes[place].semilogy([row[method][name] for row in rows], "o", label=method, alpha=0.6)
        axes[place].axhline(CRITERION[name], color="0.6", zorder=0)
        axes[place].set_xlabel("number of the start")
        axes[place].set_ylabel(label)
    axes["e"].legend(fontsize="small")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = random_start_options(__doc__, "fit_pose", starts=20, size=128)
    parser.add_argument("--cells", type=int, default=4, help="of the lattice, along each edge")
    parser.add_argument("--degrees", type=float, default=8.0, help="turn the starts by up to")
    parser.add_argument("--percent", type=float, default=5.0, help="move the starts by up to")
    parser.add_argument("--steps", type=int, default=12, help="at most, of each level of blur")
    parser.add_argument(
        "--compare", action="store_true", help="fit without the derivative of visibility too"
    )
    options = vars(parser.parse_args())
    report = run(options.pop("out"), progress=not options.pop("quiet"), **options)
    for name, figures in report["methods"].items():
        print(
            f"{name}: {100 * figures['share_converged']:.0f} % found; median errors"
            f" {figures['median_rotation_degrees']:.3f} degrees and"
            f" {figures['median_translation_percent']:.3f} % of the size,"
            f" {figures['median_renders']:.0f} pictures with derivative,"
            f" {figures['median_seconds']:.1f} s"
        )


if __name__ == "__main__":
    main()
