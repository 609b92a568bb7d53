"""Arrays that vary over devices alike.

`shard_map` keeps account of which arrays differ from device to device; both branches of a condition
must agree in it, and so must the begin and the end of a loop.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

T = TypeVar("T")


def varying_zero(tree: Any) -> Array:
    """The integer 0, which varies under `shard_map` as all arrays of a tree together do."""
    firsts = [leaf.reshape(-1)[0] for leaf in jax.tree.leaves(tree) if leaf.size]
    return sum((jnp.where(first == first, 0, 0) for first in firsts), jnp.zeros((), jnp.int32))


def varying_alike(tree: T) -> T:
    """The same values, each of which varies as all together do."""
    zero = varying_zero(tree)

    def vary(leaf: Array) -> Array:
        return leaf ^ (zero != 0) if leaf.dtype == bool else leaf + zero.astype(leaf.dtype)

    return jax.tree.map(vary, tree)
