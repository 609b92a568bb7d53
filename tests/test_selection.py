"""Work lists: running totals, what is chosen, and pieces of work of unequal length."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrast._device import over_views
from diffrast._selection import compacted, over_batches, prefix_sum, selected, work_off


@pytest.mark.parametrize("size", [1, 63, 64, 65, 4097, 40_000])
def test_running_totals_and_indices_are_numpys(size):
    mask = jnp.asarray(np.random.default_rng(size).random(size) < 0.1)
    np.testing.assert_array_equal(prefix_sum(mask.astype(jnp.int32)), np.cumsum(mask))
    for indices, count in (selected(mask), compacted(mask, jnp.arange(size))):
        np.testing.assert_array_equal(indices[:count], np.flatnonzero(mask))


PIECES = 37
LENGTHS, COUNTS = np.random.default_rng(0).integers(1, 9, (2, PIECES)), np.array([PIECES, 5])


def work(lengths, count, at_once=8):
    """How many steps each piece of work has had, once worked off and once added up in batches."""
    none = jnp.zeros(PIECES, jnp.int32)

    def begin(number):
        return number, jnp.zeros_like(number)

    def step(known, goes, total):
        number, steps = known
        total = total.at[jnp.where(goes, number, PIECES)].add(1, mode="drop")
        return (number, steps + 1), goes & (steps + 1 < lengths[number]), total

    def add(number, exists, total):
        return total.at[jnp.where(exists, number, PIECES)].add(lengths[number], mode="drop")

    steps = work_off(count, at_once, begin, step, none)
    return steps, over_batches(jnp.arange(PIECES), count, at_once, add, none)


def assert_done(found):
    for totals in found:
        for total, length, count in zip(totals, LENGTHS, COUNTS, strict=True):
            np.testing.assert_array_equal(total[:count], length[:count])
            np.testing.assert_array_equal(total[count:], 0)


@pytest.mark.parametrize("at_once", [1, 8, 64])
def test_every_piece_of_work_is_done_once(at_once):
    assert_done(jax.vmap(partial(work, at_once=at_once))(LENGTHS, COUNTS))


def test_work_on_views_side_by_side_ends_together(monkeypatch):
    """Elsewhere than on a CPU: nothing is copied for those that have ended before."""

    def copies(function):
        program = jax.jit(function).lower(LENGTHS, COUNTS).as_text()
        totals = rf"stablehlo.select .*tensor<2x{PIECES}xi32>$"
        return len(re.findall(totals, program, flags=re.MULTILINE))

    monkeypatch.setattr(jax, "default_backend", lambda: "another")
    together = jax.vmap(over_views(lambda *view: work(*view), pixels=1))
    assert_done(together(LENGTHS, COUNTS))
    assert_done(jax.vmap(work)(LENGTHS, COUNTS))
    assert copies(together) == 0 < copies(jax.vmap(work))
