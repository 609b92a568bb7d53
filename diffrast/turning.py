"""Colours that turn within a pixel.

A pixel shows the colour at its centre, and edges weigh colours by area. But where a surface curls,
or has a highlight no larger than a pixel, its colour turns within the pixel. Such pixels, found by
how colours bend from each to the next ones, are shaded at more points of the surface at their
centre, and get the mean. Those that edges change have their share already.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float, Int

from diffrast._device import draws_on_cpu, over_views
from diffrast._linear import linear_map, linear_zeros
from diffrast._selection import batches_of, compacted, over_batches
from diffrast._stored import stored, zero_after
from diffrast._varying import varying_alike, varying_zero
from diffrast.edges.neighborhood import walk
from diffrast.edges.pieces import facing, to_pixels
from diffrast.edges.planes import corners_of, covers, edge_values
from diffrast.geometry import Points, points_at
from diffrast.light import Columns
from diffrast.raster.evaluate import Drawn, pixels_at
from diffrast.shadows import Reached

Shade: TypeAlias = Callable[[Any, Points, Reached], Columns]

PIXELS_AT_ONCE = 1024
_FEW = 128  # of them in small images
_SHARE = 16  # of so many pixels at most one is shaded at more points
_BEND = 0.08  # of the picture's mean colour: by how much more it changes to one side of a pixel
_PLAIN = 0.005  # of the same: what edges may add
_ROWS = 8  # one of so many tells the mean
_BLOCK = 16  # pixels, one below the other
_BLOCKS_AT_ONCE = 64
# The centre of a pixel, and four points to its right and below it, no two in a row or a column.
_POINTS = np.array([[0, -1, 3, 1, -3], [0, -3, -1, 3, 1]], np.float32)[:, :, None] / 8


class Turning(NamedTuple):
    """The pixels that are shaded at more points, and what is seen there."""

    number: Int[Array, " places"]  # in the image without its border
    total: Int[Array, ""]  # of them
    face: Int[Array, "points places"]  # -1 where the surface ends
    reached: Reached  # at their centres: whatever shadow begins within a pixel has its edge


class _Inputs(NamedTuple):
    """What the colours of points depend on."""

    data: Any
    drawn: Drawn
    turning: Turning


def with_turns(
    shade: Shade,
    data: Any,
    drawn: Drawn,
    face_image: Int[Array, "height_with_border width_with_border"],
    reached: Reached,
    neighbors: Int[Array, "F 3"],
    hard: Float[Array, "height_with_border width_with_border 3"],
    image: Float[Array, "height width 3"],
) -> Float[Array, "height width 3"]:
    """An image with the mean colours of pixels in which colours turn.

    Differentiable as the image itself and as the colours are, but for second derivatives of what is
    added.

    Args:
        shade: colours of points, one array a channel; its first argument is `data`.
        data: a tree of all arrays that it uses.
        drawn: what is drawn, in an image with a border of one pixel all round.
        face_image: the face that each of these pixels sees, -1 for none.
        reached: by each light; images of that size.
        neighbors: of the faces; see `Topology`.
        hard: that image, without edges.
        image: the one with edges, without its border.
    """
    height, width = image.shape[:2]

    def found(
        face_image: Array,
        hard: Array,
        image: Array,
        reached: Reached,
        clip: Array,
        faces: Array,
        neighbors: Array,
    ) -> Turning:
        number, count = _bending(face_image, hard, image)
        face = _faces_at(number, count, face_image, clip, faces, neighbors)
        row, column = jnp.divmod(number, width)
        lit = jax.tree.map(lambda part: part[row + 1, column + 1], reached)
        return Turning(number, count, face, lit)

    seen = lax.stop_gradient((face_image, hard, image, reached, drawn.positions_clip))
    find = over_views(lambda _: found, height * width)
    turning = find(*seen, drawn.faces, neighbors)
    added = _added(shade, (height, width), _Inputs(data, drawn, turning))
    place = jnp.arange(turning.number.size)
    row, column = jnp.divmod(turning.number, width)
    row = jnp.where(place < turning.total, row, height + place)  # none twice
    return image.at[row, column].add(added, mode="drop", unique_indices=True)


def _bending(face_image: Array, hard: Array, image: Array) -> tuple[Array, Array]:
    """Numbers of the pixels where colours bend most, and how many they are."""
    total = hard[..., 0] + hard[..., 1] + hard[..., 2]
    rows = slice(_ROWS // 2, None, _ROWS)
    some = face_image[rows] >= 0
    mean = jnp.sum(jnp.where(some, abs(total[rows]), 0)) / jnp.maximum(jnp.sum(some), 1)
    changes = stored(sum(jnp.abs(image[..., c] - hard[1:-1, 1:-1, c]) for c in range(3)))
    plain = stored(jnp.where(changes <= _PLAIN * mean, 0, jnp.nan))
    # What the background shows, or an edge changes, is not a number.
    known = stored(jnp.where(face_image >= 0, total, jnp.nan) + stored(jnp.pad(plain, 1)))
    middle = known[1:-1, 1:-1]
    across = _bend(known[1:-1, :-2], middle, known[1:-1, 2:])
    down = _bend(known[:-2, 1:-1], middle, known[2:, 1:-1])
    bends = jnp.fmax(across, down)
    bends = stored(jnp.where(bends == bends, bends, 0))
    least = jnp.maximum(_BEND * mean, jnp.finfo(mean.dtype).tiny)  # doubled, it must not stay zero
    return _largest(bends, least)


def _bend(one: Array, middle: Array, other: Array) -> Array:
    """By how much more a colour changes to one side; by how much, if only one side is known."""
    to_one, to_other = one - middle, other - middle
    both = to_one + to_other
    alone = jnp.where(to_one == to_one, to_one, to_other)
    return jnp.abs(jnp.where(both == both, both, alone))


def _largest(values: Array, least: Array) -> tuple[Array, Array]:
    """Numbers of the pixels with more than the least value, and how many they are.

    If these are too many, of those with more than twice, four times, ... as much. Blocks of pixels
    one below the other are looked through: their largest values are quick to find.
    """
    height, width = values.shape
    most = -(-height * width // _SHARE)
    unit = PIXELS_AT_ONCE if most > PIXELS_AT_ONCE else _FEW
    places = -(-most // unit) * unit
    blocks = jnp.pad(values, ((0, -height % _BLOCK), (0, 0))).reshape(-1, _BLOCK, width)
    blocks = jnp.max(blocks, axis=1).reshape(-1)

    def are_few(found: tuple[Array, Array]) -> Array:
        return found[1] <= places

    def look(state: tuple[Array, tuple[Array, Array]]) -> tuple[Array, tuple[Array, Array]]:
        least, (numbers, _) = state
        order, size = compacted(blocks > least, jnp.arange(blocks.size, dtype=jnp.int32))

        def add(block: Array, exists: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
            numbers, total = found
            first = block // width * _BLOCK * width + block % width
            number = first + width * jnp.arange(_BLOCK, dtype=jnp.int32)[:, None]
            value = values.reshape(-1).at[number].get(mode="fill", fill_value=0)
            chosen = exists & (value > least)
            more, count = compacted(chosen.reshape(-1), number.reshape(-1))
            return lax.dynamic_update_slice(numbers, more, (total,)), total + count

        start = jnp.zeros_like(numbers), zero_after(size)
        found = over_batches(order, size, _BLOCKS_AT_ONCE, add, start, goes_on=are_few)
        return 2 * least, found

    zero = zero_after(blocks[0]).astype(jnp.int32)
    room = jnp.zeros(places + _BLOCK * _BLOCKS_AT_ONCE, jnp.int32) + zero
    start = least, (room, zero + places + 1)
    _, (numbers, total) = lax.while_loop(lambda state: ~are_few(state[1]), look, start)
    return numbers[:places], total


def _faces_at(
    number: Array, count: Array, face_image: Array, clip: Array, faces: Array, neighbors: Array
) -> Int[Array, "points places"]:
    """The faces at the points of pixels, found from those at their centres."""
    height, width = face_image.shape

    def find(found: Array) -> Array:
        pixels = stored(to_pixels(clip, height, width))
        volume = facing(pixels, faces)

        def add(place: Array, exists: Array, found: Array) -> Array:
            row, column = stored(jnp.divmod(number[place], width - 2))
            centre = stored(jnp.where(exists, face_image[row + 1, column + 1], -1))
            x, y = column + 1.5 + _POINTS[0], row + 1.5 + _POINTS[1]
            x, y = stored((x.astype(clip.dtype), y.astype(clip.dtype)))
            own = jnp.broadcast_to(centre, x.shape)
            covered = covers(edge_values(corners_of(centre, faces, pixels)[:, :, None], x, y)[0])
            covered = covered | (jnp.arange(x.shape[0]) == 0)[:, None]
            ways = stored(jnp.where(covered, -1, own))
            end, there = walk(ways, x, y, faces, pixels, neighbors, volume)
            return found.at[:, place].set(jnp.where(covered, own, jnp.where(there, end, -1)))

        places = jnp.arange(number.size, dtype=jnp.int32)
        return over_batches(places, count, _at_once(number.size), add, found)

    nothing = jnp.full((_POINTS.shape[1], number.size), -1, jnp.int32)
    nothing = nothing + varying_zero((number, face_image, clip, faces, neighbors))
    return lax.cond(count > 0, find, lambda nothing: nothing, nothing)


def _at_once(places: int) -> int:
    return min(places, PIXELS_AT_ONCE) if draws_on_cpu() else places


def _added(shade: Shade, size: tuple[int, int], inputs: _Inputs) -> Float[Array, "places 3"]:
    """By how much the mean colours of pixels differ from those at their centres."""

    def over(function: Callable[..., Any]) -> Callable[..., Any]:
        return over_views(lambda _: function, size[0] * size[1])

    @jax.custom_jvp
    def added(inputs: _Inputs) -> Array:
        def all_batches(inputs: _Inputs) -> Array:
            def step(n: Array, total: Array) -> Array:
                return _put(total, stored(_of_batch(shade, size, inputs, n)), n)

            return _over_turning(inputs, step, _nothing(inputs) + varying_zero(inputs))

        return over(all_batches)(varying_alike(inputs))

    def derivative(primals: Any, tangents: Any) -> tuple[Array, Array]:
        leaves, tree = jax.tree.flatten(varying_alike(lax.stop_gradient(primals[0])))
        changes = jax.tree.leaves(tangents[0])
        moving = [i for i, change in enumerate(changes) if not isinstance(change, SymbolicZero)]

        def of_moving(leaves: list[Array], n: Array) -> Callable[..., Array]:
            def of(*values: Array) -> Array:
                given = dict(zip(moving, values, strict=True))
                parts = [given.get(i, leaf) for i, leaf in enumerate(leaves)]
                return _of_batch(shade, size, jax.tree.unflatten(tree, parts), n)

            return of

        def push(leaves: list[Array], changes: list[Array], nothing: Array) -> Array:
            at = [leaves[i] for i in moving]

            def step(n: Array, total: Array) -> Array:
                return _put(total, jax.jvp(of_moving(leaves, n), at, changes)[1], n)

            return _over_turning(jax.tree.unflatten(tree, leaves), step, nothing)

        def pull(leaves: list[Array], cotangent: Array) -> list[Array]:
            at = [leaves[i] for i in moving]

            def step(n: Array, total: list[Array]) -> list[Array]:
                back = jax.vjp(of_moving(leaves, n), *at)[1]
                return jax.tree.map(jnp.add, total, list(back(_taken(cotangent, n))))

            nothing = [linear_zeros(leaf.shape, cotangent) for leaf in at]
            return _over_turning(jax.tree.unflatten(tree, leaves), step, nothing)

        change = linear_map(
            lambda changes, nothing: over(push)(leaves, changes, nothing),
            lambda cotangent: over(pull)(leaves, cotangent),
            [changes[i] for i in moving],
            _nothing(primals[0]),
        )
        return added(*primals), change

    added.defjvp(derivative, symbolic_zeros=True)
    return added(inputs)


def _nothing(inputs: _Inputs) -> Array:
    return jnp.zeros((inputs.turning.number.size, 3), inputs.drawn.positions_clip.dtype)


def _over_turning(inputs: _Inputs, step: Callable[[Array, Any], Any], start: Any) -> Any:
    turning = inputs.turning
    batches = batches_of(turning.total, _at_once(turning.number.size))
    return lax.fori_loop(0, batches, step, start)


def _taken(rows: Array, n: Array) -> Array:
    at_once = _at_once(rows.shape[0])
    return lax.dynamic_slice_in_dim(rows, n * at_once, at_once)


def _put(total: Array, rows: Array, n: Array) -> Array:
    return lax.dynamic_update_slice_in_dim(total, rows, n * rows.shape[0], 0)


def _of_batch(
    shade: Shade, size: tuple[int, int], inputs: _Inputs, n: Array
) -> Float[Array, "some 3"]:
    """What `_added` finds for one batch: nothing where the surface ends, of which edges tell."""
    data, drawn, turning = inputs
    row, column = jnp.divmod(_taken(turning.number, n), size[1])
    face = _taken(turning.face.T, n).T
    full = size[0] + 2, size[1] + 2
    pixels = pixels_at(face, row + 1, column + 1, full, drawn.positions_clip.dtype)
    x, y = pixels.x + 2 * _POINTS[0], pixels.y - 2 * _POINTS[1]
    seen, x, y = stored([part.reshape(-1) for part in (face, x, y)])
    lit = jax.tree.map(lambda part: jnp.tile(_taken(part, n), face.shape[0]), turning.reached)
    points = points_at(drawn, pixels._replace(face=seen, x=x, y=y))
    colors = [color.reshape(face.shape) for color in shade(data, points, lit)]
    known = jnp.min(face, axis=0) >= 0
    means = [jnp.mean(color[1:], axis=0) - color[0] for color in colors]
    return jnp.stack([jnp.where(known, mean, 0) for mean in means], axis=-1)
