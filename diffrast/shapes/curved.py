"""Spheres, plane, cylinder, cone, torus and height fields (FEATURES G2, G3).

All are centred at the origin, with the z axis for their axis; angles start at the x axis. Normals
are the exact ones of the curved surface, split at sharp rims; faces are counter-clockwise from
outside, and solids are closed once vertices at one place are welded (they are equal to the bit).
Sizes may be traced and are differentiable; numbers of segments are static. Texture coordinates
run once round the axis with u and along it with v, both from 0 to 1.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast.linalg import normalize
from diffrast.mesh import Mesh, vertex_normals
from diffrast.shapes._grid import grid_faces, grid_uvs, two_counts, unit_circle
from diffrast.shapes.solids import icosahedron_arrays


@_check.known_of_known
def icosphere(subdivisions: int = 3, radius: ArrayLike = 1.0) -> Mesh:
    """Sphere of 20·4ⁿ nearly equal triangles: an icosahedron cut n times (Van Houdt 8).

    Each triangle is cut into four at the middles of its edges, which are then moved out to the
    sphere. It has no texture coordinates; `uv_sphere` has.
    """
    count = _check.positive_int("subdivisions", subdivisions, minimum=0, maximum=13)
    length = _check.real_number("radius", radius, above=0.0)
    unit, faces = icosahedron_arrays()
    for _ in range(count):
        unit, faces = _subdivide(unit, faces)
    return Mesh(vertices=length * unit, faces=faces, normals=unit)


def _subdivide(unit: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    edges, index = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    middles = unit[edges].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    a, b, c = faces.T
    ab, bc, ca = (len(unit) + index.reshape(-1, 3)).T
    parts = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], axis=1)
    return np.concatenate([unit, middles]), parts.reshape(-1, 3)


@_check.known_of_known
def uv_sphere(radius: ArrayLike = 1.0, *, segments: int = 32, rings: int = 16) -> Mesh:
    """Sphere of meridians and parallels, with texture coordinates.

    Args:
        radius: above 0.
        segments: cells round the axis, at least 3.
        rings: cells from pole to pole, at least 2. A pole is a vertex for each segment.
    """
    length = _check.real_number("radius", radius, above=0.0)
    _check.positive_int("segments", segments, minimum=3)
    _check.positive_int("rings", rings, minimum=2)
    latitude = np.pi * (np.arange(1, rings) / rings - 0.5)
    unit = _around(unit_circle(segments), np.stack([np.cos(latitude), np.sin(latitude)], axis=1))
    pole = np.tile([[0.0, 0, 1]], (segments, 1))

    faces = grid_faces(segments, rings - 2) if rings > 2 else np.zeros((0, 3), np.int32)
    below, left = len(unit) + np.arange(segments), np.arange(segments)
    south = np.stack([below, left + 1, left], axis=1)
    left = left + len(unit) - segments - 1
    north = np.stack([below + segments, left, left + 1], axis=1)

    uvs = grid_uvs(segments, rings)[segments + 1 : -segments - 1]
    middle = (np.arange(segments) + 0.5) / segments
    ends = [np.stack([middle, np.full(segments, v)], axis=1) for v in (0.0, 1.0)]
    unit = np.concatenate([unit, -pole, pole])
    return Mesh(
        vertices=length * unit,
        faces=np.concatenate([faces, south, north]),
        normals=unit,
        uvs=np.concatenate([uvs, *ends]),
    )


@_check.known_of_known
def plane(
    width: ArrayLike = 2.0, height: ArrayLike = 2.0, *, divisions: int | tuple[int, ...] = 1
) -> Mesh:
    """Rectangle in the plane z = 0, facing +z: u along x (`width`), v along y (`height`).

    Args:
        width: extent along x, above 0.
        height: extent along y, above 0.
        divisions: number of cells along both axes, or (along x, along y).
    """
    columns, rows = two_counts("divisions", divisions)
    uvs = grid_uvs(columns, rows)
    unit = np.pad(uvs - 0.5, ((0, 0), (0, 1)))
    normals = np.tile([[0.0, 0, 1]], (len(unit), 1))
    size = _sizes(width=width, height=height)
    scale = jnp.stack([*size, jnp.ones_like(size[0])])
    return Mesh(vertices=scale * unit, faces=grid_faces(columns, rows), normals=normals, uvs=uvs)


@_check.known_of_known
def cylinder(
    radius: ArrayLike = 1.0,
    height: ArrayLike = 2.0,
    *,
    segments: int = 32,
    divisions: int = 1,
    caps: bool = True,
) -> Mesh:
    """Cylinder from z = −height/2 to height/2.

    Args:
        radius: above 0.
        height: above 0.
        segments: cells round the axis, at least 3.
        divisions: cells along the axis.
        caps: whether the ends are closed.
    """
    length, extent = _sizes(radius=radius, height=height)
    _check.positive_int("segments", segments, minimum=3)
    _check.positive_int("divisions", divisions)
    level = np.arange(divisions + 1) / divisions - 0.5
    unit = _around(unit_circle(segments), np.stack([np.ones_like(level), level], axis=1))
    uvs, faces = grid_uvs(segments, divisions), grid_faces(segments, divisions)
    parts = [(unit, unit * [1, 1, 0], uvs, faces)]
    if _check.flag("caps", caps):
        parts += [_cap(segments, level=-0.5), _cap(segments, level=0.5)]
    vertices, normals, uvs, faces = _join(parts)
    scale = jnp.stack([length, length, extent])
    return Mesh(vertices=scale * vertices, faces=faces, normals=normals, uvs=uvs)


@_check.known_of_known
def cone(
    radius: ArrayLike = 1.0, height: ArrayLike = 2.0, *, segments: int = 32, caps: bool = True
) -> Mesh:
    """Cone with its base at z = −height/2 and its apex at z = height/2.

    The apex is a vertex for each segment, with the normal of the segment's middle.

    Args:
        radius: of the base, above 0.
        height: above 0.
        segments: cells round the axis, at least 3.
        caps: whether the base is closed.
    """
    length, extent = _sizes(radius=radius, height=height)
    _check.positive_int("segments", segments, minimum=3)
    circle = unit_circle(segments)
    base = np.pad(circle, ((0, 0), (0, 1)), constant_values=-0.5)
    apex = np.tile([[0, 0, 0.5]], (segments, 1))
    middle = np.pi * (2 * np.arange(segments) + 1) / segments
    outward = np.concatenate([circle, np.stack([np.cos(middle), np.sin(middle)], axis=1)])
    side = np.arange(segments)
    u = np.concatenate([np.arange(segments + 1), side + 0.5]) / segments
    uvs = np.stack([u, np.repeat([0.0, 1.0], [segments + 1, segments])], axis=1)
    faces = np.stack([side, side + 1, segments + 1 + side], axis=1)
    parts = [(np.concatenate([base, apex]), np.pad(outward, ((0, 0), (0, 1))), uvs, faces)]
    if _check.flag("caps", caps):
        parts.append(_cap(segments, level=-0.5))
    vertices, normals, uvs, faces = _join(parts)
    # On the slope, `height` outwards goes with `radius` upwards; the base points straight down.
    outward_part, upward_part = normalize(jnp.stack([extent, length]))
    slope = jnp.stack([outward_part, outward_part, upward_part])
    tilted = slope * np.pad(normals[:, :2], ((0, 0), (0, 1)), constant_values=1)
    return Mesh(
        vertices=jnp.stack([length, length, extent]) * vertices,
        faces=faces,
        normals=jnp.where(normals[:, 2:] == 0, tilted, normals),
        uvs=uvs,
    )


@_check.known_of_known
def torus(
    major_radius: ArrayLike = 1.0,
    minor_radius: ArrayLike = 0.4,
    *,
    major_segments: int = 48,
    minor_segments: int = 24,
) -> Mesh:
    """Ring round the z axis; u runs round the axis, v round the tube from its outermost line.

    Args:
        major_radius: from the axis to the middle of the tube, above 0.
        minor_radius: of the tube, above 0 (and below `major_radius`, or it meets itself).
        major_segments: cells round the axis, at least 3.
        minor_segments: cells round the tube, at least 3.
    """
    major, minor = _sizes(major_radius=major_radius, minor_radius=minor_radius)
    columns = _check.positive_int("major_segments", major_segments, minimum=3)
    rows = _check.positive_int("minor_segments", minor_segments, minimum=3)
    circle = unit_circle(columns)
    normals = _around(circle, unit_circle(rows))
    middle = _around(circle, np.tile([[1.0, 0.0]], (rows + 1, 1)))
    return Mesh(
        vertices=major * middle + minor * normals,
        faces=grid_faces(columns, rows),
        normals=normals,
        uvs=grid_uvs(columns, rows),
    )


@_check.known_of_known
def height_field(heights: ArrayInput, width: ArrayLike = 2.0, height: ArrayLike = 2.0) -> Mesh:
    """Surface z = heights over a rectangle, facing +z, differentiable in the heights.

    Seen from above, with y up, the heights lie as the pixels of an image do: rows from the top,
    columns from the left. Vertex i·M + j belongs to `heights[i, j]`. Normals are the averages of
    the triangles', weighted by area.

    Args:
        heights: shape (N, M), both at least 2.
        width: extent along x, above 0.
        height: extent along y, above 0.
    """
    z = _check.float_array("heights", heights, ("rows", "columns"))
    if min(z.shape) < 2:
        raise ValueError(f"heights: wanted at least 2 rows and 2 columns, got shape {z.shape}")
    rows, columns = z.shape[0] - 1, z.shape[1] - 1
    uvs = grid_uvs(columns, rows) * [1, -1] + [0, 1]
    flat = jnp.stack(_sizes(width=width, height=height)) * (uvs - 0.5)
    vertices = jnp.concatenate([flat, z.reshape(-1, 1)], axis=1)
    faces = grid_faces(columns, rows)[:, ::-1]
    return Mesh(vertices=vertices, faces=faces, normals=vertex_normals(vertices, faces), uvs=uvs)


def _sizes(**sizes: ArrayLike) -> list[Array]:
    return [_check.real_number(name, size, above=0.0) for name, size in sizes.items()]


def _around(circle: np.ndarray, profile: np.ndarray) -> np.ndarray:
    """Turn a profile of (distance from the axis, z) about the axis: row after row, (n, 3)."""
    distance, level = profile[:, None, :1], profile[:, None, 1:]
    around = distance * circle
    up = np.broadcast_to(level, (*around.shape[:2], 1))
    return np.concatenate([around, up], axis=2).reshape(-1, 3)


def _cap(segments: int, level: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Disk at z = level facing away from z = 0: vertices, normals, uvs (seen from +z), faces."""
    circle = np.concatenate([[[0.0, 0.0]], unit_circle(segments)[:-1]])
    vertices = np.pad(circle, ((0, 0), (0, 1)), constant_values=level)
    normals = np.tile([[0, 0, np.sign(level)]], (len(vertices), 1))
    side = 1 + np.arange(segments)
    rim = [side, np.roll(side, -1)] if level > 0 else [np.roll(side, -1), side]
    faces = np.stack([np.zeros(segments, int), *rim], axis=1)
    return vertices, normals, (circle + 1) / 2, faces


def _join(
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
) -> list[np.ndarray]:
    """Concatenate (vertices, normals, uvs, faces)."""
    vertices, normals, uvs, faces = zip(*parts, strict=True)
    offsets = np.cumsum([0, *(len(part) for part in vertices)])
    shifted = [part + offset for part, offset in zip(faces, offsets, strict=False)]
    return [np.concatenate(arrays) for arrays in (vertices, normals, uvs, shifted)]
