"""Frozen dataclasses that JAX maps over.

A class made by `pytree_dataclass` is a frozen, keyword-only dataclass whose fields are leaves (or
subtrees) of a pytree, except those declared by `static`, which become part of the tree's structure.

JAX rebuilds such objects with placeholders in the fields (axis numbers under `vmap`, bools in
`tree_map`, abstract values while tracing). Rebuilding therefore goes round the constructor: what
`__post_init__` checks and converts is what a user passed, never what a transformation put there.
"""

import copy
import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

T = TypeVar("T")


def static(**options: Any) -> Any:
    """Declare a dataclass field as structure: hashable, compared by value, never traced."""
    return dataclasses.field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(static,))
def pytree_dataclass(cls: type[T]) -> type[T]:
    """Make `cls` a frozen, keyword-only dataclass and register it as a pytree.

    A class whose fields hold one array several times may define `_without_copies(self)`, an object
    with each array once that becomes the tree, and `_with_copies(self)`, which puts them back.
    """
    new_class = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
    fields = dataclasses.fields(new_class)  # type: ignore[arg-type]
    data = tuple(f.name for f in fields if not f.metadata.get("static", False))
    meta = tuple(f.name for f in fields if f.metadata.get("static", False))
    pack, unpack = (getattr(cls, name, _same) for name in ("_without_copies", "_with_copies"))

    def flatten_with_keys(obj: T) -> tuple[Any, Any]:
        obj = pack(obj)
        children = [(jax.tree_util.GetAttrKey(name), getattr(obj, name)) for name in data]
        return children, tuple(getattr(obj, name) for name in meta)

    def flatten(obj: T) -> tuple[Any, Any]:
        obj = pack(obj)
        return [getattr(obj, name) for name in data], tuple(getattr(obj, name) for name in meta)

    def unflatten(structure: Any, children: Any) -> T:
        obj = object.__new__(new_class)
        for name, value in zip(data, children, strict=True):
            object.__setattr__(obj, name, value)
        for name, value in zip(meta, structure, strict=True):
            object.__setattr__(obj, name, value)
        return unpack(obj)

    jax.tree_util.register_pytree_with_keys(new_class, flatten_with_keys, unflatten, flatten)
    return new_class


def with_field(obj: T, name: str, value: Any) -> T:
    """A copy of a frozen dataclass with another value in a field, round its constructor."""
    other = copy.copy(obj)
    set_field(other, name, value)
    return other


def _same(obj: T) -> T:
    return obj


def set_field(obj: Any, name: str, value: Any) -> None:
    """Set a field of a frozen dataclass from inside its `__post_init__`."""
    object.__setattr__(obj, name, value)
