"""Buffers that XLA really stores.

XLA fuses a cheap producer into each of its consumers and computes it again in every one; a gather
even computes its operand again for every element it reads, and the assembly of channels its parts
for every channel. `lax.optimization_barrier` does not stop the CPU compiler, which removes it
before it fuses. What it never computes twice is a division: so a value is divided by a one that it
cannot know to be one until it has fused, to the same bits, and so is its derivative in either
direction. Once fused, the division is found out and costs nothing.

Of small arrays there are hundreds, and compiling takes a CPU some 20 ms for each pass over them.
The only pass that writes several arrays is a reduction of several: so those of one shape are the
maximum of themselves and of a padding that is the least there is. Of that nothing is left, either,
but one loop, vectorised, in which what they have in common is computed once.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from diffrast._device import draws_on_cpu

T = TypeVar("T")

_SMALL = 4096  # numbers of an array; larger ones are better written side by side, by several cores
_TOGETHER = 8  # arrays in one pass; more take longer each, and some thirty are no vector code


def stored(values: T, witness: Array | None = None) -> T:
    """Store every array of numbers in a tree.

    The one is made of the values themselves or, where these have to stay linear, of the witness:
    an array that is no tangent, of their shape.
    """

    def store(value: Array) -> Array:
        if witness is not None:
            return _divided(value, witness)
        moves = jnp.issubdtype(value.dtype, jnp.inexact)
        return _stored(value)[0] if moves else _divided(value, value)

    return jax.tree.map(store, values)


def stored_together(values: T) -> T:
    """The same, on a CPU with one pass for small arrays of one shape.

    Under `vmap` their last bits may be others: it is meant for what takes one view after another.
    """
    leaves, tree = jax.tree.flatten(values)
    for group in _groups(leaves):
        for i, value in zip(group, _stored(*(leaves[i] for i in group)), strict=True):
            leaves[i] = value
    return jax.tree.unflatten(tree, leaves)


def _groups(leaves: list[Array]) -> list[list[int]]:
    """Which arrays are written in one pass; XLA allows for one precision of floats in each."""
    groups: dict[Any, list[int]] = {}
    precision: dict[tuple[int, ...], jnp.dtype] = {}
    for leaf in leaves:
        if jnp.issubdtype(leaf.dtype, jnp.inexact):
            precision.setdefault(leaf.shape, leaf.dtype)
    for i, leaf in enumerate(leaves):
        own = jnp.issubdtype(leaf.dtype, jnp.inexact)
        key = leaf.shape, leaf.dtype if own else precision.get(leaf.shape)
        alone = leaf.size > _SMALL or not draws_on_cpu()
        groups.setdefault(i if alone else key, []).append(i)
    return [
        group[first : first + _TOGETHER]
        for group in groups.values()
        for first in range(0, len(group), _TOGETHER)
    ]


def _one(witness: Array, dtype: jnp.dtype) -> Array:
    """A one that XLA takes for another number until it has fused: of integers it would know."""
    same = lax.stop_gradient(witness)
    if not jnp.issubdtype(same.dtype, jnp.inexact):
        same = same.astype(jnp.float32)
    return lax.select(same < same, lax.full_like(same, 2, dtype), lax.full_like(same, 1, dtype))


def _divided(value: Array, witness: Array) -> Array:
    return value if value.dtype == bool else lax.div(value, _one(witness, value.dtype))


def _least(dtype: Any) -> Array:
    if jnp.issubdtype(dtype, jnp.bool_):
        return jnp.zeros((), dtype)
    least = -jnp.inf if jnp.issubdtype(dtype, jnp.inexact) else jnp.iinfo(dtype).min
    return jnp.asarray(least, dtype)


@jax.custom_jvp
def _stored(*values: Array) -> tuple[Array, ...]:
    """One array, or several of one shape in one pass."""
    if len(values) == 1:
        return (_divided(values[0], values[0]),)
    least = [_least(value.dtype) for value in values]
    rows = [
        lax.pad(value[None], low, [(0, 1, 0), *[(0, 0, 0)] * value.ndim])
        for value, low in zip(values, least, strict=True)
    ]
    return tuple(lax.reduce(rows, least, lambda a, b: list(map(lax.max, a, b)), (0,)))


def _stored_derivative(primals: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
    """The one is made of what is stored: of the value itself all of it would be computed again."""
    found = _stored(*primals)
    changes = zip(tangents, found, strict=True)
    return found, tuple(
        change if isinstance(change, SymbolicZero) else _divided(change, value)
        for change, value in changes
    )


_stored.defjvp(_stored_derivative, symbolic_zeros=True)


def zero_after(witness: Array) -> Array:
    """A zero like a number: what is made of it is not made, and held, before that number is there.

    Under `shard_map` it varies as the number does.
    """
    return stored(jnp.zeros((), witness.dtype), witness)


def stepped(step: Callable[[Array], Array], start: Array, witness: Array) -> Array:
    """What a step makes of `start`, in a loop of one, of which XLA does not know that it is one.

    It looks through divisions, conditions it can decide and loops it can count, but not through
    this. Of the witness, a number that it does not know, it is made that there is one step.
    """
    one = 1 + zero_after(witness)

    def counted(state: tuple[Array, Array]) -> tuple[Array, Array]:
        return state[0] + 1, step(state[1])

    return lax.while_loop(lambda state: state[0] < one, counted, (one - 1, start))[1]


def looked_up(truths: Array, witness: Array) -> Array:
    """Store what is read at places that other arrays name, often more than once, on a CPU.

    Where nothing else wants them XLA would find them out again at every reading, divisions or not.
    """
    return stepped(lambda _: truths, truths & False, witness) if draws_on_cpu() else truths


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


def assemble(channels: list[Array]) -> Array:
    """Stack channels along a new last axis, each computed once."""
    shape, count = channels[0].shape, len(channels)
    image = jnp.zeros((*shape, count), channels[0].dtype)
    for c, channel in enumerate(channels):
        image = image.at[..., c].set(channel)
    return image
