"""Buffers that XLA really stores.

XLA fuses a cheap producer into each of its consumers and computes it again in every one; a gather
even computes its operand again for every element it reads, and the assembly of channels its parts
for every channel. `lax.optimization_barrier` does not stop the CPU compiler, which removes it
before it fuses. What it never computes twice is a division: so a value divided by a one that is
known only at run time is stored once, to the same bits, and so is its derivative in either
direction.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Int

T = TypeVar("T")


def stored(values: T, faces: Int[Array, "F 3"]) -> T:
    """Store every floating-point array of a tree; `faces` serves for the one (ids are >= 0)."""
    is_index = faces[0, 0] >= 0

    def store(value: Array) -> Array:
        return value / jnp.where(is_index, 1, 2).astype(value.dtype)

    return jax.tree.map(store, values)


def stored_rows(values: Array, faces: Int[Array, "F 3"]) -> Array:
    """Store a (V, C) array, each of its columns computed once."""
    return assemble(stored([values[:, i] for i in range(values.shape[1])], faces))


def assemble(channels: list[Array]) -> Array:
    """Stack channels along a new last axis, each computed once."""
    image = jnp.zeros((*channels[0].shape, len(channels)), channels[0].dtype)
    for c, channel in enumerate(channels):
        image = image.at[..., c].set(channel)
    return image
