"""Work lists: running totals, what is chosen, and pieces of work of unequal length."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrast._selection import compacted, prefix_sum, selected, work_off


@pytest.mark.parametrize("size", [1, 63, 64, 65, 4097, 40_000])
def test_running_totals_and_indices_are_numpys(size):
    mask = jnp.asarray(np.random.default_rng(size).random(size) < 0.1)
    np.testing.assert_array_equal(prefix_sum(mask.astype(jnp.int32)), np.cumsum(mask))
    for indices, count in (selected(mask), compacted(mask, jnp.arange(size))):
        np.testing.assert_array_equal(indices[:count], np.flatnonzero(mask))


@pytest.mark.parametrize("at_once", [1, 8, 64])
def test_every_piece_of_work_is_done_once(at_once):
    pieces = 37

    def work(lengths, count):
        def begin(number):
            return number, jnp.zeros_like(number)

        def step(known, goes, total):
            number, steps = known
            total = total.at[jnp.where(goes, number, pieces)].add(1, mode="drop")
            return (number, steps + 1), goes & (steps + 1 < lengths[number]), total

        return work_off(count, at_once, begin, step, jnp.zeros(pieces, jnp.int32))

    lengths = np.random.default_rng(0).integers(1, 9, (2, pieces))
    counts = np.array([pieces, 5])
    for total, length, count in zip(jax.vmap(work)(lengths, counts), lengths, counts, strict=True):
        np.testing.assert_array_equal(total[:count], length[:count])
        np.testing.assert_array_equal(total[count:], 0)
