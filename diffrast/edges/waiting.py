"""Pieces of edges that wait until there are enough to be looked at side by side."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Int

from diffrast._selection import compacted
from diffrast._stored import stored
from diffrast.edges.pieces import AtOnce, Pieces, Segments


class Waiting(NamedTuple):
    """Pieces to be looked at, and how many they are; `exists` means nothing here."""

    pieces: Pieces
    total: Int[Array, ""]


def none_waiting(segments: Segments, room: int) -> Waiting:
    """Room for so many pieces of segments."""
    integer = jnp.zeros(room, jnp.int32) + (segments.parts[0] & 0)
    ends = jnp.stack([integer, integer])
    pieces = Pieces(integer, ends, ends.astype(segments.range.dtype), integer > 0)
    return Waiting(pieces, segments.parts[0] & 0)


def all_of(waiting: Waiting) -> Pieces:
    """As many pieces as there is room for, of which those that wait exist."""
    pieces = waiting.pieces
    number = jnp.arange(pieces.exists.size, dtype=jnp.int32)
    return pieces._replace(exists=number < waiting.total)


def behind(waiting: Waiting, pieces: Pieces, count: Array) -> Waiting:
    """The same with the first ones of others put behind, if fewer wait than are looked at."""

    def put(old: Array, new: Array) -> Array:
        return lax.dynamic_update_slice_in_dim(old, new, waiting.total, axis=-1)

    return Waiting(jax.tree.map(put, waiting.pieces, pieces), waiting.total + count)


def first_ones(waiting: Waiting, at_once: AtOnce) -> Pieces:
    """As many as are looked at at once; in parts, each of them, if these are few.

    What hides a piece here and there is found one part after the other.
    """
    few = waiting.total <= at_once.few
    parts = jnp.where(few, at_once.parts, 1)
    number = np.arange(at_once.pieces, dtype=np.int32)
    piece = jnp.where(few, number // at_once.parts, number)
    part = jnp.where(few, number % at_once.parts, 0)
    segment, pixel, range_, _ = stored(tuple(column[..., piece] for column in waiting.pieces))
    begin, end = range_
    length = (end - begin) / parts
    last = jnp.where(part == parts - 1, end, begin + (part + 1).astype(length.dtype) * length)
    range_ = stored(jnp.stack([begin + part.astype(length.dtype) * length, last]))
    return Pieces(segment, pixel, range_, piece < waiting.total)


def instead_of_first(waiting: Waiting, pieces: Pieces) -> Waiting:
    """What waits if only those of others that exist take the place of the `first_ones`."""
    pieces, count = gathered(pieces)
    others = jax.tree.map(lambda column: column[..., pieces.exists.size :], waiting.pieces)
    room = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-1), pieces, others)
    rest = jnp.maximum(waiting.total - pieces.exists.size, 0)
    return behind(Waiting(room, count), others, rest)


def gathered(pieces: Pieces) -> tuple[Pieces, Int[Array, ""]]:
    """Those that exist first, and how many they are."""
    number = jnp.arange(pieces.exists.size, dtype=jnp.int32)
    order, count = compacted(pieces.exists, number)
    segment, pixel, range_, _ = (column[..., order] for column in pieces)
    return Pieces(segment, pixel, range_, number < count), count
