"""Polygons and lines cut off at the view frustum (FEATURES T5; Van Houdt 16, Kos 2.4.4.3).

Rasterising needs none of this: it works in homogeneous coordinates. What is exported, or drawn by
other means, can be cut here to what a camera sees, one plane after another (Sutherland and Hodgman
1974), for all polygons at a time. Clip coordinates are cut before the division by w, so that
points behind the eye are as good as others.

Where a side crosses a plane the new corner is computed from the corner inside: two polygons that
share a side get the same corner, to the bit.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast.camera import Camera, world_to_clip
from diffrast.linalg import normalize
from diffrast.mesh import Mesh

# Near, far, right, left, top, bottom: inside, the product with (x, y, z, w) is not negative.
FRUSTUM = ((0, 0, 1, 1), (0, 0, -1, 1), (-1, 0, 0, 1), (1, 0, 0, 1), (0, -1, 0, 1), (0, 1, 0, 1))


class ClippedPolygons(NamedTuple):
    """What is left of triangles; corners in the sense of the triangle, the rest zeros.

    Attributes:
        corners: clip coordinates.
        barycentrics: of each corner in its triangle, linear in space: attributes mix by them.
        sizes: number of corners, 0 or at least 3; of a triangle that only touches the planes 0.
    """

    corners: Float[Array, "faces corners 4"]
    barycentrics: Float[Array, "faces corners 3"]
    sizes: Int[Array, " faces"]


class ClippedLines(NamedTuple):
    """What is left of lines; zeros where nothing is.

    Attributes:
        ends: clip coordinates of both ends.
        positions: of both ends on the line, from 0 at its first point to 1 at its second.
        seen: whether anything is left; of a line that only touches the planes nothing is.
    """

    ends: Float[Array, "lines 2 4"]
    positions: Float[Array, "lines 2"]
    seen: Bool[Array, " lines"]


def clip_triangles(
    positions_clip: ArrayInput, faces: ArrayInput, *, planes: ArrayInput = FRUSTUM
) -> ClippedPolygons:
    """Cut triangles off at planes through the origin of clip space, by default the frustum's six.

    Of a triangle and p planes at most p + 3 corners are left. Shapes are static, so this may be
    traced; differentiable in the positions and planes, for fixed sets of corners.

    Args:
        positions_clip: (V, 4).
        faces: (F, 3).
        planes: (p, 4) coefficients; inside is where their product with a point is not negative.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and indices out of range.
    """
    positions_clip = _check.float_array("positions_clip", positions_clip, ("V", 4))
    faces = _check.index_array("faces", faces, ("F", 3), bound=positions_clip.shape[0])
    planes = _check.float_array("planes", planes, ("planes", 4)).astype(positions_clip.dtype)
    own = jnp.broadcast_to(jnp.eye(3, dtype=positions_clip.dtype), (faces.shape[0], 3, 3))
    corners = jnp.concatenate([positions_clip[faces], own], axis=2)
    count = jnp.full(faces.shape[0], 3, jnp.int32)
    for plane in planes:
        corners, count = _cut(corners, count, plane)
    exists = jnp.arange(corners.shape[1], dtype=jnp.int32) < count[:, None]
    corners = jnp.where(exists[..., None], corners, 0)
    return ClippedPolygons(corners[..., :4], corners[..., 4:], count)


def _side(points: Array, plane: Array) -> Array:
    """Distances from a plane; with all digits, of which other devices would leave some out."""
    return jnp.matmul(points, plane, precision=lax.Precision.HIGHEST)


@jax.jit
def _cut(corners: Array, count: Array, plane: Array) -> tuple[Array, Array]:
    """Polygons (F, n, values), of which `count` corners are used, with one more corner."""
    size = corners.shape[1]
    slot = jnp.arange(size, dtype=jnp.int32)
    used = slot < count[:, None]
    following = jnp.where(slot + 1 < count[:, None], slot + 1, 0)
    after = jnp.take_along_axis(corners, following[..., None], axis=1)
    here_side, after_side = _side(corners[..., :4], plane), _side(after[..., :4], plane)
    here_in, after_in = here_side >= 0, after_side >= 0
    inner = jnp.where(here_in[..., None], corners, after)
    outer = jnp.where(here_in[..., None], after, corners)
    inner_side, outer_side = (jnp.where(here_in, *pair) for pair in _both(here_side, after_side))
    crosses = used & (here_in != after_in) & (inner_side > 0)  # at 0 the corner is the crossing
    change = jnp.where(crosses, inner_side - outer_side, 1)
    share = jnp.where(crosses, inner_side, 0) / change
    crossing = inner + share[..., None] * (outer - inner)
    kept = used & here_in
    # Each corner that stays, then the crossing behind it, in the polygon's order.
    amount = kept.astype(jnp.int32) + crosses.astype(jnp.int32)
    place = jnp.cumsum(amount, axis=1) - amount
    face = jnp.arange(corners.shape[0])[:, None]
    result = jnp.zeros((corners.shape[0], size + 1, corners.shape[2]), corners.dtype)
    result = result.at[face, jnp.where(kept, place, size + 1)].set(corners, mode="drop")
    behind = jnp.where(crosses, place + kept.astype(jnp.int32), size + 1)
    result = result.at[face, behind].set(crossing, mode="drop")
    total = jnp.sum(amount, axis=1, dtype=jnp.int32)
    return result, jnp.where(total >= 3, total, 0)  # fewer have no area


def _both(first: Array, second: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    return (first, second), (second, first)


def clip_lines(
    positions_clip: ArrayInput, lines: ArrayInput, *, planes: ArrayInput = FRUSTUM
) -> ClippedLines:
    """Cut lines off at planes through the origin of clip space, by default the frustum's six.

    Differentiable in positions and planes, for fixed cuts.

    Args:
        positions_clip: (P, 4).
        lines: (L, 2) numbers of points.
        planes: as for `clip_triangles`.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and indices out of range.
    """
    positions_clip = _check.float_array("positions_clip", positions_clip, ("P", 4))
    lines = _check.index_array("lines", lines, ("lines", 2), bound=positions_clip.shape[0])
    planes = _check.float_array("planes", planes, ("planes", 4)).astype(positions_clip.dtype)
    first, second = positions_clip[lines[:, 0]], positions_clip[lines[:, 1]]
    low, high = jnp.zeros_like(first[:, 0]), jnp.ones_like(first[:, 0])
    seen = jnp.ones_like(low, dtype=bool)
    for plane in planes:
        at_first, at_second = _side(first, plane), _side(second, plane)
        leaves, enters = (at_first >= 0) & (at_second < 0), (at_first < 0) & (at_second >= 0)
        crosses = leaves | enters
        crossing = jnp.where(crosses, at_first, 0) / jnp.where(crosses, at_first - at_second, 1)
        low = jnp.where(enters, jnp.maximum(low, crossing), low)
        high = jnp.where(leaves, jnp.minimum(high, crossing), high)
        seen = seen & ((at_first >= 0) | (at_second >= 0))
    seen = seen & (low < high)
    ends = jnp.stack([first + t[:, None] * (second - first) for t in (low, high)], axis=1)
    ends = ends.at[:, 1].set(jnp.where((high == 1)[:, None], second, ends[:, 1]))
    positions = jnp.where(seen[:, None], jnp.stack([low, high], axis=1), 0)
    return ClippedLines(jnp.where(seen[:, None, None], ends, 0), positions, seen)


def clip_mesh(mesh: Mesh, camera: Camera) -> Mesh:
    """The part of a mesh that lies in a camera's frustum, in world coordinates, for export.

    Polygons that are left become fans; each triangle of the mesh gets corners of its own, with its
    normals and texture coordinates. Made on the host.

    Raises:
        ValueError: for traced meshes or cameras, and when nothing is left.
    """
    _check.instance_of("mesh", mesh, Mesh)
    clip = world_to_clip(camera, mesh.vertices)
    if not (_check.is_concrete(clip) and _check.is_concrete(mesh.faces)):
        raise ValueError("mesh: wanted known vertices, faces and camera, got traced arrays")
    cut = clip_triangles(clip, mesh.faces)
    count = np.asarray(cut.sizes)
    if not count.any():
        raise ValueError("mesh: wanted one with a part in the camera's frustum, got none")
    corners = cut.barycentrics.shape[1]
    used = np.arange(corners) < count[:, None]
    number = np.cumsum(used).reshape(used.shape) - 1
    middle = np.arange(1, corners - 1)
    owner, k = np.nonzero(middle + 1 < count[:, None])
    faces = np.stack([number[owner, 0], number[owner, k + 1], number[owner, k + 2]], axis=1)
    shares, origin = cut.barycentrics[used], np.nonzero(used)[0]
    uv_faces = mesh.faces if mesh.uv_faces is None else mesh.uv_faces

    def mixed(values: Array, indices: Array) -> Array:
        return jnp.sum(shares[..., None] * values[indices[origin]], axis=1)

    return Mesh(
        vertices=mixed(mesh.vertices, mesh.faces),
        faces=faces,
        normals=None if mesh.normals is None else normalize(mixed(mesh.normals, mesh.faces)),
        uvs=None if mesh.uvs is None else mixed(mesh.uvs, uv_faces),
    )
