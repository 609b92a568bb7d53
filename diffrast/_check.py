"""Checks of what a user passes: each error names the argument, what was wanted and what came.

Shapes and dtypes are checked always, also while tracing. Values (finite numbers, indices in range)
can only be checked where they are known: a traced array passes.
"""

import contextlib
import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

# What a public function may be given where it wants an array: also lists and tuples of numbers.
ArrayInput: TypeAlias = ArrayLike | Sequence[Any]

P = ParamSpec("P")
T = TypeVar("T")


def is_concrete(value: Any) -> bool:
    """Whether the numbers of `value` are known now, not only their shape."""
    return not isinstance(value, jax.core.Tracer)


def strongly_typed(value: Any) -> Array:
    """With a type of its own, not that of a number in the code, for which JAX compiles anew."""
    known = isinstance(value, Array) and not getattr(value, "weak_type", False)  # keys have none
    with staying_known(value):
        return value if known else jnp.asarray(value, jnp.result_type(value))


def own_copy(value: Array) -> Array:
    """The same numbers in another buffer, so that both may be donated; traced ones as they are."""
    if not is_concrete(value):
        return value
    with staying_known(value):
        return jnp.array(value, copy=True)


def staying_known(*values: Any) -> contextlib.AbstractContextManager[None]:
    """A context in which what is made of known numbers is known, inside of `jax.jit` too.

    There JAX would trace it, like everything else. Of traced numbers nothing changes.
    """
    known = all(is_concrete(leaf) for leaf in jax.tree.leaves(values))
    return jax.ensure_compile_time_eval() if known else contextlib.nullcontext()


def known_of_known(function: Callable[P, T]) -> Callable[P, T]:
    """A function that makes something known of known arguments, inside of `jax.jit` too."""

    @functools.wraps(function)
    def whole(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            context = staying_known(args, kwargs)
        except Exception:  # of what is no tree the function makes an error that tells more
            context = contextlib.nullcontext()
        with context:
            return function(*args, **kwargs)

    return whole


def float_array(
    name: str, value: Any, shape: tuple[int | str, ...] | None = None, *, finite: bool = True
) -> Array:
    """Convert to a floating-point array and check its shape.

    Args:
        name: the argument's name, for the error.
        value: anything array-like. float64 stays float64 where JAX has it enabled; all other
            types become JAX's default float.
        shape: wanted shape. An int is an exact size, a str names an axis of any size; the
            same str twice means equal sizes. A leading "..." stands for any number of
            axes. `None` accepts every shape.
        finite: refuse NaN and infinity, where the values are known.

    Raises:
        ValueError: for anything that is not an array of real numbers of that shape.
    """
    if isinstance(value, np.ndarray | np.generic) and np.issubdtype(value.dtype, np.integer):
        value = value.astype(np.float64)  # JAX would drop the upper half of 64 bits
    array = _array(name, value, "numbers")
    is_real = jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)
    if not is_real:
        raise ValueError(f"{name}: wanted real numbers, got dtype {array.dtype}")
    with staying_known(array):
        if not jnp.issubdtype(array.dtype, jnp.floating):
            array = array.astype(jnp.result_type(float))
        elif array.dtype != jnp.float64:
            array = array.astype(jnp.promote_types(array.dtype, jnp.float32))
    _check_shape(name, array.shape, shape)
    if finite and is_concrete(array):
        bad = np.argwhere(~np.isfinite(np.asarray(array)))
        if len(bad):
            where = tuple(int(i) for i in bad[0])
            raise ValueError(
                f"{name}: wanted finite numbers, got {np.asarray(array)[where]} at index {where}"
                f" ({len(bad)} such value{'s' if len(bad) > 1 else ''})"
            )
    return array


def index_array(
    name: str, value: Any, shape: tuple[int | str, ...], *, minimum: int = 0, bound: int
) -> Array:
    """Convert to int32 and check that every index lies in [minimum, bound)."""
    array = _array(name, value, "integers")
    if not jnp.issubdtype(array.dtype, jnp.integer):
        raise ValueError(f"{name}: wanted integers, got dtype {array.dtype}")
    _check_shape(name, array.shape, shape)
    if is_concrete(array) and array.size:
        is_wide = isinstance(value, np.ndarray | np.generic)  # JAX cuts off 64 bits
        numbers = np.asarray(value if is_wide else array)
        bad = np.argwhere((numbers < minimum) | (numbers >= bound))
        if len(bad):
            where = tuple(int(i) for i in bad[0])
            raise ValueError(
                f"{name}: wanted indices in [{minimum}, {bound}), got {numbers[where]} at index"
                f" {where} ({len(bad)} such value{'s' if len(bad) > 1 else ''})"
            )
    with staying_known(array):
        return array.astype(jnp.int32)


