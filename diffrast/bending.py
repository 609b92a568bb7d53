"""Pixels within which colours turn, found by how colours bend from each to the next ones."""

from functools import reduce
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._device import at_once, over_views
from diffrast._selection import compacted, divided, over_batches
from diffrast._stored import stored, zero_after

_Lists: TypeAlias = tuple[list[Array], list[Array]]  # one of each kind, and their lengths

PARTS_AT_ONCE = 1024  # parts of pixels that are shaded side by side on a CPU,
_FEW = 128  # or in small images
_SHARE = 10  # of so many pixels at most one is shaded at more points
_BEND = 0.08  # of the picture's mean colour: by how much more it changes to one side of a pixel
_SHARP = 8  # times as much: there the change at a point tells nothing of that of the pixel
_PLAIN = 0.005  # of the same: what edges may add where they part nothing
_ROWS = 8  # one of so many tells the mean
_BLOCK = 16  # pixels, one below the other
_BLOCKS_AT_ONCE = 64


class Turning(NamedTuple):
    """The picture without edges, with a border of one pixel, and where its colours turn."""

    face_image: Int[Array, "height_with_border width_with_border"]  # what is seen, -1 for nothing
    hard: Float[Array, "height_with_border width_with_border 3"]  # its colours
    mean: Float[Array, ""]  # of the whole
    much: Int[Array, "height width"]  # 0 to 2: how much they bend there

    @property
    def chosen(self) -> Bool[Array, "height width"]:
        """The pixels that get their surface's mean colour in any case."""
        return self.much > 0

    @property
    def sharp(self) -> Bool[Array, "height width"]:
        """Those of them where colours bend most."""
        return self.much > 1


class Chosen(NamedTuple):
    """The pixels that are shaded at more points, those that edges part last.

    These are shaded in four quarters if there is room, and have no derivative here, but for those
    where colours turn sharply, which come before the others.
    """

    number: Int[Array, " places"]
    plain: Int[Array, ""]  # so many that edges do not part,
    moving: Int[Array, ""]  # that have a derivative,
    total: Int[Array, ""]  # and all

    @property
    def at_once(self) -> int:
        """How many parts of pixels are shaded side by side."""
        return at_once(PARTS_AT_ONCE, self.number.size)

    @property
    def parts_of_each(self) -> Int[Array, ""]:
        """In how many parts those pixels are shaded that edges part."""
        parts = self.plain + 4 * (self.total - self.plain)
        return jnp.where(parts <= self.number.size, 4, 1)

    @property
    def parts(self) -> Int[Array, ""]:
        """How many there are of all pixels."""
        return self._parts_of(self.total)

    @property
    def moving_parts(self) -> Int[Array, ""]:
        """How many there are of those that have a derivative."""
        return self._parts_of(self.moving)

    def _parts_of(self, count: Array) -> Int[Array, ""]:
        return self.plain + self.parts_of_each * (count - self.plain)


