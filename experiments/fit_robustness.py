"""From how far away are camera and light found, and by which method?

    python experiments/fit_robustness.py
    python experiments/fit_robustness.py --problems camera --starts 50

Three problems, each with random starts. "camera": turned about the teapot by up to 30 degrees,
round any axis, and up to 15 % nearer or farther. "light": it shines from anywhere, half to twice as
strong. "both": both at once. They are fitted to one picture of 128 x 128, rendered with four times
the samples of the last level. All methods see the same blurred differences, coarse to fine:
Levenberg-Marquardt; the same with the first level from "several lights", nine all round, of which
the one that ends with the smallest difference goes on; Adam (60 steps a level, their size falling
along a cosine); and L-BFGS (with optax's line search). A start counts as converged if rotation and
light end within 0.1 degrees and the eye within 0.1 % of its distance.

As many fits run side by side as there are cores, so the seconds are those of a busy machine. After
each start the report is written; work that was interrupted goes on there.

Expected: see the README. Written to `--out`: `fit_robustness.json` with every start,
`fit_robustness.png` with the errors at the end by those of the start and by the renders used, and
for each method `failures_*.png`: target, start and result of the first starts that failed.
"""

import dataclasses
import functools
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from common import (
    DEFAULT_TARGET,
    View,
    check_same,
    load_problem,
    progress_bar,
    pyplot,
    random_start_options,
    render_view,
    save_json,
    show_fit,
    statistics,
)
from fitting import RADIUS, Level, Patience, fit_level, moving, residual_function
from jax import Array
from parameters import (
    CAMERA_PARAMETERS,
    Params,
    Start,
    moved_camera,
    start_of,
    start_parameters,
    view_errors,
    view_of,
)

import diffrast as dr

PROBLEMS = {
    "camera": {"camera": True, "lights": False},
    "light": {"camera": False, "lights": True},
    "both": {"camera": True, "lights": True},
}
CRITERION = {"rotation_degrees": 0.1, "eye_percent": 0.1, "light_0_degrees": 0.1}
ADAM_RATES = (0.03, 0.01, 0.003)  # of the levels
METHODS = ("levenberg_marquardt", "several_lights", "adam", "l_bfgs")


def levels_for(size: int) -> list[Level]:
    """Half size, blurred by a sixteenth of the picture, then full size, then more samples."""
    return [
        Level(2, 4, size / 32, 20, False),
        Level(1, 4, 1.0, 20, True),
        Level(1, 16, 0.5, 10, True),
    ]


def random_start(
    problem: str, mesh: dr.Mesh, truth: View, degrees: float, generator: np.random.Generator
) -> View:
    """What is to be found, away from the truth."""
    camera, (light,) = truth.camera, truth.lights
    if PROBLEMS[problem]["camera"]:
        axis = generator.normal(size=3)
        parameters = np.zeros(CAMERA_PARAMETERS, np.float32)
        angle = np.radians(generator.uniform(0, degrees))
        parameters[:3] = angle * axis / np.linalg.norm(axis)
        parameters[5] = -np.log(generator.uniform(0.85, 1.15))
        camera = moved_camera(start_of(mesh, truth), jnp.asarray(parameters))
    if PROBLEMS[problem]["lights"]:
        strength = np.float32(2 ** generator.uniform(-1, 1))
        light = dataclasses.replace(
            light,
            direction=jnp.asarray(generator.normal(size=3), jnp.float32),
            diffuse=strength * light.diffuse,
            specular=strength * light.specular,
        )
    return dataclasses.replace(truth, camera=camera, lights=(light,))


# Methods ------------------------------------------------------------------------------------------


def fit_with_lm(
    start: Start, target: Array, params: Params, levels: list[Level]
) -> tuple[Params, int]:
    """Return parameters and renders of a fit by Levenberg-Marquardt steps."""
    renders = 0
    for level in levels:
        result = fit_level(start, target, params, level)
        params, renders = result.params, renders + result.renders
    return params, renders


def lights_around(params: Params) -> list[Params]:
    """The same parameters, and with the light turned to eight other sides."""
    if "lights" not in params:
        return [params]
    (light,) = params["lights"]
    sides = [(0.0, 0.0)]
    for degrees, first in ((70, 0), (130, 45)):
        around = np.radians(first + 90 * np.arange(4))
        sides += list(np.radians(degrees) * np.stack([np.cos(around), np.sin(around)], axis=1))
    return [params | {"lights": [light | {"move": jnp.float32(side)}]} for side in sides]


