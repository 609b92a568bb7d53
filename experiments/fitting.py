"""The fit of cameras, lights and materials to a picture, coarse to fine.

The residuals are plain differences of pictures, blurred at the coarse levels; their derivative by
all parameters is the renderer's own, in forward mode: one render and one pass for each parameter.
"""

import dataclasses
import functools
import itertools
import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import (
    Problem,
    View,
    mean_difference,
    pyplot,
    render_view,
    save_comparison,
    save_json,
)
from jax import Array
from parameters import (
    CAMERA_PARAMETERS,
    Params,
    Start,
    appearance_of,
    moved_camera,
    start_of,
    start_parameters,
    view_errors,
    view_of,
)

import diffrast as dr

RADIUS = 32  # pixels to either side that blurring looks at


class Level(NamedTuple):
    """One stage of a fit.

    Attributes:
        shrink: how many times smaller than the target the pictures are.
        samples: samples a pixel.
        blur: standard deviation of the Gaussian blur of the difference, in these pixels.
        steps: at most.
        perspective: whether the camera's last parameter takes part: far from the solution it can
            explain nearly anything.
    """

    shrink: int
    samples: int
    blur: float
    steps: int
    perspective: bool


def coarse_to_fine(height: int, width: int) -> list[Level]:
    """Blurred pictures of at least 100 pixels a side, then the full size."""
    common = math.gcd(height, width)
    small_enough = [
        f for f in range(1, common + 1) if common % f == 0 and min(height, width) >= 100 * f
    ]
    shrink = max(small_enough, default=1)
    unit = min(height, width) / shrink / 128
    samples = 4 if shrink > 1 else 16  # a small picture holds much that is smaller than a pixel
    return [
        Level(shrink, samples, 8 * unit, 20, False),
        Level(shrink, samples, 2 * unit, 20, True),
        Level(1, samples, 0.0 if shrink > 1 else 0.5, 10, True),
    ]


# Residuals ----------------------------------------------------------------------------------------


@functools.cache
def residual_function(
    height: int, width: int, samples: int, radius: int, antialias: bool = True
) -> Any:
    """Residuals of a level, always the same function for the same numbers: it compiles once.

    Called as `residuals(params, start, target, blur, moving)`; where `moving` is 0 and not 1, the
    camera's parameter has no derivative. Of lights and materials alone edges say nothing.
    """

    def residuals(params: Params, start: Start, target: Array, blur: Array, moving: Array) -> Array:
        camera = params.get("camera", jnp.zeros(CAMERA_PARAMETERS))
        camera = jnp.where(moving > 0, camera, jax.lax.stop_gradient(camera))
        view = View(moved_camera(start, camera), *appearance_of(start, params), start.background)
        image = render_view(start.mesh, view, height, width, samples, antialias)
        return dr.fit.gaussian_blur(image - target, blur, radius=radius)

    return residuals


# Fit ----------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Fit:
    """The outcome of a fit.

    Attributes:
        params: the parameters found, see `parameters`.
        view: what they stand for.
        trace: for the start and every step: level, renders so far, root mean square residual, and
            errors where the truth is known.
        renders: pictures rendered.
        derivatives: forward derivative passes, one for each parameter and picture.
        seconds: wall-clock time, compilation included.
    """

    params: Params
    view: View
    trace: list[dict[str, float]]
    renders: int
    derivatives: int
    seconds: float


class Patience:
    """Ends a fit when several steps running lower the loss by less than a thousandth in all.

    The loss of a picture with finitely many samples is rough: the last steps only follow that.
    """

    def __init__(self, steps: int = 3) -> None:
        self._steps = steps
        self._losses: list[float] = []

    def __call__(self, step: int, params: Params, loss: float) -> bool:
        """Take note of a step, and tell whether to stop."""
        self._losses.append(loss)
        if len(self._losses) <= self._steps or self._losses[-1] == self._losses[0]:
            return False
        return loss > 0.999 * self._losses[-1 - self._steps]


def moving(level: Level) -> Array:
    """Which of the camera's parameters take part, as ones and zeros."""
    return jnp.ones(CAMERA_PARAMETERS).at[-1].set(float(level.perspective))


