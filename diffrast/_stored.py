"""Buffers that XLA really stores.

XLA fuses a cheap producer into each of its consumers and computes it again in every one; a gather
even computes its operand again for every element it reads, and the assembly of channels its parts
for every channel. `lax.optimization_barrier` does not stop the CPU compiler, which removes it
before it fuses. What it never computes twice is a division: so a value is divided by a one that it
cannot know to be one until it has fused, to the same bits, and so is its derivative in either
direction. Once fused, the division is found out and costs nothing.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax

T = TypeVar("T")


def stored(values: T, witness: Array | None = None) -> T:
    """Store every array of numbers in a tree.

    The one is made of the values themselves or, where these have to stay linear, of the witness:
    an array that is no tangent, of their shape.
    """

    def store(value: Array) -> Array:
        if value.dtype == bool:
            return value
        if witness is not None:
            return lax.div(value, _one(witness, value.dtype))
        return (
            _stored_number(value) if jnp.issubdtype(value.dtype, jnp.inexact) else _divided(value)
        )

    return jax.tree.map(store, values)


def _one(witness: Array, dtype: jnp.dtype) -> Array:
    """A one that XLA takes for another number until it has fused: of integers it would know."""
    same = lax.stop_gradient(witness)
    if not jnp.issubdtype(same.dtype, jnp.inexact):
        same = same.astype(jnp.float32)
    return lax.select(same < same, lax.full_like(same, 2, dtype), lax.full_like(same, 1, dtype))


def _divided(value: Array) -> Array:
    return lax.div(value, _one(value, value.dtype))


@jax.custom_jvp
def _stored_number(value: Array) -> Array:
    return _divided(value)


@_stored_number.defjvp
def _stored_derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    """The one is made of what is stored: of the value itself all of it would be computed again."""
    found = _stored_number(*primals)
    return found, lax.div(tangents[0], _one(found, found.dtype))


def zero_after(witness: Array) -> Array:
    """A zero like a number: what is made of it is not made, and held, before that number is there.

    Under `shard_map` it varies as the number does.
    """
    return stored(jnp.zeros((), witness.dtype), witness)


@jax.custom_jvp
def stored_alone(value: Array) -> Array:
    """Store an array, and leave its derivative to whatever takes it: no pass over it is added."""
    return stored(value)


@stored_alone.defjvp
def _derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return stored_alone(*primals), tangents[0]


@jax.custom_jvp
def stored_rows(values: Array) -> Array:
    """Store a (V, C) array, each of its columns computed once."""
    return assemble(stored([values[:, i] for i in range(values.shape[1])]))


@stored_rows.defjvp
def _rows_derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    """The ones are made of the rows, which are held anyway, not of the columns."""
    found = stored_rows(*primals)
    count = found.shape[1]
    return found, assemble([stored(tangents[0][:, i], found[:, i]) for i in range(count)])


def interleaved(channels: list[Array]) -> Array:
    """Stack channels along a new last axis in one pass, and store them.

    For those that are in buffers already, as what comes out of a loop or a condition is: what
    others have in common would be computed again for each.
    """
    return stored_alone(jnp.stack(channels, axis=-1))


def assemble(channels: list[Array], *, first: bool = False) -> Array:
    """Stack channels along a new last axis, or a new first one, each computed once."""
    shape, count = channels[0].shape, len(channels)
    image = jnp.zeros((count, *shape) if first else (*shape, count), channels[0].dtype)
    for c, channel in enumerate(channels):
        image = image.at[c if first else (..., c)].set(channel)
    return image