def real_number(name: str, value: Any, *, above: float = -np.inf, below: float = np.inf) -> Array:
    """Convert to a floating-point scalar; where its value is known, above < value < below."""
    number = float_array(name, value, ())
    if is_concrete(number) and not above < float(number) < below:
        raise ValueError(
            f"{name}: wanted a number between {above:g} and {below:g}, got {float(number):g}"
        )
    return number


def static_number(name: str, value: Any) -> float:
    """Check a finite number that is known, also where others are traced."""
    try:
        if isinstance(value, str | bytes | bool | np.bool) or np.ndim(value) != 0:
            raise TypeError("of another kind")
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name}: wanted a known number, got {_brief(value)}") from error
    if not np.isfinite(number):
        raise ValueError(f"{name}: wanted a finite number, got {number}")
    return number


def distance(name: str, value: Any) -> float:
    """Check a known number of at least 0."""
    number = static_number(name, value)
    if number < 0:
        raise ValueError(f"{name}: wanted a distance of at least 0, got {number}")
    return number


def positive_int(name: str, value: Any, *, minimum: int = 1, maximum: int = 2**31 - 1) -> int:
    """Check a static count or size; what counts pixels or vertices has 32 bits."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < minimum:
        raise ValueError(f"{name}: wanted an integer of at least {minimum}, got {_brief(value)}")
    if value > maximum:
        raise ValueError(f"{name}: wanted an integer of at most {maximum}, got {_brief(value)}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Check a static yes or no."""
    if not isinstance(value, bool | np.bool | int | np.integer) or value not in (0, 1):
        raise ValueError(f"{name}: wanted True or False, got {_brief(value)}")
    return bool(value)


def instance_of(name: str, value: Any, *kinds: type) -> None:
    """Check that an object is one of the library's."""
    if not isinstance(value, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"{name}: wanted a {wanted}, got {type(value).__name__}")


def all_instances(name: str, values: Any, kind: type) -> None:
    """Check a sequence of objects of the library's."""
    if not isinstance(values, Sequence):
        raise ValueError(f"{name}: wanted a list, got {type(values).__name__}")
    for number, value in enumerate(values):
        instance_of(f"{name}[{number}]", value, kind)


def iterable(name: str, value: Any, wanted: str) -> None:
    """Check what has one entry after another."""
    try:
        iter(value)
    except TypeError as error:
        raise ValueError(f"{name}: wanted {wanted}, got {_brief(value)}") from error


def array_tree(name: str, tree: Any) -> None:
    """Check a tree of arrays and numbers of any kind."""
    for leaf in jax.tree.leaves(tree):
        foreign = isinstance(leaf, np.ndarray | np.generic) and leaf.dtype.kind not in "biufcV"
        if foreign or not isinstance(leaf, Array | np.ndarray | np.generic | int | float | complex):
            raise ValueError(f"{name}: wanted a tree of arrays, got {_brief(leaf)} in it")


def file_path(name: str, value: Any) -> Path:
    """Check what should be the name of a file, there or not."""
    try:
        path = Path(value)
        if b"\0" in os.fsencode(path):
            raise ValueError("embedded null character")
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name}: wanted the name of a file, got {_brief(value)} ({error})"
        ) from error
    return path


def one_of(name: str, value: Any, choices: tuple[str, ...]) -> str:
    """Check a choice by name."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name}: wanted one of {', '.join(choices)}, got {_brief(value)}")
    return value


def _array(name: str, value: Any, wanted: str) -> Array:
    try:
        # Infinity is dealt with as such.
        with np.errstate(over="ignore"), staying_known(value):
            return jnp.asarray(value)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        reason = str(error).split("\n")[0]
        raise ValueError(
            f"{name}: wanted an array of {wanted}, got {_brief(value)} ({reason})"
        ) from error


def _check_shape(name: str, got: tuple[int, ...], wanted: tuple[int | str, ...] | None) -> None:
    if wanted is None:
        return
    if wanted and wanted[0] == "..." and len(got) >= len(wanted) - 1:
        wanted = (*got[: len(got) - len(wanted) + 1], *wanted[1:])
    sizes: dict[str, int] = {}
    fits = len(got) == len(wanted) and all(
        size == want if isinstance(want, int) else sizes.setdefault(want, size) == size
        for size, want in zip(got, wanted, strict=True)
    )
    if not fits:
        text = ", ".join(str(want) for want in wanted) + ("," if len(wanted) == 1 else "")
        raise ValueError(f"{name}: wanted shape ({text}), got {got}")


def _brief(value: Any) -> str:
    try:
        text = repr(value)
    except Exception:  # also of lists nested too deep
        text = f"a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."