def fit_from_several_lights(
    start: Start, target: Array, params: Params, levels: list[Level]
) -> tuple[Params, int]:
    """The same, with the first level from lights all round."""
    coarse = [fit_level(start, target, other, levels[0]) for other in lights_around(params)]
    best = min(coarse, key=lambda result: float(result.loss))
    params, renders = fit_with_lm(start, target, best.params, levels[1:])
    return params, renders + sum(result.renders for result in coarse)


@functools.cache
def mean_square(height: int, width: int, samples: int, antialias: bool) -> Callable[..., Array]:
    """The loss of the other methods, relative to `scale`."""
    residuals = residual_function(height, width, samples, RADIUS, antialias)

    def loss(
        params: Params, start: Start, target: Array, blur: Array, moving: Array, scale: Array
    ) -> Array:
        return jnp.mean(residuals(params, start, target, blur, moving) ** 2) / scale

    return loss


@functools.cache
def optimizer(method: str, level: int, steps: int) -> optax.GradientTransformation:
    """Always the same object, so that it is compiled once."""
    if method == "adam":
        return optax.adam(optax.cosine_decay_schedule(ADAM_RATES[level], steps))
    return optax.lbfgs()


def fit_with_gradients(
    method: str, start: Start, target: Array, params: Params, levels: list[Level]
) -> tuple[Params, int]:
    """Return parameters and renders of a fit by one of optax's optimizers."""
    renders = 0
    for number, level in enumerate(levels):
        small = dr.fit.downsample(target, level.shrink)
        scale, blur = jnp.mean(small**2), jnp.float32(level.blur)
        result = dr.fit.minimize(
            mean_square(*small.shape[:2], level.samples, "camera" in params),
            params,
            args=(start, small, blur, moving(level), scale),
            optimizer=optimizer(method, number, level.steps),
            steps=level.steps,
            callback=None if method == "adam" else Patience(),
        )
        params, renders = result.params, renders + result.renders
    return params, renders


# Report -------------------------------------------------------------------------------------------


def run(
    out: Path,
    *,
    problems: Sequence[str] = tuple(PROBLEMS),
    methods: Sequence[str] = METHODS,
    starts: int = 200,
    size: int = 128,
    degrees: float = 30.0,
    divisions: int = 8,
    steps: int = 60,
    seed: int = 0,
    levels: list[Level] | None = None,
    at_once: int = 1,
    told: Callable[[], Any] = lambda: None,
) -> dict[str, Any]:
    """Fit from random starts, going on from what is in `out`; see the module's docstring.

    Raises:
        ValueError: if `out` holds the report of other sizes, starts or steps.
    """
    truth = load_problem(DEFAULT_TARGET).truth
    assert truth is not None
    mesh = dr.shapes.teapot(divisions)
    target = render_view(mesh, truth, size, size, samples=64)
    asked = {"size": size, "degrees": degrees, "divisions": divisions, "steps": steps, "seed": seed}
    path = out / "fit_robustness.json"
    report: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"asked": asked}
    check_same(path, "a report", asked, report["asked"])
    report |= {"criterion": CRITERION, "fits_at_once": at_once}
    levels = levels or levels_for(size)
    gradient_levels = [level._replace(steps=steps) for level in levels]

    def begin(problem: str, number: int) -> View:
        generator = np.random.default_rng([seed, list(PROBLEMS).index(problem), number])
        return random_start(problem, mesh, truth, degrees, generator)

    def one(problem: str, method: str, number: int) -> dict[str, Any]:
        view = begin(problem, number)
        start = start_of(mesh, view)
        params = start_parameters(view, **PROBLEMS[problem])
        before = time.perf_counter()
        if method == "levenberg_marquardt":
            params, renders = fit_with_lm(start, target, params, levels)
        elif method == "several_lights":
            params, renders = fit_from_several_lights(start, target, params, levels)
        else:
            params, renders = fit_with_gradients(method, start, target, params, gradient_levels)
        params = jax.device_get(params)
        seconds = time.perf_counter() - before
        at_start, errors = (
            view_errors(found, truth, float(start.size)) for found in (view, view_of(start, params))
        )
        told()
        return {
            "at_start": at_start,
            "converged": all(errors[name] <= limit for name, limit in CRITERION.items()),
            "renders": renders,
            "seconds": seconds,
            **errors,
            "params": params,
        }

    def left() -> Iterator[tuple[str, str, int]]:
        for problem in problems:
            for method in methods:
                rows = report.setdefault("starts", {}).setdefault(problem, {})
                done = len(rows.setdefault(method, []))
                yield from ((problem, method, number) for number in range(done, starts))

    with ThreadPoolExecutor(at_once) as pool:
        todo = list(left())
        rows = pool.map(lambda job: one(*job), todo)
        for (problem, method, _), row in zip(todo, rows, strict=True):
            report["starts"][problem][method].append(row)
            save_json(path, report)
    report["found"] = {
        problem: {method: statistics(rows, CRITERION) for method, rows in found.items() if rows}
        for problem, found in report["starts"].items()
    }
    save_json(path, report)
    plot_outcomes(out / "fit_robustness.png", report)
    for method in METHODS:
        failed = [
            (begin(problem, number), row)
            for problem, found in report["starts"].items()
            for number, row in enumerate(found.get(method, []))
            if not row["converged"]
        ]
        plot_failures(out / f"failures_{method}.png", mesh, target, failed[:6])
    return report


