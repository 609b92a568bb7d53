"""Can the lights be found from one picture, when camera and material are known?

    python experiments/fit_lights.py

Directions, positions and colours (diffuse and specular) of all lights are fitted, with the
renderer's own forward derivative. The camera and the material are the true ones where the JSON
file tells them, else those of the start. Expected for the built-in teapot, from 20 degrees away:
the direction within 0.5 degrees. With `--unknown-material` the material is fitted as well, starting
from dull grey; then only the products of the colours of light and material can be known, the first
light keeps its colours, and the errors are those of the products. Written to `--out`: the
recovered parameters (JSON), a picture (target, start, result, 16 times their difference round
grey) and the convergence.
"""

import dataclasses
from pathlib import Path
from typing import Any

from common import UNKNOWN_MATERIAL, Problem, fitting_options, problem_from_options
from fitting import Level, run_fit, summary

import diffrast as dr


def run(
    problem: Problem, out: Path, *, known_material: bool = True, progress: bool = False
) -> dict[str, Any]:
    """Fit the lights; see the module's docstring for the result."""
    known = problem.truth or problem.start
    material = known.material if known_material else dr.Material(**UNKNOWN_MATERIAL)
    start = dataclasses.replace(known, lights=problem.start.lights, material=material)
    return run_fit(
        dataclasses.replace(problem, start=start),
        out,
        camera=False,
        material=not known_material,
        levels=[Level(shrink=1, samples=4, blur=0.0, steps=30, perspective=False)],
        progress=progress,
    )


def main() -> None:
    parser = fitting_options(__doc__, "fit_lights")
    parser.add_argument("--unknown-material", action="store_true", help="fit the material, too")
    options = parser.parse_args()
    report = run(
        problem_from_options(options),
        options.out,
        known_material=not options.unknown_material,
        progress=not options.quiet,
    )
    print(summary(report))


if __name__ == "__main__":
    main()
