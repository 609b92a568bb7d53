"""Work on views in chunks: a compiled loop draws some of them, and several such loops run at once.

A chunk has room for a fixed number of views, so that one program serves any number of them; where
fewer are left the last one fills the room and is not drawn.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh as DeviceMesh
from jax.sharding import NamedSharding, PartitionSpec

from diffrast._check import strongly_typed
from diffrast._device import draws_on_cpu
from diffrast._stored import stored

AXIS = "views"
LEAST = 2  # of one view XLA would compile other arithmetic
_CHUNK = 16
_CHUNK_BYTES = 1 << 24
_OFF_CPU = 8  # times as many

ViewFunction = Callable[[Any, Any], Any]
Kinds = tuple[tuple[tuple[int, ...], Any], ...]  # shapes and types of arrays, random keys too


def one_of(views: Any) -> Any:
    """The shape of one view."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x)[1:], jnp.result_type(x)), views)


def usual_chunk(function: ViewFunction, views: Any, shared: Any) -> int:
    """How many views a chunk holds if nobody says."""
    leaves, structure = jax.tree.flatten((shared, views))
    kinds = tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves)
    return _room(function, structure, kinds)


@lru_cache(maxsize=64)
def _room(function: ViewFunction, structure: Any, kinds: Kinds) -> int:
    """How many views fit into a chunk, with what is drawn of them."""
    shared, views = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*kind) for kind in kinds])
    view = one_of(views)
    leaves = jax.tree.leaves((view, jax.eval_shape(function, shared, view)))
    size = sum(x.size * x.dtype.itemsize for x in leaves)
    times = 1 if draws_on_cpu() else _OFF_CPU
    return int(np.clip(times * _CHUNK_BYTES // max(size, 1), 1, times * _CHUNK))


def kept(result: Any) -> Any:
    """Stores what a function returns, which would else be computed where it is put into place.

    That is one loop on one core, in which nothing is computed once for several values. Numbers in
    the function's code become arrays, as those that `jax.jit` returns.
    """

    def keep(x: Any) -> Any:
        x = jnp.asarray(x)
        return stored(x) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(keep, result)


def device_mesh(devices: tuple[jax.Device, ...]) -> DeviceMesh:
    return DeviceMesh(np.array(devices), (AXIS,))


def some_views(function: ViewFunction, shared: Any, views: Any, number: Array) -> Any:
    """Results of the first `number` of some views; of the others, whatever comes.

    One after another on a CPU, else all at once.
    """
    if not draws_on_cpu():
        return jax.vmap(function, (None, 0))(shared, views)
    one = jax.eval_shape(function, shared, one_of(views))
    size = jax.tree.leaves(views)[0].shape[0]

    def step(i: Array, results: Any) -> Any:
        result = kept(function(shared, jax.tree.map(lambda x: x[i], views)))
        return jax.tree.map(lambda row, x: row.at[i].set(x), results, result)

    nothing = jax.tree.map(lambda x: jnp.zeros((size, *x.shape), x.dtype), one)
    return lax.fori_loop(0, number, step, nothing)


def block_sum(function: ViewFunction, shared: Any, views: Any, number: Array) -> Any:
    """Sum of results of the first `number` of some views, with a leading axis of one."""
    if not draws_on_cpu():

        def first_ones(x: Array) -> Array:
            exists = jnp.arange(x.shape[0]) < number
            return jnp.where(exists.reshape(-1, *[1] * (x.ndim - 1)), x, 0)

        results = some_views(function, shared, views, number)
        return jax.tree.map(lambda x: jnp.sum(first_ones(x), axis=0, keepdims=True), results)
    one = jax.eval_shape(function, shared, one_of(views))

    def step(i: Array, total: Any) -> Any:
        result = kept(function(shared, jax.tree.map(lambda x: x[i], views)))
        return jax.tree.map(lambda all_, x: all_ + x[None], total, result)

    nothing = jax.tree.map(lambda x: jnp.zeros((1, *x.shape), x.dtype), one)
    return lax.fori_loop(0, number, step, nothing)


@lru_cache(maxsize=64)
def _program(
    work: Callable[..., Any],
    function: ViewFunction,
    structure: Any,
    kinds: Kinds,
    devices: tuple[jax.Device, ...],
    in_use: tuple[np.dtype, Any],
) -> Callable[..., Any]:
    """The compiled loop over a chunk of views; with the kind of numbers and the device in use."""
    del in_use
    split = PartitionSpec(AXIS)

    def on_each(shared: Any, views: Any, number: Array) -> Any:
        size = jax.tree.leaves(views)[0].shape[0]
        before = lax.axis_index(AXIS) * size
        return work(function, shared, views, jnp.clip(number - before, 0, size))

    def alone(shared: Any, views: Any, number: Array) -> Any:
        return work(function, shared, views, number)

    leaves = [jax.ShapeDtypeStruct(*kind) for kind in kinds]
    shared, views = jax.tree.unflatten(structure, leaves)
    count = jax.ShapeDtypeStruct((), np.int32)
    if not devices:
        return _compiled(jax.jit(alone), shared, views, count)
    mesh = device_mesh(devices)
    everywhere, sharded = (NamedSharding(mesh, spec) for spec in (PartitionSpec(), split))
    # Every device works for itself: what a function does with `shared`, its derivative too, stays
    # on the device.
    on_all = jax.shard_map(
        on_each,
        mesh=mesh,
        in_specs=(PartitionSpec(), split, PartitionSpec()),
        out_specs=split,
        check_vma=False,
    )
    jitted = jax.jit(on_all, in_shardings=(everywhere, sharded, everywhere), out_shardings=sharded)
    return _compiled(jitted, shared, views, count)


def _compiled(jitted: Any, *arguments: Any) -> Callable[..., Any]:
    traced = jitted.trace(*arguments)
    if len(traced.jaxpr.in_avals) > len(jax.tree.leaves(arguments)):  # JAX has added arguments
        raise ValueError(
            "function: wanted one that uses no traced values but its arguments, got one that uses"
            " others, too; pass them as `shared`"
        )
    return traced.lower().compile()


def in_order(
    work: Callable[..., Any],
    function: ViewFunction,
    views: Any,
    shared: Any,
    size: int,
    each: int,
    devices: tuple[jax.Device, ...],
) -> Iterator[tuple[int, Any]]:
    """Pairs (first view, result of `work`) of `each` views, in rooms of `size` for each device."""
    views = jax.tree.map(_rows, views)
    shared = jax.tree.map(strongly_typed, shared)
    count, rows_at_once = jax.tree.leaves(views)[0].shape[0], size * max(len(devices), 1)

    def chunk(first: int) -> Any:
        def rows(x: np.ndarray) -> np.ndarray:
            part = x[first : min(first + each, count)]
            return np.concatenate([part, np.repeat(part[-1:], rows_at_once - len(part), axis=0)])

        return jax.tree.map(rows, views)

    leaves, structure = jax.tree.flatten((shared, chunk(0)))
    kinds = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    in_use = jnp.result_type(float), device
    program = _program(work, function, structure, kinds, devices, in_use)
    shared = _placed(shared, program)

    def draw(first: int) -> Any:
        result = program(shared, chunk(first), np.int32(min(each, count - first)))
        return jax.tree.map(_on_host, jax.block_until_ready(result))

    if count <= each:
        yield 0, draw(0)
        return
    workers = 1 if devices else cores()
    waiting: deque[tuple[int, Future[Any]]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        for first in range(0, count, each):
            waiting.append((first, pool.submit(draw, first)))
            if len(waiting) > workers:
                number, result = waiting.popleft()
                yield number, result.result()
        for number, result in waiting:
            yield number, result.result()


def _placed(shared: Any, program: Any) -> Any:
    """Arrays that somebody has put on other devices than the program's, on these."""

    def placed(x: Array, sharding: Any) -> Array:
        there = sharding is None or x.sharding.is_equivalent_to(sharding, x.ndim)
        # What nobody has put anywhere JAX moves by itself.
        free = not x.committed or not x.is_fully_addressable
        return x if free or there else jax.device_put(x, sharding)

    with jax.ensure_compile_time_eval():
        return jax.tree.map(placed, shared, program.input_shardings[0][0])


def _rows(x: Any) -> np.ndarray:
    if jnp.issubdtype(jnp.result_type(x), jax.dtypes.prng_key):
        raise ValueError(
            "views: wanted arrays of numbers, got random keys; pass `jax.random.key_data` of them,"
            " and `jax.random.wrap_key_data` in the function"
        )
    return np.asarray(x)


def _on_host(x: Array) -> Any:
    """As numpy has it, unless other processes hold a part of it."""
    return np.asarray(x) if x.is_fully_addressable else x


def joined(parts: Sequence[Any]) -> Any:
    if len(parts) == 1:
        return parts[0]
    return (np if isinstance(parts[0], np.ndarray) else jnp).concatenate(parts)


def cores() -> int:
    """Cores that this process may use, 1 where another device draws."""
    if not draws_on_cpu():
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
