"""Work lists: the indices of what is chosen, and loops over them in batches of fixed size.

Nothing here has a capacity: lists are as long as what they choose from, and batches are processed
until none is left. Most images have few chosen pixels, so blocks without any are passed over.
"""

from collections.abc import Callable
from functools import reduce
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Int

from diffrast._device import anywhere, draws_on_cpu, in_strides
from diffrast._stored import stored, zero_after

S = TypeVar("S")
T = TypeVar("T")

_BLOCK = 16
_BLOCKS_AT_ONCE = 64
_ROW = 64
_TRIANGLE = np.triu(np.ones((_ROW, _ROW), np.float32))


def integers(count: int) -> type:
    """What -1 and the numbers below a count fit in: images of them are held for long."""
    return jnp.int16 if count <= jnp.iinfo(jnp.int16).max else jnp.int32


def prefix_sum(counts: Int[Array, " n"]) -> Int[Array, " n"]:
    """Running totals, each with its own entry; counts are not negative, sums of 64 below 2^24.

    Within rows by products with a triangular matrix, exact in float32: several times faster than a
    cumulative sum, to compile and to run.
    """
    size = counts.shape[0]
    rows = -(-size // _ROW)
    table = jnp.pad(counts, (0, rows * _ROW - size)).reshape(rows, _ROW).astype(jnp.float32)
    within = jnp.matmul(table, _TRIANGLE, precision=lax.Precision.HIGHEST).astype(jnp.int32)
    totals = within[:, -1]
    if rows <= 8 * _ROW:
        earlier = jnp.arange(rows)[:, None] > jnp.arange(rows)
        before = jnp.sum(jnp.where(earlier, totals, 0), axis=1, dtype=jnp.int32)
    else:
        before = jnp.cumsum(totals) - totals
    return (within + before[:, None]).reshape(-1)[:size]


def compacted(
    chosen: Bool[Array, " n"], values: Int[Array, " n"]
) -> tuple[Int[Array, " n"], Int[Array, ""]]:
    """The chosen ones of values, in order, in front of zeros; and how many."""
    ends = prefix_sum(chosen.astype(jnp.int32))
    slot = jnp.where(chosen, ends - 1, chosen.size)
    return jnp.zeros_like(values).at[slot].set(values, mode="drop"), ends[-1]


def selected(
    mask: Bool[Array, "*shape"],
    holds: Callable[[Int[Array, " some"]], Bool[Array, " some"]] | None = None,
) -> tuple[Int[Array, " more"], Int[Array, ""]]:
    """Indices of what is true, ascending, and how many; the list is a little longer than the mask.

    They count its entries, whatever its shape. On a CPU blocks in which something is true are found
    first, and only these are looked through. So what takes longer to find out is asked only there:
    whether it `holds`, too, at such indices.
    """
    if not draws_on_cpu():
        indices, flat = jnp.arange(mask.size, dtype=jnp.int32), mask.reshape(-1)
        return compacted(flat if holds is None else flat & holds(indices), indices)
    # Found out in the mask's own shape: of others, and of what is padded, no loop is vectorised.
    flat = stored(mask.astype(jnp.int8)).reshape(-1)
    count = flat.size // _BLOCK
    words = lax.bitcast_convert_type(
        flat[: count * _BLOCK].reshape(count, _BLOCK // 4, 4), jnp.int32
    )
    holds_some = reduce(jnp.bitwise_or, list(words.T)) != 0
    if flat.size % _BLOCK:
        holds_some = jnp.append(holds_some, jnp.max(flat[count * _BLOCK :]) > 0)
    blocks = jnp.arange(holds_some.size, dtype=jnp.int32)
    block_list, block_count = compacted(holds_some, blocks)

    def add(block: Array, exists: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        indices, total = state
        number = (block[:, None] * _BLOCK + jnp.arange(_BLOCK, dtype=jnp.int32)).reshape(-1)
        there = jnp.repeat(exists, _BLOCK) & (number < flat.size)
        chosen = there & (flat[jnp.minimum(number, flat.size - 1)] > 0)
        more, added = compacted(chosen if holds is None else chosen & holds(number), number)
        return lax.dynamic_update_slice(indices, more, (total,)), total + added

    zero = zero_after(block_count)
    room = mask.size + _BLOCK * _BLOCKS_AT_ONCE
    indices = jnp.zeros(room, jnp.int32) + zero
    return over_batches(block_list, block_count, _BLOCKS_AT_ONCE, add, (indices, zero))


def batches_of(count: Int[Array, ""], at_once: int) -> Int[Array, ""]:
    """How many batches so many make."""
    return divided(count + (at_once - 1), at_once)[0]


def divided(number: Int[Array, "*n"], by: Array | int) -> tuple[Array, Array]:
    """Quotient and remainder of numbers that are not negative: one division, and no signs."""
    quotient = lax.div(number, jnp.broadcast_to(jnp.asarray(by, number.dtype), number.shape))
    return quotient, number - by * quotient


def over_batches(
    order: Int[Array, " n"],
    count: Int[Array, ""],
    at_once: int,
    add: Callable[[Int[Array, " some"], Bool[Array, " some"], T], T],
    start: T,
    *,
    first: Array | int = 0,
    goes_on: Callable[[T], Bool[Array, ""]] | None = None,
) -> T:
    """Fold `add(indices, exists, total)` over the first `count` of `order`, so many at a time.

    From the batch `first` on, and only while `goes_on(total)`. Of several views that are drawn side
    by side the last batches may be of nothing that exists.
    """
    batches = batches_of(count, at_once)

    def step(state: tuple[Array, T]) -> tuple[Array, T]:
        n, total = state
        slots = n * at_once + jnp.arange(at_once, dtype=jnp.int32)
        indices = stored(order[jnp.minimum(slots, order.shape[0] - 1)])
        return n + 1, add(indices, slots < count, total)

    def is_left(state: tuple[Array, T]) -> Array:
        left = state[0] < batches
        return anywhere(left) if goes_on is None else left & goes_on(state[1])

    return lax.while_loop(is_left, step, (jnp.asarray(first), start))[1]


def work_off(
    count: Int[Array, ""],
    at_once: int,
    begin: Callable[[Int[Array, " some"]], S],
    step: Callable[[S, Bool[Array, " some"], T], tuple[S, Bool[Array, " some"], T]],
    start: T,
) -> T:
    """Work through `count` pieces of work that take unequal numbers of steps, so many at a time.

    A piece that has ended makes room for the next at once, or after some steps.

    Args:
        count: of pieces.
        at_once: pieces side by side.
        begin: makes what is known of pieces at first of their numbers.
        step: takes what is known of pieces, which of them go on, and the total; returns the same.
            It changes nothing of others.
        start: the total before.
    """
    go = in_strides(lambda state: step(*state))

    def advance(state: tuple[Array, Array, S, T]) -> tuple[Array, Array, S, T]:
        following, goes, known, total = state
        rank = stored(prefix_sum((~goes).astype(jnp.int32)))
        number = following + rank - 1
        fresh = stored(~goes & (number < count))
        known = jax.tree.map(lambda new, old: jnp.where(fresh, new, old), begin(number), known)
        known, goes, total = go((stored(known), goes | fresh, total))
        return following + rank[-1], goes, stored(known), total

    def is_left(state: tuple[Array, Array, S, T]) -> Array:
        return anywhere((state[0] < count) | jnp.any(state[1]))

    none = jnp.zeros(at_once, jnp.int32) + (count & 0)
    return lax.while_loop(is_left, advance, (count & 0, none < 0, begin(none), start))[-1]
