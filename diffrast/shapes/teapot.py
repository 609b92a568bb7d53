"""The Utah teapot (FEATURES G6; Newell 1975, after Kos 12.4.3)."""

from collections.abc import Sequence
from importlib import resources

import numpy as np

from diffrast import _check
from diffrast.mesh import Mesh
from diffrast.shapes.bezier import BezierPatches, bezier_mesh, parse_bezier

SURFACES = ("body", "handle", "spout", "lid", "base")


def teapot_patches() -> BezierPatches:
    """The 306 control points and 32 patches of the teapot, for `bezier_mesh` and for fitting."""
    file = resources.files("diffrast.shapes") / "teapot.bez"
    return parse_bezier(file.read_text(encoding="ascii"), "teapot.bez")


def teapot(divisions: int | tuple[int, ...] = 10, *, surfaces: Sequence[str] | None = None) -> Mesh:
    """The Utah teapot, standing on z = 0 with z up and the spout towards +x, 3.15 high.

    Normals are those of the patches, also at the poles of lid and base, and point out. The mesh
    has (divisions + 1)² vertices and 2·divisions² faces for each of 32 patches, in the order of
    the file; where a row of control points collapses at a pole, one triangle of each cell has no
    area. Texture coordinates are the parameters (u, v) of each patch.

    Args:
        divisions: cells along each edge of a patch, or (along u, along v).
        surfaces: which parts to make, of "body", "handle", "spout", "lid" and "base"; `None`
            makes all.
    """
    patches = teapot_patches()
    wanted = SURFACES if surfaces is None else surfaces
    _check.iterable("surfaces", wanted, "a list of names")
    numbers = [SURFACES.index(_check.one_of("surfaces", name, SURFACES)) for name in wanted]
    if not numbers:
        raise ValueError("surfaces: wanted at least one name, got none")
    return bezier_mesh(patches.control_points[np.isin(patches.surfaces, numbers)], divisions)
