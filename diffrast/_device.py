"""What is best on a CPU and elsewhere: batches that stay in caches, or fill thousands of lanes.

Both forms compute the same. Which one is traced depends on JAX's default backend. Views under
`vmap` are drawn one after another on a CPU. Elsewhere they are drawn in groups, and the loops of a
group end together: if each view's state had to be kept from the view's own end on, every step would
copy it. So what a loop does where nothing is left must change nothing.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Int

S = TypeVar("S")

_GROUP = "diffrast views"  # the axis of the views that are drawn side by side
_OFF_CPU = 32  # times as many
_MANY = 512  # views
_STEPS_AT_ONCE = 4
_VIEWS_AT_ONCE = 16, 1024
_PIXELS_AT_ONCE = 1 << 22


def draws_on_cpu() -> bool:
    """Whether programs are made for a CPU, if nobody says otherwise."""
    return jax.default_backend() == "cpu"


def _in_group() -> int:
    """How many views are drawn side by side with the one for which a program is made; else 0."""
    try:
        return lax.axis_size(_GROUP)
    except NameError:
        return 0


def lanes() -> int:
    """How many times as much as a CPU's caches hold is worked off side by side, for each view."""
    return 1 if draws_on_cpu() else max(_OFF_CPU // max(_in_group(), 1), 1)


def views_fill_lanes() -> bool:
    """Whether so many views are drawn side by side that smaller batches take less time."""
    return _in_group() >= _MANY


def at_once(some: int, total: int) -> int:
    """How many of so many are worked off side by side, where it is some on a CPU."""
    return min(lanes() * some, total)


def most(number: Int[Array, ""]) -> Int[Array, ""]:
    """The largest number of all views that are drawn side by side."""
    return lax.pmax(number, _GROUP) if _in_group() else number


def anywhere(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether something is true of one of the views that are drawn side by side."""
    return most(flag.astype(jnp.int32)) > 0 if _in_group() else flag


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


def over_views(function: Callable[..., Any], pixels: int) -> Callable[..., Any]:
    """A function that, under `vmap`, takes one view after another on a CPU, else groups of them.

    Args:
        function: of one view, and of arrays alone.
        pixels: of a view; groups of smaller ones are larger.
    """
    if draws_on_cpu():
        return jax.custom_batching.sequential_vmap(function)
    if _in_group():
        return function
    one_or_more = jax.custom_batching.custom_vmap(function)

    @one_or_more.def_vmap
    def in_groups(size: int, batched: Any, *arguments: Any) -> tuple[Any, Any]:
        at_once = min(max(_PIXELS_AT_ONCE // pixels, _VIEWS_AT_ONCE[0]), _VIEWS_AT_ONCE[1])
        groups = -(-size // at_once)
        each = -(-size // groups)
        leaves, tree = jax.tree.flatten(arguments)
        moves = jax.tree.leaves(batched)

        def of_view(own: list[Any]) -> Any:
            rest = iter(own)
            parts = [next(rest) if m else leaf for leaf, m in zip(leaves, moves, strict=True)]
            return function(*jax.tree.unflatten(tree, parts))

        def grouped(x: Any) -> Any:  # the last view again where there are none left
            number = jnp.minimum(jnp.arange(groups * each), size - 1)
            return x[number].reshape(groups, each, *x.shape[1:])

        of_group = jax.vmap(of_view, axis_name=_GROUP)
        own = [leaf for leaf, m in zip(leaves, moves, strict=True) if m]
        if groups == 1:
            out = of_group(own)
        else:
            out = lax.map(of_group, [grouped(x) for x in own])
            out = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:size], out)
        return out, jax.tree.map(lambda _: True, out)

    return one_or_more