def fit(
    problem: Problem,
    params: Params,
    *,
    levels: list[Level] | None = None,
    progress: bool = False,
) -> Fit:
    """Fit `params`, as made by `start_parameters`, to the target by Levenberg-Marquardt steps."""
    started = time.perf_counter()
    height, width = problem.target.shape[:2]
    start = start_of(problem.mesh, problem.start)
    trace: list[dict[str, float]] = []
    renders = derivatives = 0
    columns = sum(leaf.size for leaf in jax.tree.leaves(params))
    for number, level in enumerate(levels or coarse_to_fine(height, width)):
        result = fit_level(start, problem.target, params, level, progress=progress)
        for step, (loss, at) in enumerate(
            zip(result.history.loss, result.history.params, strict=True)
        ):
            entry: dict[str, float] = {
                "level": number,
                "renders": renders + step + 1,
            }
            entry["residual"] = math.sqrt(2 * loss * level.shrink**2 / problem.target.size)
            if problem.truth is not None:
                entry |= view_errors(view_of(start, at), problem.truth, float(start.size))
            trace.append(entry)
        params = result.params
        renders += result.renders
        derivatives += result.renders * columns
    return Fit(
        params=params,
        view=view_of(start, params),
        trace=trace,
        renders=renders,
        derivatives=derivatives,
        seconds=time.perf_counter() - started,
    )


def fit_level(
    start: Start, target: Array, params: Params, level: Level, *, progress: bool = False
) -> dr.fit.FitResult:
    """Fit at one level."""
    small = dr.fit.downsample(target, level.shrink)
    height, width = small.shape[:2]
    radius = RADIUS if level.blur > 0 else 0
    return dr.fit.least_squares(
        residual_function(height, width, level.samples, radius, "camera" in params),
        params,
        args=(start, small, jnp.float32(level.blur), moving(level)),
        steps=level.steps,
        damping=0.1,
        tolerance=1e-4,
        record_params=True,
        progress=progress,
        callback=Patience(),
    )


# Report -------------------------------------------------------------------------------------------


def run_fit(
    problem: Problem,
    out: Path,
    *,
    levels: list[Level] | None = None,
    progress: bool = False,
    **what: bool,
) -> dict[str, Any]:
    """Fit what `start_parameters` is asked for, and write picture, convergence plot and JSON.

    Returns:
        What the JSON file holds: the recovered view, its errors where the truth is known, the mean
        difference of the pictures in sRGB steps of 1/255, renders, seconds and the trace.
    """
    result = fit(problem, start_parameters(problem.start, **what), levels=levels, progress=progress)
    height, width = problem.target.shape[:2]
    before = render_view(problem.mesh, problem.start, height, width)
    after = render_view(problem.mesh, result.view, height, width)
    report = {
        "problem": problem.name,
        "fitted": sorted(result.params),
        "errors": _errors_of(result.trace[-1]),
        "errors_at_start": _errors_of(result.trace[0]),
        "image_difference": mean_difference(after, problem.target),
        "image_difference_at_start": mean_difference(before, problem.target),
        "renders": result.renders,
        "derivatives": result.derivatives,
        "seconds": result.seconds,
        "recovered": result.view,
        "trace": result.trace,
    }
    save_json(out / f"{problem.name}.json", report)
    save_comparison(out / f"{problem.name}.png", problem.target, before, after)
    plot_convergence(out / f"{problem.name}_convergence.png", result.trace)
    return report


def _errors_of(entry: dict[str, float]) -> dict[str, float]:
    return {key: entry[key] for key in entry if key not in ("level", "renders", "residual")}


def plot_convergence(path: Path, trace: list[dict[str, float]]) -> None:
    """Draw residual and errors against the renders so far; vertical lines part the levels."""
    plt = pyplot()
    figure, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    renders = [entry["renders"] for entry in trace]
    axes[0].semilogy(renders, [entry["residual"] for entry in trace], ".-")
    axes[0].set_ylabel("RMS of the blurred difference")
    for name in _errors_of(trace[0]):
        values = np.array([entry[name] for entry in trace])
        if values.any():
            axes[1].semilogy(renders, np.where(values > 0, values, np.nan), ".-", label=name)
    axes[1].set_ylabel("error")
    if axes[1].lines:
        axes[1].legend(fontsize="small")
    for axis in axes:
        axis.set_xlabel("renders")
        for before, after in itertools.pairwise(trace):
            if before["level"] != after["level"]:
                axis.axvline((before["renders"] + after["renders"]) / 2, color="0.8", zorder=0)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def summary(report: dict[str, Any]) -> str:
    """Say in a few lines what a fit found."""
    lines = [
        f"{report['problem']}: mean difference {report['image_difference']:.3f}/255"
        f" (start {report['image_difference_at_start']:.2f}),"
        f" {report['renders']} renders, {report['seconds']:.0f} s"
    ]
    for name, value in report["errors"].items():
        lines.append(f"  {name:28} {value:9.4f}  (start {report['errors_at_start'][name]:.4f})")
    camera = report["recovered"].camera
    numbers = {name: np.round(np.asarray(camera[name]), 4).tolist() for name in ("eye", "target")}
    lines.append(f"  camera: {numbers}, fov_y {np.degrees(float(camera['fov_y'])):.3f} degrees")
    return "\n".join(lines)
