"""What is seen at points within pixels, of the surfaces at their centres."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Int

from diffrast._device import anywhere, at_once, most
from diffrast._selection import batches_of, compacted, divided, over_batches
from diffrast._stored import stored, stored_together
from diffrast._topology import Topology, third_corner
from diffrast._varying import varying_zero
from diffrast.bending import Chosen
from diffrast.edges.neighborhood import Surface, walk
from diffrast.edges.pieces import to_pixels
from diffrast.edges.planes import FINE_TOLERANCE, corners_of, covers, edge_values
from diffrast.raster.evaluate import unit_of
from diffrast.shadows import Reached

_POINTS_AT_ONCE = 512  # that may be hidden


def _points() -> np.ndarray:
    """Where pixels are shaded, to the right of their centres and below, of shape (2, 5 points, 5).

    The centre, and four points, no two in a row or a column, of a whole pixel; then of each quarter
    of one, of all the points of a grid.
    """
    whole = np.array([[-1, 3, 1, -3], [-3, -1, 3, 1]])[:, :, None]
    corners = np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]])
    quarters = corners[:, :, None] + 2 * corners[:, None]
    points = np.pad(np.concatenate([whole, quarters], axis=2), ((0, 0), (1, 0), (0, 0)))
    return (points / 8).astype(np.float32)


POINTS = _points()
_UPRIGHT = abs(POINTS[1]) >= abs(POINTS[0])
_ASIDE = np.where([~_UPRIGHT, _UPRIGHT], np.sign(POINTS), 0).astype(np.int32)  # the next pixel


class PointsWithin(NamedTuple):
    """What is seen at points of the chosen pixels."""

    chosen: Chosen
    seen: Int[Array, " places"]  # points of each where this surface is seen
    face_image: Int[Array, "height_with_border width_with_border"]  # what is at their centres, and
    face: Int[Array, "points_but_one parts"]  # at others; -1: the surface ends there, or is hidden
    reached: Reached  # at their centres: whatever shadow begins within a pixel has its edge


class Parts(NamedTuple):
    """A batch of pixels and quarters of them."""

    place: Int[Array, " some"]
    exists: Bool[Array, " some"]
    points: Int[Array, " some"]  # which of `POINTS`


def parts_of(chosen: Chosen, n: Array, count: Array) -> Parts:
    """The batch `n` of so many parts."""
    size = chosen.at_once
    number = n * size + jnp.arange(size, dtype=jnp.int32)
    place, points = place_of(chosen, number)
    return Parts(*stored_together((place, number < count, points)))


def place_of(chosen: Chosen, part: Int[Array, " n"]) -> tuple[Array, Array]:
    """Which of the chosen pixels parts belong to, and which of `POINTS` these are."""
    after = part - chosen.plain
    whole = (after < 0) | (chosen.parts_of_each == 1)
    place = jnp.where(whole, part, chosen.plain + after // 4)
    return jnp.minimum(place, chosen.number.size - 1), jnp.where(whole, 0, 1 + after % 4)


def over_parts(chosen: Chosen, count: Array, step: Callable[[Array, Any], Any], start: Any) -> Any:
    """Fold `step(n, total)` over the batches of so many parts."""
    return lax.fori_loop(0, batches_of(most(count), chosen.at_once), step, start)


def faces_at(
    chosen: Chosen,
    face_image: Array,
    clip: Array,
    faces: Array,
    topology: Topology,
    apart: Array,
    volume: Array,
) -> Int[Array, "points_but_one parts"]:
    """The faces at the points of pixels but their centres, found from those at these.

    What the next pixels show may hide them.
    """
    height, width = face_image.shape
    count = chosen.parts

    def find(found: Array) -> Array:
        pixels = stored(to_pixels(clip / unit_of(clip), height, width))
        neighbors = lax.cond(jnp.any(apart), _parted, _together, topology, apart)
        surface = Surface(faces, pixels, topology._replace(neighbors=neighbors), volume)

        def add(n: Array, found: Array) -> Array:
            place, exists, part = parts_of(chosen, n, count)
            row, column = stored(divided(chosen.number[place], width - 2))
            x0, y0 = (at.astype(clip.dtype) + 1.5 for at in (column, row))
            centre = stored(jnp.where(exists, face_image[row + 1, column + 1], -1))
            right, down = stored(jnp.asarray(POINTS[:, 1:], clip.dtype)[:, :, part])
            point = x, y = stored_together((x0 + right, y0 + down))
            covered = covers(edge_values(corners_of(centre, faces, pixels)[:, :, None], x, y)[0])
            own = jnp.broadcast_to(centre, x.shape)
            # Beyond a fold, to which a way might lead round its end, edges tell what is seen.
            start = stored(jnp.where(covered, -1, own))
            ends, there = walk(start, x, y, surface, straight=True)
            seen = stored(jnp.where(covered, own, jnp.where(there, ends, -1)))
            right, down = stored(jnp.asarray(_ASIDE[:, 1:])[:, :, part])
            beside = stored(face_image[row + 1 + down, column + 1 + right])
            parted = exists & (place >= chosen.plain)
            beside = stored(jnp.where(parted & (beside != own), beside, -1))
            its_centre = x0 + right.astype(x0.dtype), y0 + down.astype(y0.dtype)
            seen = _unhidden(seen, beside, point, its_centre, surface)
            return lax.dynamic_update_slice_in_dim(found, seen, n * place.size, 1)

        return over_parts(chosen, count, add, found)

    nowhere = jnp.full((POINTS.shape[1] - 1, chosen.number.size), -1, jnp.int32)
    nowhere = nowhere + varying_zero((chosen, face_image, clip, faces, topology, apart, volume))
    return lax.cond(anywhere(count > 0), find, lambda nowhere: nowhere, nowhere)


def _unhidden(
    seen: Int[Array, "points_but_one parts"],
    beside: Int[Array, "points_but_one parts"],
    point: tuple[Array, Array],
    centre: tuple[Array, Array],
    surface: Surface,
) -> Int[Array, "points_but_one parts"]:
    """What is seen at points, -1 where the surface that the next pixel shows lies before that.

    It does not if at that pixel's centre it lies behind the plane of what is seen at the point.
    """
    faces, pixels, _, _ = surface
    order, count = compacted(
        ((seen >= 0) & (beside >= 0) & (beside != seen)).reshape(-1),
        jnp.arange(seen.size, dtype=jnp.int32),
    )
    known = stored_together([part.reshape(-1) for part in (beside, *point, *centre)])

    def hide(number: Array, exists: Array, seen: Array) -> Array:
        face, other, x, y, centre_x, centre_y = stored_together(
            [part[number] for part in (seen, *known)]
        )
        corners = corners_of(face, faces, pixels)

        def is_before(other: Array, x: Array, y: Array, tolerance: float = 0) -> Array:
            both = corners_of(other, faces, pixels), corners
            near, far = (edge_values(of_one, x, y)[1] for of_one in both)
            return near > far * (1 + tolerance)

        may_hide = exists & is_before(other, centre_x, centre_y)
        start = stored(jnp.where(may_hide, other, -1))
        end, there = walk(start, x, y, surface)
        hidden = there & (end >= 0) & is_before(end, x, y, FINE_TOLERANCE)
        return seen.at[jnp.where(hidden, number, seen.size)].set(-1, mode="drop")

    some = at_once(_POINTS_AT_ONCE, seen.size)
    return over_batches(order, count, some, hide, seen.reshape(-1)).reshape(seen.shape)


def _together(topology: Topology, apart: Array) -> Array:
    return topology.neighbors + varying_zero((topology, apart))


def _parted(topology: Topology, apart: Array) -> Array:
    """The neighbours of faces, but none across these edges."""
    side, count = third_corner(topology.edges.corners), topology.neighbors.shape[0]
    face = jnp.where(apart[:, None], topology.edges.faces, -1)
    face = jnp.where(face >= 0, face, count)
    return _together(topology, apart).at[face, side].set(-1, mode="drop")


def number_seen(chosen: Chosen, face: Int[Array, "points_but_one parts"]) -> Int[Array, " places"]:
    """At how many points of each pixel its surface is seen, without the centres."""
    place, _ = place_of(chosen, jnp.arange(face.shape[1], dtype=jnp.int32))
    of_parts = stored(jnp.sum(face >= 0, axis=0, dtype=jnp.int32))
    seen = jnp.zeros(chosen.number.size, jnp.int32).at[place].add(of_parts)
    return stored(seen.astype(jnp.int8))


def faces_of(points: PointsWithin, parts: Parts, n: Array) -> Int[Array, "points some"]:
    """The faces at the points of parts of the batch `n`, those at the centres first."""
    some = parts.place.size
    row, column = divided(points.chosen.number[parts.place], points.face_image.shape[1] - 2)
    centre = jnp.where(parts.exists, points.face_image[row + 1, column + 1], -1)
    others = lax.dynamic_slice_in_dim(points.face, n * some, some, 1)
    return stored(jnp.concatenate([centre[None], others]))
