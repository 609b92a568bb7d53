"""Can the camera be found from one picture, when lights and material are known?

    python experiments/fit_camera.py
    python experiments/fit_camera.py --mesh bunny.obj --image photo.png --eye 0 1 5 --fov 40

Seven numbers, eye, rotation and angle of view, are fitted to the picture. Lights and material are
the true ones where the JSON file tells them, else those of the start. Expected for the built-in
teapot, from 12 degrees and 25 % of the distance away: rotation within 0.05 degrees and the eye
within 0.1 % of its distance, in about a minute on two cores. Written to `--out`: the recovered
parameters (JSON), a picture (target, start, result, 16 times their difference round grey) and the
convergence.
"""

import dataclasses
from pathlib import Path
from typing import Any

from common import Problem, fitting_options, problem_from_options
from fitting import run_fit, summary


def run(problem: Problem, out: Path, *, progress: bool = False) -> dict[str, Any]:
    """Fit the camera; see the module's docstring for the result."""
    known = problem.truth or problem.start
    start = dataclasses.replace(known, camera=problem.start.camera)
    problem = dataclasses.replace(problem, start=start)
    return run_fit(problem, out, lights=False, progress=progress)


def main() -> None:
    options = fitting_options(__doc__, "fit_camera").parse_args()
    print(summary(run(problem_from_options(options), options.out, progress=not options.quiet)))


if __name__ == "__main__":
    main()
