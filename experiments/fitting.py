"""The fit of cameras, lights and materials to a picture, coarse to fine.

The derivative of `diffrast.render` is that of the faces that are seen; what an outline does when
the camera moves is not part of it. So the derivative by the camera is taken here by central
differences of pictures, two renders for each of its seven parameters; that by lights and materials
is the renderer's own, in forward mode.
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
RENDERS_PER_DERIVATIVE = 1 + 2 * CAMERA_PARAMETERS


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
    levels = [Level(shrink, 4, 8 * unit, 20, False), Level(shrink, 4, 2 * unit, 20, True)]
    return [*levels, Level(1, 4, 0.0 if shrink > 1 else 0.5, 10, True)]


# Residuals ----------------------------------------------------------------------------------------


def _plain_picture(
    size: tuple[int, int, int], camera: Array, appearance: Any, start: Start, steps: Array
) -> Array:
    view = View(moved_camera(start, camera), *appearance, start.background)
    return render_view(start.mesh, view, *size)


# With the derivative by the camera from differences of the length `steps`, zero for parameters
# that are held.
_picture = jax.custom_jvp(_plain_picture, nondiff_argnums=(0,))


@_picture.defjvp
def _picture_jvp(size: Any, primals: Any, tangents: Any) -> tuple[Array, Array]:
    camera, appearance, start, steps = primals
    image, change = jax.jvp(
        lambda a: _plain_picture(size, camera, a, start, steps), (appearance,), (tangents[1],)
    )

    # One loop over all moved cameras, so that one renderer is compiled for them.
    moves = jnp.diag(steps)
    moved = jax.lax.map(
        lambda move: _plain_picture(size, camera + move, appearance, start, steps),
        jnp.concatenate([moves, -moves]),
    )
    lengths = 2 * steps[:, None, None, None]
    differences = moved[:CAMERA_PARAMETERS] - moved[CAMERA_PARAMETERS:]
    columns = jnp.where(lengths > 0, differences / jnp.where(lengths > 0, lengths, 1), 0)
    return image, change + jnp.tensordot(tangents[0], columns, 1)


@functools.cache
def residual_function(height: int, width: int, samples: int, radius: int) -> Any:
    """Residuals of a level, always the same function for the same numbers: it compiles once.

    Called as `residuals(params, start, target, blur, steps)`.
    """

    def residuals(params: Params, start: Start, target: Array, blur: Array, steps: Array) -> Array:
        appearance = appearance_of(start, params)
        size = (height, width, samples)
        if "camera" in params:
            image = _picture(size, params["camera"], appearance, start, steps)
        else:
            image = _plain_picture(size, jnp.zeros(CAMERA_PARAMETERS), appearance, start, steps)
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
        renders: pictures rendered, those of differences included.
        derivatives: forward derivative passes by lights and material.
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


def difference_steps(level: Level, height: int) -> Array:
    """How far the camera's parameters move for differences: about as far as the picture is blurred.

    Half a pixel or half the blur to either side; perspective moves outlines less.
    """
    pixel = 2 * level.shrink / height
    step = pixel * max(0.5, 0.5 * level.blur)
    return jnp.asarray([step] * 6 + [4 * step * level.perspective], jnp.float32)


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
    per_evaluation = RENDERS_PER_DERIVATIVE if "camera" in params else 1
    columns = sum(
        leaf.size for key in params if key != "camera" for leaf in jax.tree.leaves(params[key])
    )
    for number, level in enumerate(levels or coarse_to_fine(height, width)):
        result = fit_level(start, problem.target, params, level, progress=progress)
        for step, (loss, at) in enumerate(
            zip(result.history.loss, result.history.params, strict=True)
        ):
            entry: dict[str, float] = {
                "level": number,
                "renders": renders + (step + 1) * per_evaluation,
            }
            entry["residual"] = math.sqrt(2 * loss * level.shrink**2 / problem.target.size)
            if problem.truth is not None:
                entry |= view_errors(view_of(start, at), problem.truth, float(start.size))
            trace.append(entry)
        params = result.params
        renders += result.renders * per_evaluation
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
        residual_function(height, width, level.samples, radius),
        params,
        args=(start, small, jnp.float32(level.blur), difference_steps(level, target.shape[0])),
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
