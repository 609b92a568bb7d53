"""Linear maps that are loops over as many batches as there are, in both directions.

JAX transposes no loop whose length is known only when it runs.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

T = TypeVar("T")


def linear_zeros(shape: tuple[int, ...], tangent: Array) -> Array:
    """Zeros that depend on a tangent: derivatives leave out what is known not to."""
    return jnp.broadcast_to(tangent.reshape(-1)[0] * 0, shape)


def without_known_zeros(changes: T) -> T:
    """A tree of tangents, of which some are not known to be zero, in which then none is."""
    leaves, tree = jax.tree.flatten(changes)
    one = next(leaf for leaf in leaves if not isinstance(leaf, SymbolicZero))
    filled = [
        linear_zeros(leaf.shape, one) if isinstance(leaf, SymbolicZero) else leaf for leaf in leaves
    ]
    return jax.tree.unflatten(tree, filled)


def linear_map(
    push: Callable[..., Array], pull: Callable[[Array], Any], changes: Any, nothing: Array
) -> Array:
    """`push(changes, nothing)`, written as a linear system so that JAX knows both directions.

    The system is triangular, (changes, out - push) = (changes, nothing), and its solution and that
    of its transpose are the functions given. The transpose's right side is zero but for `out`,
    since nothing else of the solution is used. What comes out has to depend on all parts of its
    solution, if only by one number each, and `nothing` on one of the changes: derivatives of it and
    of its transpose, again, leave out none.

    Args:
        push: adds what a tree of changes means to zeros of the shape of the result.
        pull: its transpose, of the result alone.
        changes: a tree of arrays.
        nothing: zeros, of two axes.
    """

    def traces(tree: Any) -> Array:
        first, *others = (0 * leaf[(0,) * leaf.ndim] for leaf in jax.tree.leaves(tree))
        return sum(others, first)

    def solve(_: Any, b: tuple[Any, Array]) -> tuple[Any, Array]:
        return b[0], push(*b)

    def transpose_solve(_: Any, b: tuple[Any, Array]) -> tuple[Any, Array]:
        return pull(b[1]), b[1]

    changes = _all_changing(changes)
    # Of all changes, memory would be held longer.
    right = changes, nothing.at[0, 0].add(traces(jax.tree.leaves(changes)[0]))
    changes, out = lax.custom_linear_solve(lambda x: x, right, solve, transpose_solve)
    return out.at[0, 0].add(traces(changes))


@jax.custom_jvp
def _all_changing(changes: Any) -> Any:
    """The same; of their derivatives JAX takes all or none, whatever is known to be zero."""
    return changes


_all_changing.defjvp(
    lambda primals, tangents: (primals[0], without_known_zeros(tangents[0])), symbolic_zeros=True
)
