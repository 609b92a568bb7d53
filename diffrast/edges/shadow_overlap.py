"""Where several outlines of shadows pass through a pixel: which part it, and where they end.

It is lit where the shadow of no body falls. Outlines of one body that have a vertex in common are
one outline with a corner: beyond it one of the two lets the light pass, or both have to. Of those
that have none the pixels tell which.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from diffrast._stored import stored
from diffrast.edges.neighborhood import steps_to
from diffrast.edges.pieces import positive_part
from diffrast.edges.planes import dot_rows
from diffrast.edges.shadow_ends import ROUNDED

_CERTAIN = 8  # times as much as another one tells the middle one of the 3×3 pixels
_OPPOSITE = -0.5  # cosine between the normals of two outlines of one shadow


class Lines(NamedTuple):
    """Outlines near pixels, and how two of them belong together."""

    outwards: Float[Array, "2 edges n"]  # unit normals from dark to lit,
    beyond: Float[Array, "edges n"]  # along which it is lit from so far on
    valid: Bool[Array, "edges n"]
    linked: Bool[Array, "edges edges n"]  # one goes on in the other,
    corner: Bool[Array, "edges edges n"]  # round a corner of the shadow, not of what is lit
    alike: Bool[Array, "edges edges n"]  # of one body


class Overlap(NamedTuple):
    """How outlines of shadows share pixels."""

    chosen: Bool[Array, "edges n"]  # which of them do
    ends: Bool[Array, "edges edges n"]  # whether one ends where another one tells:
    mates: Bool[Array, "edges edges n"]  # where neither that nor one of these lets the light pass,
    reverse: Bool[Array, "edges edges n"]  # or where it does


def overlap(
    lines: Lines,
    lit: Bool[Array, "9 n"],
    counts: Bool[Array, "9 n"],
    on_centre: Bool[Array, " n"],
) -> Overlap:
    """Which outlines part pixels, as far as what the 3×3 pixels show agrees.

    Args:
        lines: near them.
        lit: whether the light reaches the pixels round each.
        counts: which of these show the surface on which the shadows fall.
        on_centre: whether the lines are those on the face that the middle one shows.
    """
    outwards, beyond, valid, linked, corner, alike = lines
    count = len(valid)
    together = linked | jnp.eye(count, dtype=bool)[..., None]
    for _ in range(2):
        together = jnp.any(together[:, :, None] & together, axis=1)
    # Without knowing better, the first outline of each body, and the other side of its shadow.
    first = valid & ~jnp.any(alike & np.tri(count, k=-1, dtype=bool)[..., None], axis=1)
    same_way = dot_rows(outwards[:, :, None], outwards[:, None])
    chosen = jnp.any((together | (alike & (same_way < _OPPOSITE))) & first, axis=1)

    told = dot_rows(outwards[:, None], steps_to(jnp.arange(9))[..., None, None]) > beyond
    apart = alike & ~together
    passing = [corner, corner | apart]
    certain = jnp.where((jnp.arange(9)[:, None] == 4) & on_centre, _CERTAIN, 1)

    def wrong(mates: Array) -> Array:
        one = told | jnp.any(told[:, None] & mates, axis=2)
        differs = (jnp.all(one | ~valid, axis=1) != lit) & counts
        return jnp.sum(differs.astype(certain.dtype) * certain, axis=0)

    if_both, if_either = stored([wrong(mates) for mates in passing])
    decided, either = if_both != if_either, if_either < if_both
    chosen = valid & (chosen | decided)
    # One that goes on beyond where its edge ends may leave the centre dark that is lit.
    lets_pass = beyond < ROUNDED
    leaves_lit = lets_pass | jnp.any(lets_pass & corner, axis=1)
    leaves_lit = jnp.all(leaves_lit | ~together, axis=1)
    chosen = chosen & (leaves_lit | ~(lit[4] & counts[4]))
    return Overlap(
        *stored(
            [
                chosen,
                chosen[:, None] & chosen & ~together & (decided | ~alike),
                chosen & jnp.where(either, passing[1], passing[0]),
                apart & either,
            ]
        )
    )


def left_by_others(
    shared: Overlap,
    outwards: Float[Array, "2 edges faces n"],
    beyond: Float[Array, "edges faces n"],
    ends: tuple[Float[Array, "2 edges faces n"], Float[Array, "2 edges faces n"]],
) -> tuple[Array, Array]:
    """What parts of lines, from 0 to 1, the others leave, shape (edges, faces, n) each.

    Args:
        shared: how they share pixels.
        outwards: normals of the lines on faces, as of `Lines`.
        beyond: likewise.
        ends: of these lines.
    """
    reverse = shared.reverse[:, :, None]

    def inside(at: Array) -> list[Array]:
        past = dot_rows(outwards[:, None], at[:, :, None]) - beyond
        return [jnp.where(reverse, -past, past)]

    begin, end = positive_part(*map(inside, ends))
    exists = begin < end
    low, high = begin, end = stored((jnp.where(exists, begin, 1), jnp.where(exists, end, 0)))
    for k in range(len(beyond)):
        joins = (shared.mates[:, k] & ~shared.reverse)[:, :, None]
        low = jnp.where(joins, jnp.minimum(low, begin[:, k, None]), low)
        high = jnp.where(joins, jnp.maximum(high, end[:, k, None]), high)
    is_cut = shared.ends[:, :, None]
    low, high = jnp.where(is_cut, low, 0), jnp.where(is_cut, high, 1)
    return jnp.max(low, axis=1), jnp.min(high, axis=1)
