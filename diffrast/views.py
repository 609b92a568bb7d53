"""Many views through one call: on all cores, on several devices, in bounded memory.

A compiled loop draws a chunk of views one after another, and several such loops run side by side:
one on each core of the CPU, or on each of the devices given. A view is drawn by the same code
whatever its place among the others, so the result has the same bits for any size of chunks and any
number of cores or devices; sums are taken in blocks of fixed size for the same reason. A view is
not only a camera: any tree of arrays with a common leading axis may differ from view to view,
lights, transforms, materials or meshes (`dr.mesh.stack_meshes` makes them equally large).

Inside of `jax.jit`, `jax.grad` and other transformations, where numbers are not known, the views
are mapped by `jax.lax.map`, and the derivative draws each view again instead of keeping what it
needs of all of them.
"""

import operator
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.sharding import PartitionSpec
from jaxtyping import Float

from diffrast._check import all_instances, array_tree, instance_of, is_concrete, positive_int
from diffrast._chunks import (
    AXIS,
    LEAST,
    ViewFunction,
    block_sum,
    cores,
    device_mesh,
    in_order,
    joined,
    kept,
    one_of,
    some_views,
    usual_chunk,
)
from diffrast.camera import Camera
from diffrast.render import render
from diffrast.scene import Scene
from diffrast.settings import RenderSettings

_BLOCK = 8  # views that are summed one after another


