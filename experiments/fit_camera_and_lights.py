"""Can camera and lights be found together from one picture?

    python experiments/fit_camera_and_lights.py
    python experiments/fit_camera_and_lights.py --unknown-material
    python experiments/fit_camera_and_lights.py --mesh cow.obj --image photo.png --eye 0 1 5

The camera (seven numbers) and the directions, positions and colours of all lights are fitted to
the picture. Expected for the built-in teapot, from 12 degrees and 25 % of the distance away and a
light 20 degrees off: rotation within 0.05 degrees, the eye within 0.1 % of its distance, the light
within 0.5 degrees, the pictures within 1/255 on average, in about a minute on two cores.

The material is that of the start. With `--unknown-material`, and always for a picture of one's own,
it is fitted as well, starting from dull grey; then only the products of the colours of light and
material can be known, the first light keeps its colours, and the errors are those of the products.
Written to `--out`: the recovered parameters (JSON), a picture (target, start, result, 16 times
their difference round grey) and the convergence.
"""

import dataclasses
from pathlib import Path
from typing import Any

from common import UNKNOWN_MATERIAL, Problem, fitting_options, problem_from_options
from fitting import run_fit, summary

import diffrast as dr


def run(
    problem: Problem, out: Path, *, known_material: bool = True, progress: bool = False
) -> dict[str, Any]:
    """Fit camera and lights; see the module's docstring for the result."""
    if not known_material:
        start = dataclasses.replace(problem.start, material=dr.Material(**UNKNOWN_MATERIAL))
        problem = dataclasses.replace(problem, start=start)
    return run_fit(problem, out, material=not known_material, progress=progress)


def main() -> None:
    parser = fitting_options(__doc__, "fit_camera_and_lights")
    parser.add_argument("--unknown-material", action="store_true", help="fit the material, too")
    options = parser.parse_args()
    problem = problem_from_options(options)
    known = not options.unknown_material and options.image is None
    report = run(problem, options.out, known_material=known, progress=not options.quiet)
    print(summary(report))


if __name__ == "__main__":
    main()
