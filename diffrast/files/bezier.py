"""The thesis's files of Bézier patches, *.bez (FEATURES G8; Kos 12.4.1)."""

from pathlib import Path

import numpy as np

from diffrast._check import file_path, instance_of
from diffrast._tokens import read_text
from diffrast.shapes.bezier import BezierPatches, parse_bezier


def load_bezier(path: str | Path) -> BezierPatches:
    """Read bicubic patches: `.control_points` (patches, 4, 4, 3) and `.surfaces` (patches,).

    Patches may share control points: `.points[.indices]` are those of each patch. Make a mesh by
    `diffrast.shapes.bezier_mesh(patches.control_points, divisions)`. The format is described at
    `diffrast.shapes.parse_bezier`.

    Raises:
        ValueError: with file and line, for anything that does not follow the format.
        OSError: when the file cannot be opened.
    """
    return parse_bezier(read_text(file_path("path", path)), str(path))


def save_bezier(path: str | Path, patches: BezierPatches) -> None:
    """Write bicubic patches; reading them gives the same numbers back.

    Raises:
        ValueError: for anything but patches.
        OSError: when the file cannot be written.
    """
    instance_of("patches", patches, BezierPatches)
    points = np.asarray(patches.points)
    surfaces = np.asarray(patches.surfaces)
    indices = np.asarray(patches.indices).reshape(len(surfaces), 16)
    lines = [f"{len(points)} {len(indices)} {surfaces.max() + 1}"]
    for number, (x, y, z) in enumerate(points):
        lines.append(f"{number} {_digits(x)} {_digits(y)} {_digits(z)}")
    for number, (surface, row) in enumerate(zip(surfaces, indices, strict=True)):
        lines.append(f"{number} {surface} 16 " + " ".join(map(str, row)))
    file_path("path", path).write_text("\n".join(lines) + "\n", encoding="ascii")


def _digits(value: np.floating) -> str:
    """The fewest digits that read back as the same number."""
    return np.format_float_positional(value, trim="0")