def render_views(
    scene: Scene,
    cameras: Camera,
    settings: RenderSettings,
    *,
    chunk: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Float[Array, "views height width 3"]:
    """Render one scene from many viewpoints; equals `render` of each.

    Differentiable as `render` is. For scenes that differ from view to view, for pictures that are
    used and forgotten one by one, and for sums of gradients see `map_views`, `stream_views` and
    `sum_views`.

    Args:
        scene: what is seen.
        cameras: cameras along a leading axis, as `stack_cameras` or `jax.vmap` make them.
        settings: image size and method.
        chunk: views that one call of the compiled program draws; bounds the memory besides that of
            the result. By default up to 16, so many that they take some 16 MB.
        devices: on which to draw; by default all cores, if the default device is the CPU, or else
            that device.

    Returns:
        (views, height, width, 3) linear RGB.

    Raises:
        ValueError: for cameras that are no stack or of unequal sizes, a chunk below 1, an empty
            list of devices and one in which a device comes twice.
    """
    instance_of("scene", scene, Scene)
    instance_of("cameras", cameras, Camera)
    instance_of("settings", settings, RenderSettings)
    if jnp.ndim(cameras.view) != 3:
        raise ValueError(
            f"cameras: wanted a stack, with views of shape (views, 4, 4), got shape"
            f" {jnp.shape(cameras.view)}"
        )
    return map_views(image_of, cameras, (scene, settings), chunk=chunk, devices=devices)


def image_of(shared: tuple[Scene, RenderSettings], camera: Camera) -> Array:
    """What `render_views` does with each view, for `stream_views`: `render` of a scene."""
    scene, settings = shared
    return render(scene, camera, settings)


def map_views(
    function: ViewFunction,
    views: Any,
    shared: Any = None,
    *,
    chunk: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Any:
    """Apply a function to every view and stack what it returns.

    Args:
        function: `function(shared, view)` of arrays, as `jax.jit` takes it, to a tree of arrays
            and numbers; pass the same object again and it is compiled once.
        views: a tree of arrays with a common leading axis.
        shared: a tree of arrays that all views have in common, on any device.
        chunk: as in `render_views`.
        devices: as in `render_views`.

    Returns:
        The tree that `function` returns, with a leading axis of views.

    Raises:
        ValueError: as `render_views`, and for a function that uses traced values which are not its
            arguments while these are known.

    Example:
        >>> dr.views.map_views(lambda scale, x: scale * x**2, jnp.arange(4.0), 10.0).tolist()
        [0.0, 10.0, 40.0, 90.0]
    """
    count, chunk, devices = _checked(function, views, shared, chunk, devices)
    if not _known(views, shared):
        return _mapped(function, views, shared, count, devices)
    if count == 0:
        one = jax.eval_shape(function, shared, one_of(views))
        return jax.tree.map(lambda x: jnp.zeros((0, *x.shape), x.dtype), one)
    stream = stream_views(function, views, shared, chunk=chunk, devices=devices or None)
    parts = [part for _, part in stream]
    return jax.tree.map(lambda *rows: jnp.asarray(joined(rows)), *parts)


def stream_views(
    function: ViewFunction,
    views: Any,
    shared: Any = None,
    *,
    chunk: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Iterator[tuple[range, Any]]:
    """As `map_views`, a chunk at a time and in order: pairs (which views, their results).

    Not more than a chunk for each core or device, and one, is kept in memory::

        shared = scene, settings
        for which, images in dr.views.stream_views(dr.views.image_of, cameras, shared):
            for number, picture in zip(which, images):
                dr.save_image(f"{number:04}.png", picture)

    Raises:
        ValueError: as `render_views`, and inside of JAX's transformations.
    """
    count, chunk, devices = _checked(function, views, shared, chunk, devices)
    if not _known(views, shared):
        raise ValueError("views: wanted known numbers; inside of transformations use map_views")
    if count == 0:
        return
    size = max(chunk or usual_chunk(function, views, shared), LEAST)
    if devices:
        size = max(min(size, -(-count // len(devices))), LEAST)
        each = size * len(devices)
    else:  # some for each core, by the same program
        each = chunk or min(size, -(-count // cores()))
    for first, part in in_order(some_views, function, views, shared, size, each, devices):
        number = min(each, count - first)
        yield range(first, first + number), jax.tree.map(lambda x, n=number: x[:n], part)


def sum_views(
    function: ViewFunction,
    views: Any,
    shared: Any = None,
    *,
    devices: Sequence[jax.Device] | None = None,
) -> Any:
    """Apply a function to every view and add up what it returns, one view after another.

    The gradient of a loss over many views, in memory that does not depend on how many these are::

        def loss(parameters, view): ...

        value, gradient = dr.views.sum_views(jax.value_and_grad(loss), views, parameters)

    Arguments and errors as `map_views`. Sums of whole numbers and logical values are not for this.
    """
    count, _, devices = _checked(function, views, shared, None, devices)
    if not _known(views, shared) or count == 0:
        step = jax.checkpoint(function, prevent_cse=False)
        one = jax.eval_shape(function, shared, one_of(views))
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), one)

        def add(total: Any, view: Any) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, total, step(shared, view)), None

        return lax.scan(add, nothing, views)[0]
    total = None
    loops = max(len(devices), 1)  # each gives a row
    each = _BLOCK * loops
    for _, part in in_order(block_sum, function, views, shared, _BLOCK, each, devices):
        for row in range(loops):
            block = jax.tree.map(lambda x, row=row: x[row], part)
            total = block if total is None else jax.tree.map(operator.add, total, block)
    return jax.tree.map(jnp.asarray, total)


# --------------------------------------------------------------------------------- what is checked


def _checked(
    function: ViewFunction,
    views: Any,
    shared: Any,
    chunk: int | None,
    devices: Sequence[jax.Device] | None,
) -> tuple[int, int | None, tuple[jax.Device, ...]]:
    if not callable(function):
        raise ValueError(f"function: wanted a function, got {type(function).__name__}")
    array_tree("views", views)
    array_tree("shared", shared)
    shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(views)]
    if not shapes or any(not shape or shape[0] != shapes[0][0] for shape in shapes):
        raise ValueError(f"views: wanted arrays with a common leading axis, got shapes {shapes}")
    if chunk is not None:
        chunk = positive_int("chunk", chunk)
    if devices is not None:
        all_instances("devices", devices, jax.Device)
        if len(devices) == 0:
            raise ValueError("devices: wanted at least one, got none")
        if len(set(devices)) < len(devices):
            raise ValueError(f"devices: wanted each one once, got {list(devices)}")
    return shapes[0][0], chunk, tuple(devices or ())


def _known(*trees: Any) -> bool:
    return all(is_concrete(leaf) for leaf in jax.tree.leaves(trees))


# ------------------------------------------------------------------------- where numbers are traced


def _mapped(
    function: ViewFunction, views: Any, shared: Any, count: int, devices: tuple[jax.Device, ...]
) -> Any:
    """By `lax.map`, on several devices as many views on each, the last ones drawn again."""
    once = jax.checkpoint(function, prevent_cse=False)

    def local(shared: Any, part: Any) -> Any:
        return lax.map(lambda view: kept(once(shared, view)), part)

    if len(devices) < 2 or count == 0:
        return local(shared, views)
    rest = -count % len(devices)
    padded = jax.tree.map(
        lambda x: jnp.concatenate([x, jnp.broadcast_to(x[-1:], (rest, *x.shape[1:]))]), views
    )
    all_of = jax.shard_map(
        local,
        mesh=device_mesh(devices),
        in_specs=(PartitionSpec(), PartitionSpec(AXIS)),
        out_specs=PartitionSpec(AXIS),
    )
    return jax.tree.map(lambda x: x[:count], all_of(shared, padded))
