"""The first part of each piece of an edge that can be seen as far as one surface lies behind it.

Coverage and 1/w of a face change linearly along a piece, so where they pass zero or one another
follows from their values at both ends. A piece ends where a face covers it and is nearer, and where
what lies behind it changes from one surface to another.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored, stored_together
from diffrast.edges.pieces import positive_part
from diffrast.edges.planes import Columns

_ROUNDS = 3  # faces one behind the other along one piece
_SLIVER = 1e-4  # of a piece: parts shorter than that are not seen


class Candidates(NamedTuple):
    """Faces near pieces, and values at both ends of these that change linearly in between."""

    face: Int[Array, "candidates n"]
    patch: Int[Array, "candidates n"]  # see `Topology`
    foreign: Bool[Array, "candidates n"]  # there is one, and the edge is not its own
    hides: Columns  # all positive where a face hides the piece; (2 ends, candidates, n)
    behind: Columns  # all positive where it lies behind
    inverse_depth: Float[Array, "2 candidates n"]  # of its plane


class Part(NamedTuple):
    """Of each piece, from 0 to 1."""

    begin: Float[Array, " n"]  # not below `end` where nothing is seen
    end: Float[Array, " n"]
    last: Float[Array, " n"]  # end of what is visible; behind `end` there may be other parts


def first_part(candidates: Candidates, fold: Bool[Array, " n"]) -> Part:
    """The first part of pieces that nothing hides, with one surface behind it if it is a fold."""
    begin, end, last = _unhidden(candidates)
    places = jnp.array([_SLIVER, 0.5, 1 - _SLIVER], begin.dtype)
    t = stored(begin + places[:, None] * (end - begin))
    depth, best = nearest_behind(candidates, t)
    surface = jnp.where(depth > 0, jnp.take_along_axis(candidates.patch, best, axis=0), -1)

    # What is seen at the beginning and end of the part's first half, or of its second.
    half = jnp.where(surface[0] != surface[1], 0, 1)
    one, other = (
        [jnp.where(half == 0, x[i], x[i + 1]) for x in (t, depth, surface)] for i in (0, 1)
    )
    ends_first = one[1] >= other[1]
    nearer = stored(jnp.where(ends_first, one[2], other[2]))
    low, high = positive_part(*zip(*candidates.behind, strict=True))
    reaches = candidates.foreign & (candidates.patch == nearer) & (low < high)
    left = jnp.max(jnp.where(reaches & (low <= other[0]), high, 0), axis=0)
    entered = jnp.min(jnp.where(reaches & (high >= one[0]), low, 1), axis=0)
    change = jnp.where(ends_first, left, entered)
    # Where nothing lies behind at first, the first surface that does may lie between these places.
    exists = candidates.foreign & (low < high) & (low > begin + _SLIVER)
    first = jnp.min(jnp.where(exists, low, 1), axis=0)
    enters = stored((surface[0] < 0) & (first < end - _SLIVER))
    change = jnp.where(enters, first, change)
    changes = fold & (enters | (one[2] != other[2]))
    changes = changes & (change > begin + _SLIVER) & (change < end - _SLIVER)
    return Part(*stored_together((begin, jnp.where(changes, change, end), last)))


def nearest_behind(
    candidates: Candidates, t: Float[Array, "k n"]
) -> tuple[Float[Array, "k n"], Int[Array, "k n"]]:
    """1/w of the nearest candidate behind points `t` of pieces, 0 if there is none; and its row."""

    def at(values: Array) -> Array:
        return values[0] + t[:, None] * (values[1] - values[0])

    behind = candidates.foreign
    for values in candidates.behind:
        behind = behind & (at(values) >= 0)
    depth = stored(jnp.where(behind, at(candidates.inverse_depth), 0))
    nearest = stored(jnp.max(depth, axis=1))
    row = jnp.arange(depth.shape[1])[:, None]
    best = jnp.min(jnp.where(depth == nearest[:, None], row, row.size - 1), axis=1)
    return nearest, stored(best)


def _unhidden(candidates: Candidates) -> tuple[Array, Array, Array]:
    """Begin and end of the first part that nothing hides, and the end of the last one."""
    low, high = positive_part(*zip(*candidates.hides, strict=True))
    hides = candidates.foreign & (low < high)

    def hide(_: Array, left: tuple[Array, Array]) -> tuple[Array, Array]:
        begin, end = left
        before, after = hides & (low <= begin + _SLIVER), hides & (high >= end - _SLIVER)
        begin = jnp.maximum(begin, jnp.max(jnp.where(before, high, 0), axis=0))
        end = jnp.minimum(end, jnp.min(jnp.where(after, low, 1), axis=0))
        return begin, end

    nothing = jnp.min(low, axis=0)
    whole = jnp.zeros_like(nothing), jnp.ones_like(nothing)
    begin, last = lax.fori_loop(0, _ROUNDS, hide, whole)
    end = jnp.min(jnp.where(hides & (low > begin + _SLIVER), low, 1), axis=0)
    return begin, jnp.minimum(end, last), last