def plot_outcomes(path: Path, report: dict[str, Any]) -> None:
    """Draw the worst error at the end, in units of the criterion, by start and by renders."""
    plt = pyplot()
    problems = report["found"]
    figure, axes = plt.subplots(
        2, len(problems), figsize=(4.2 * len(problems), 7), layout="constrained", squeeze=False
    )

    def worst(errors: dict[str, Any]) -> float:
        return max(errors[name] / limit for name, limit in CRITERION.items())

    for column, problem in enumerate(problems):
        for method, rows in report["starts"][problem].items():
            ends = [max(worst(row), 1e-3) for row in rows]
            places = [worst(row["at_start"]) for row in rows], [row["renders"] for row in rows]
            for axis, at in zip(axes[:, column], places, strict=True):
                axis.loglog(at, ends, ".", alpha=0.6, label=method.replace("_", "-"))
                axis.axhline(1, color="0.6", zorder=0)
        axes[0, column].set_title(problem)
        axes[0, column].set_xlabel("worst error at the start / limit")
        axes[1, column].set_xlabel("renders")
    for axis in axes[:, 0]:
        axis.set_ylabel("worst error at the end / limit")
    axes[0, 0].legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def plot_failures(
    path: Path, mesh: dr.Mesh, target: Array, failed: list[tuple[View, dict[str, Any]]]
) -> None:
    """Draw target, start, result and difference of starts; no file where there are none."""
    path.unlink(missing_ok=True)
    if not failed:
        return
    plt = pyplot()
    figure, axes = plt.subplots(
        len(failed), 4, figsize=(8, 2.1 * len(failed)), layout="constrained", squeeze=False
    )
    for line, (view, row) in zip(axes, failed, strict=True):
        params = jax.tree.map(jnp.float32, row["params"], is_leaf=_is_numbers)
        found = view_of(start_of(mesh, view), params)
        size = target.shape[0]
        show_fit(line, target, *(render_view(mesh, v, size, size) for v in (view, found)))
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _is_numbers(value: Any) -> bool:
    return isinstance(value, list) and not isinstance(value[0], dict)


def main() -> None:
    parser = random_start_options(__doc__, "fit_robustness", starts=200, size=128)
    parser.add_argument("--degrees", type=float, default=30.0, help="turn cameras by up to")
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument(
        "--at-once", type=int, default=os.cpu_count() or 1, help="fits side by side"
    )
    options = vars(parser.parse_args())
    out, quiet = options.pop("out"), options.pop("quiet")
    if quiet:
        report = run(out, **options)
    else:
        total = len(options["problems"]) * len(options["methods"]) * options["starts"]
        with progress_bar(total=total, unit="fit") as bar:
            report = run(out, told=bar.update, **options)
    for problem, methods in report["found"].items():
        for method, found in methods.items():
            print(problem, method, {k: v for k, v in found.items() if k != "failed"})


if __name__ == "__main__":
    main()