def find_turning(
    face_image: Int[Array, "height_with_border width_with_border"],
    hard: Float[Array, "height_with_border width_with_border 3"],
) -> Turning:
    """Where colours bend most in an image without edges: at no more than one of 20 pixels."""

    def find(face_image: Array, hard: Array) -> tuple[Array, Array]:
        color = _sums(hard)
        some = slice(_ROWS // 2, None, _ROWS)
        seen = face_image[some] >= 0
        total = jnp.sum(jnp.where(seen, abs(color[some]), 0))
        mean = total / jnp.maximum(jnp.sum(seen), 1).astype(total.dtype)
        bends = _bends(jnp.where(face_image >= 0, color, jnp.nan))

        def are_many(least: Array) -> Array:
            return 2 * jnp.sum(bends > least, dtype=jnp.int32) > _places(bends)

        least = lax.while_loop(are_many, lambda least: 2 * least, _least(mean))
        sharply = bends > jnp.maximum(least, _SHARP * _least(mean))
        much = jnp.where(sharply, 2, (bends > least).astype(int))
        return mean, stored(much.astype(jnp.int8))  # else the numbers would be held

    seen = lax.stop_gradient((face_image, hard))
    return Turning(*seen, *over_views(find, face_image.size)(*seen))


def bending(turning: Turning, image: Float[Array, "height width 3"]) -> Chosen:
    """The pixels where colours bend most, and how edges part them, of an image with edges."""
    face_image, hard, mean, _ = turning
    changes = stored(_sums(jnp.abs(image - hard[1:-1, 1:-1])))
    parted = stored(changes > _PLAIN * mean)
    # What the background shows, or an edge changes, is not a number.
    color = jnp.where(jnp.pad(parted, 1) | (face_image < 0), jnp.nan, _sums(hard))
    bends = stored(jnp.where(turning.chosen, jnp.inf, _bends(color)))
    kind = stored(jnp.where(parted, jnp.where(turning.sharp, 1, 2), 0).astype(jnp.int8))
    return _largest(bends, _least(mean), kind)


def _sums(image: Array) -> Array:
    return image[..., 0] + image[..., 1] + image[..., 2]


def _least(mean: Array) -> Array:
    """Of what is chosen; doubled, it must not stay zero."""
    return jnp.maximum(_BEND * mean, jnp.finfo(mean.dtype).tiny)


def _places(image: Array) -> int:
    """For how many pixels of an image there is room; in large ones whole batches, and no more.

    What is known of each is held for the derivative.
    """
    most = image.size // _SHARE
    if most > PARTS_AT_ONCE:
        return most // PARTS_AT_ONCE * PARTS_AT_ONCE
    return max(-(-most // _FEW), 1) * _FEW


def _bends(color: Array) -> Array:
    """By how much more colours change to one side of each pixel but those at the border."""
    color = stored(color)
    middle = color[1:-1, 1:-1]
    across = _bend(color[1:-1, :-2], middle, color[1:-1, 2:])
    down = _bend(color[:-2, 1:-1], middle, color[2:, 1:-1])
    bends = jnp.fmax(across, down)
    return stored(jnp.where(bends == bends, bends, 0))


def _bend(one: Array, middle: Array, other: Array) -> Array:
    """By how much more a colour changes to one side; by how much, if only one side is known."""
    to_one, to_other = one - middle, other - middle
    both = to_one + to_other
    alone = jnp.where(to_one == to_one, to_one, to_other)
    return jnp.abs(jnp.where(both == both, both, alone))


def _largest(values: Array, least: Array, kind: Int[Array, "height width"]) -> Chosen:
    """The pixels with more than the least value: those of the kind 0, then 1, then 2.

    If these are too many, those with more than twice, four times, ... as much. Blocks of pixels
    one below the other are looked through: their largest values are quick to find.
    """
    height, width = values.shape
    places = _places(values)
    blocks = jnp.pad(values, ((0, -height % _BLOCK), (0, 0))).reshape(-1, _BLOCK, width)
    blocks = jnp.max(blocks, axis=1).reshape(-1)
    some = at_once(_BLOCKS_AT_ONCE, blocks.size)

    def are_few(found: _Lists) -> Array:
        return reduce(jnp.add, found[1]) <= places

    def look(state: tuple[Array, _Lists]) -> tuple[Array, _Lists]:
        least, (lists, _) = state
        order, size = compacted(blocks > least, jnp.arange(blocks.size, dtype=jnp.int32))

        def add(block: Array, exists: Array, found: _Lists) -> _Lists:
            row, column = divided(block, width)
            first = row * (_BLOCK * width) + column
            number = first + width * jnp.arange(_BLOCK, dtype=jnp.int32)[:, None]
            value = values.reshape(-1).at[number].get(mode="fill", fill_value=0)
            of_kind = kind.reshape(-1).at[number].get(mode="clip")
            of_kind = stored(jnp.where(exists & (value > least), of_kind, -1)).reshape(-1)
            lists, sizes = [], []
            for k, (known, size) in enumerate(zip(*found, strict=True)):
                more, count = compacted(of_kind == k, number.reshape(-1))
                lists.append(lax.dynamic_update_slice(known, more, (size,)))
                sizes.append(size + count)
            return lists, sizes

        nothing = [jnp.zeros_like(one) for one in lists], [zero_after(size)] * len(lists)
        return 2 * least, over_batches(order, size, some, add, nothing, goes_on=are_few)

    zero = zero_after(blocks[0]).astype(jnp.int32)
    room = jnp.zeros(places + _BLOCK * some, jnp.int32) + zero
    start = least, ([room] * 3, [zero + places + 1, zero, zero])
    _, (lists, sizes) = lax.while_loop(lambda state: ~are_few(state[1]), look, start)
    place = jnp.arange(places, dtype=jnp.int32)
    plain, sharp, others = sizes
    moving = plain + sharp
    number = jnp.where(place < plain, lists[0][place], lists[1][jnp.maximum(place - plain, 0)])
    number = jnp.where(place < moving, number, lists[2][jnp.maximum(place - moving, 0)])
    return Chosen(number, plain, moving, moving + others)
