"""What may lie near a piece of an edge: pixels round it, and faces round faces."""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._device import anywhere, at_once, in_strides, views_fill_lanes
from diffrast._selection import compacted, divided, integers, over_batches
from diffrast._stored import stored, stored_together
from diffrast._topology import Topology, by_three
from diffrast.edges.planes import Table, corners_of, covers, edge_values

T = TypeVar("T")

_STEPS = 40
_WAYS_AT_ONCE = 256
_SHARE = 4  # of so many mostly one at most is among a few
_BLOCK = 4  # rows and columns of pixels


class Surface(NamedTuple):
    """The faces of a scene on the screen, and how they hang together."""

    faces: Int[Array, "F 3"]
    pixels: Table
    topology: Topology
    volume: Float[Array, " F"]  # that of `facing`, but 0 for faces that are not drawn


def picked(values: Array, index: Array) -> Array:
    """One row of each column."""
    return jnp.take_along_axis(values, index[None], axis=0, mode="promise_in_bounds")[0]


def first_row(mask: Bool[Array, "rows *n"]) -> Int[Array, "*n"]:
    """The first row of each column that is true, or as many as there are."""
    rows = jnp.arange(mask.shape[0], dtype=jnp.int32).reshape(-1, *[1] * (mask.ndim - 1))
    return jnp.min(jnp.where(mask, rows, rows.size), axis=0)


def least_row(mask: Bool[Array, "rows *n"], values: Float[Array, "rows *#n"]) -> Int[Array, "*n"]:
    """The first row of each column where a value is least, of a mask, or as many as there are."""
    values = stored(jnp.where(mask, values, jnp.inf))
    return first_row(mask & (values == jnp.min(values, axis=0)))


def pixel_at(
    point: Float[Array, "2 n"], direction: Float[Array, "2 n"], distance: Array | float
) -> Int[Array, " n"]:
    """0 to 8: the pixel of the 3×3 at a distance from a point, which is given from the centre."""
    column, row = jnp.floor(point + distance * direction + 0.5).clip(-1, 1).astype(jnp.int32)
    return 4 + 3 * row + column


def steps_to(look: Int[Array, "*n"]) -> Int[Array, "2 *n"]:
    """Columns and rows from the middle one of the 3×3 pixels to another, 0 to 8."""
    row, column = by_three(look)
    return jnp.stack([column - 1, row - 1])


def pixels_round(image: Array, column: Int[Array, " n"], row: Int[Array, " n"]) -> Array:
    """The values of the 3×3 pixels round each pixel of an image with a border, shape (9, n)."""
    down, right = np.indices((3, 3), np.int32).reshape(2, 9, 1)
    return image[row + down, column + right]


def near_background(face_image: Int[Array, "height width"]) -> Bool[Array, "rows columns"]:
    """Whether blocks of pixels, or those round them, hold an empty one."""
    return largest_round(_largest_of_blocks(face_image < 0))


def _largest_of_blocks(values: Array) -> Array:
    """The largest value of each block, none of which is negative; with a border of one block."""
    height, width = values.shape
    values = jnp.pad(values, ((0, -height % _BLOCK), (0, -width % _BLOCK)))
    rows = jnp.max(values.reshape(-1, _BLOCK, values.shape[1]), axis=1)
    return jnp.pad(jnp.max(rows.reshape(rows.shape[0], -1, _BLOCK), axis=2), 1)


def largest_round(values: Array) -> Array:
    """The largest of 3×3 values each, of an image with a border of one, which is cut off."""
    rows = jnp.maximum(jnp.maximum(values[:-2], values[1:-1]), values[2:])
    return jnp.maximum(jnp.maximum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])


