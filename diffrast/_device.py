"""What is best on a CPU and elsewhere: batches that stay in caches, or fill thousands of lanes.

Both forms compute the same. Which one is traced depends on JAX's default backend.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

S = TypeVar("S")

_OFF_CPU = 32  # times as many
_STEPS_AT_ONCE = 4
_VIEWS_AT_ONCE = 16, 1024
_PIXELS_AT_ONCE = 1 << 22


def draws_on_cpu() -> bool:
    """Whether programs are made for a CPU, if nobody says otherwise."""
    return jax.default_backend() == "cpu"


def lanes() -> int:
    """How many times as much as a CPU's caches hold is worked off side by side."""
    return 1 if draws_on_cpu() else _OFF_CPU


def at_once(some: int, total: int) -> int:
    """How many of so many are worked off side by side: some on a CPU, elsewhere all of them."""
    return min(some, total) if draws_on_cpu() else total


def in_strides(step: Callable[[S], S]) -> Callable[[S], S]:
    """The step of a loop; elsewhere than on a CPU several steps, for which the loop asks only once.

    What has come to its end must stay as it is.
    """
    if draws_on_cpu():
        return step

    def stride(state: S) -> S:
        for _ in range(_STEPS_AT_ONCE):
            state = step(state)
        return state

    return stride


def over_views(in_lanes: Callable[[int], Callable[..., Any]], pixels: int) -> Callable[..., Any]:
    """A function that, under `vmap`, takes one view after another on a CPU, else groups of them.

    Args:
        in_lanes: the function that works off so many times as much side by side as on a CPU: fewer
            for each of a group of views than for one alone.
        pixels: of a view; groups of smaller ones are larger.
    """
    alone = in_lanes(lanes())
    if draws_on_cpu():
        return jax.custom_batching.sequential_vmap(alone)
    function = jax.custom_batching.custom_vmap(alone)

    @function.def_vmap
    def in_groups(size: int, batched: Any, *arguments: Any) -> tuple[Any, Any]:
        at_once = min(max(_PIXELS_AT_ONCE // pixels, _VIEWS_AT_ONCE[0]), _VIEWS_AT_ONCE[1])
        groups = -(-size // at_once)
        each = -(-size // groups)
        for_one = in_lanes(max(lanes() // each, 1))
        leaves, tree = jax.tree.flatten(arguments)
        moves = jax.tree.leaves(batched)

        def of_view(own: list[Any]) -> Any:
            rest = iter(own)
            parts = [next(rest) if m else leaf for leaf, m in zip(leaves, moves, strict=True)]
            return for_one(*jax.tree.unflatten(tree, parts))

        def grouped(x: Any) -> Any:  # the last view again where there are none left
            number = jnp.minimum(jnp.arange(groups * each), size - 1)
            return x[number].reshape(groups, each, *x.shape[1:])

        own = [leaf for leaf, m in zip(leaves, moves, strict=True) if m]
        if groups == 1:
            out = jax.vmap(of_view)(own)
        else:
            out = lax.map(jax.vmap(of_view), [grouped(x) for x in own])
            out = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:size], out)
        return out, jax.tree.map(lambda _: True, out)

    return function