def nearest_round(
    depth: Float[Array, "height width"], face: Int[Array, "height width"]
) -> Int[Array, "height width"]:
    """Of the faces of 3×3 pixels each, the one with the largest `depth`, which is 1/w; or -1."""

    def nearer(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
        is_one = one[0] >= other[0]
        return jnp.where(is_one, one[0], other[0]), jnp.where(is_one, one[1], other[1])

    height, width = face.shape
    best = jnp.pad(depth, 1, constant_values=-jnp.inf), jnp.pad(face, 1, constant_values=-1)
    best = reduce(nearer, [(best[0][k : k + height], best[1][k : k + height]) for k in range(3)])
    best = stored_together(best)
    return reduce(
        nearer, [(best[0][:, k : k + width], best[1][:, k : k + width]) for k in range(3)]
    )[1]


def farthest_round(
    face_image: Int[Array, "height width"], surface: Surface
) -> Int[Array, "rows columns"]:
    """Of the faces seen in the middle of blocks of pixels, and of those round them, the farthest.

    The image has a border of one pixel, which shows nothing.
    """
    middle = _BLOCK // 2
    height, width = face_image.shape
    face = jnp.pad(face_image, ((0, -height % _BLOCK), (0, -width % _BLOCK)), constant_values=-1)
    face = stored(face[middle::_BLOCK, middle::_BLOCK])
    y, x = (_BLOCK * jnp.indices(face.shape) + middle).astype(surface.pixels.dtype) - 0.5
    depth = edge_values(corners_of(face, surface.faces, surface.pixels), x, y)[1]
    face = nearest_round(stored(jnp.where(face >= 0, -depth, -jnp.inf)), face)
    return stored(face.astype(integers(len(surface.faces))))


def of_block(values: Array, column: Int[Array, " n"], row: Int[Array, " n"]) -> Array:
    """The values that blocks have, at pixels, counted without the border of one pixel."""
    return values[divided(row + 1, _BLOCK)[0], divided(column + 1, _BLOCK)[0]]


def ring_of_edge(face: Int[Array, "2 n"], neighbors: Int[Array, "F 3"]) -> Int[Array, "12 n"]:
    """The faces up to two edges away from each of the two faces of an edge, but for the other.

    First the four next to these: the first of each, then the second.
    """
    near = _across(face, face[::-1], neighbors)
    far = _across(near, face[None], neighbors)
    return jnp.concatenate([near.reshape(4, -1), far.reshape(8, -1)])


def _across(face: Array, without: Array, neighbors: Array) -> Array:
    """The two faces next to each face that are not `without`, which is one of three or none."""
    near = jnp.where(face >= 0, neighbors.T[:, jnp.maximum(face, 0)], -1)
    return jnp.where(near[:2] == without, near[2], near[:2])


def only(face: Array, drawn: Bool[Array, " F"]) -> Array:
    """The faces that are drawn, -1 in place of the others."""
    return jnp.where((face >= 0) & drawn[jnp.maximum(face, 0)], face, -1)


def turned_alike(face: Int[Array, "*n"], facing: Array, volume: Float[Array, " F"]) -> Array:
    """Whether there are faces that are drawn and turn the side to the eye that `facing` tells."""
    return (face >= 0) & (volume[jnp.maximum(face, 0)] * facing > 0)


def over_few(
    chosen: Bool[Array, " n"],
    some: int,
    add: Callable[[Int[Array, " some"], Bool[Array, " some"], T], T],
    start: T,
) -> T:
    """Fold `add(indices, exists, total)` over the few of many that are chosen, `some` at a time."""
    size = chosen.size
    order, count = compacted(chosen, jnp.arange(size, dtype=jnp.int32))
    some = -(-size // _SHARE) if views_fill_lanes() else at_once(some, size)
    return over_batches(order, count, some, add, start)


def walk(
    face: Int[Array, "*ways"],
    x: Float[Array, "*ways"],
    y: Float[Array, "*ways"],
    surface: Surface,
    *,
    straight: bool = False,
) -> tuple[Int[Array, "*ways"], Bool[Array, "*ways"]]:
    """The faces that cover points, found from other faces on ways towards these.

    From face to face across edges beyond which the point lies; -1 if the surface ends before, or
    turns away: everywhere, or, of a `straight` way, where the point lies farthest beyond. Also
    whether the end of the way was reached.
    """
    shape = face.shape
    faces, pixels, topology, volume = surface
    face, x, y = stored_together((face.reshape(-1), x.reshape(-1), y.reshape(-1)))

    def go(way: Array, exists: Array, total: tuple[Array, Array]) -> tuple[Array, Array]:
        start, to_x, to_y = stored_together((face[way], x[way], y[way]))
        facing = stored(jnp.sign(volume[start]))  # the same all the way

        def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            steps, face, there = state
            values, _ = edge_values(corners_of(face, faces, pixels), to_x, to_y)
            beside = stored(topology.neighbors.T[:, jnp.maximum(face, 0)])
            # One by one: rows of what is looked up for all three take twice the time.
            goes_on = [turned_alike(one, facing, volume) for one in beside]
            aside = [jnp.minimum(value, 0) for value in values]
            if not straight:
                aside = [jnp.where(goes_on[i], aside[i], 0) for i in range(3)]
            least = reduce(jnp.minimum, aside)
            best = [(aside[i] < 0) & (aside[i] == least) & goes_on[i] for i in range(3)]
            following = reduce(jnp.maximum, [jnp.where(best[i], beside[i], -1) for i in range(3)])
            there = there | (face < 0) | covers(values)
            return steps + 1, *stored_together((jnp.where(there, face, following), there))

        def is_on_the_way(state: tuple[Array, Array, Array]) -> Array:
            steps, _, there = state
            return anywhere((steps < _STEPS) & ~jnp.all(there))

        _, end, there = lax.while_loop(
            is_on_the_way, in_strides(step), (start[0] & 0, start, ~exists)
        )
        place = jnp.where(exists, way, face.size)
        ends, arrived = total
        return ends.at[place].set(end, mode="drop"), arrived.at[place].set(there, mode="drop")

    nowhere = jnp.minimum(face, -1), face < 0
    ends, arrived = over_few(face >= 0, _WAYS_AT_ONCE, go, nowhere)
    return ends.reshape(shape), arrived.reshape(shape)
