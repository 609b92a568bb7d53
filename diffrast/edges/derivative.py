"""The derivative of the anti-aliased image, as a linear map in both directions.

It is a sum over the recorded pieces: of the colour's jump times the area's motion, linear in the
positions, and of the area times the change of the colours on its two sides.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrast._device import at_once, most, over_views
from diffrast._linear import linear_map, linear_zeros
from diffrast._selection import batches_of
from diffrast._stored import stored
from diffrast.edges.blend import LEFT_STEPS, Method, View, cropped
from diffrast.edges.collect import collect
from diffrast.edges.records import Records, Start

ROWS_AT_ONCE = 1024


def _over_rows(
    records: Records,
    add: Callable[[Array, Any, Any], Any],
    start: Any,
    applies: Array | bool = True,
) -> Any:
    """Add up what each block of rows contributes; `used` masks those that do not count.

    Where it does not apply no row does: of a condition the branches would copy what they add to.
    """
    capacity = records.jump.shape[0]
    some = at_once(ROWS_AT_ONCE, capacity)
    count = jnp.where(applies, jnp.minimum(records.total - records.row, capacity), 0)

    def step(n: Array, total: Any) -> Any:
        first = begin = n * some
        if capacity % some:  # the last block begins among the rows of the one before
            begin = jnp.minimum(first, capacity - some)
        number = begin + jnp.arange(some, dtype=jnp.int32)
        used = number < count if begin is first else (number >= first) & (number < count)
        rows = [lax.dynamic_slice_in_dim(column, begin, some) for column in records.columns]
        return add(used, rows, total)

    return lax.fori_loop(0, batches_of(most(count), some), step, start)


def _over_pieces(
    view: View,
    method: Method,
    records: Records,
    adds: Sequence[Callable[[Array, Any, Any], Any]],
    total: Any,
) -> Any:
    """Add up over all visible pieces, once with each of one or two `adds`.

    The pieces that are not recorded are found again, as many at a time as there are rows.
    """

    def step(state: tuple[Array, Start, Any]) -> tuple[Array, Start, Any]:
        which, start, total = state
        found = collect(view, method, start).records
        assert found is not None
        for n, add in enumerate(adds):
            total = _over_rows(found, add, total, which == n)
        ended = found.following.row >= records.total
        following = jax.tree.map(
            lambda again, next: jnp.where(ended, again, next), records.following, found.following
        )
        return which + ended.astype(which.dtype), following, total

    def is_left(state: tuple[Array, Start, Any]) -> Array:
        return state[0] < len(adds)

    total = _over_rows(records, adds[0], total)
    which = jnp.where(records.following.row < records.total, 0, len(adds))
    total = lax.while_loop(is_left, step, (which, records.following, total))[2]
    return _over_rows(records, adds[1], total) if len(adds) > 1 else total


def _area(area: Array, pixel: Array, left: Array) -> Array:
    """How much of pixels shows another one's change in place of that at their centres.

    Where a surface begins to fold, there are many edges in a pixel, all of which part what its
    centre shows from what the next one does: together they leave no more than all of it.
    """
    steps = left[pixel].astype(area.dtype)
    return (area / jnp.maximum(steps / LEFT_STEPS, 1))[:, None]


def _mean(total: Array, length: Array, other: Array) -> Array:
    """What lengths of rims add up to over their sum, or something else where there are none."""
    rim = (length > 0)[:, None]
    return jnp.where(rim, total / jnp.where(rim, length[:, None], 1), other)


def _push(
    view: View,
    method: Method,
    records: Records,
    left: Array,
    points: Array,
    colors: tuple[Array, Array],
    added: Array,
) -> Array:
    """Change of the image with the homogeneous pixel coordinates and with the hard image.

    What the rim of a smooth surface shows changes without bounds at a pixel's centre; the change
    at the next pixel's stands for it, less what `colors_along` takes off, or none if that is too
    steep: such rims have negative lengths.
    """
    centres, means = colors

    def average(used: Array, rows: Any, total: tuple[Array, ...]) -> tuple[Array, ...]:
        averages, lengths, added = total
        integers, _, sizes, _ = rows
        _, front, _, inner, _, _ = integers.T
        length = jnp.where(used, sizes[:, 1], 0)
        averages = averages.at[front].add(jnp.maximum(length, 0)[:, None] * centres[inner])
        return averages, lengths.at[front].add(jnp.abs(length)), added

    def add(used: Array, rows: Any, total: tuple[Array, ...]) -> tuple[Array, ...]:
        averages, lengths, added = total
        integers, jump, sizes, motion = rows
        pixel, front, beyond, _, start, end = integers.T
        here, there = (_mean(averages[i], lengths[i], means[i]) for i in (front, beyond))
        moved = jnp.sum(motion[:, :3] * points[start] + motion[:, 3:] * points[end], axis=1)
        value = moved[:, None] * jump + _area(sizes[:, 0], pixel, left) * (there - here)
        return averages, lengths, added.at[pixel].add(jnp.where(used[:, None], value, 0))

    adds = [add] if method.shader is None else [average, add]
    start = jnp.zeros_like(centres), jnp.zeros_like(centres[:, 0]), added
    averages, lengths, added = _over_pieces(view, method, records, adds, start)
    own = _mean(averages, lengths, means)[: view.face_image.size]
    return added + cropped(own, view.image.shape)


def _pull(
    view: View, method: Method, records: Records, left: Array, cotangent: Array
) -> tuple[Array, tuple[Array, Array]]:
    """The transpose of `_push`: what a change of the image means for `points` and `colors`."""
    # What the cotangent is made of need not be held any longer, then.
    cotangent = stored(cotangent, cropped(view.image, view.image.shape))
    own = cotangent.reshape(*view.size, -1)
    own = jnp.pad(own, ((1, 1), (1, 1), (0, 0))).reshape(view.face_image.size, -1)
    own = jnp.pad(own, ((0, view.colors - own.shape[0]), (0, 0)))

    def add(used: Array, rows: Any, total: tuple[Array, ...]) -> tuple[Array, ...]:
        points, own, lengths, inwards = total
        integers, jump, sizes, motion = rows
        pixel, front, beyond, _, start, end = integers.T
        value = jnp.where(used[:, None], cotangent[pixel], 0)
        along = jnp.sum(value * jump, axis=1)[:, None]
        points = points.at[start].add(along * motion[:, :3]).at[end].add(along * motion[:, 3:])
        value = value * _area(sizes[:, 0], pixel, left)
        own = own.at[beyond].add(value).at[front].add(-value)
        length = jnp.where(used, jnp.abs(sizes[:, 1]), 0)
        return points, own, lengths.at[front].add(length), inwards

    def average(used: Array, rows: Any, total: tuple[Array, ...]) -> tuple[Array, ...]:
        points, own, lengths, inwards = total
        integers, _, sizes, _ = rows
        _, front, _, inner, _, _ = integers.T
        length = jnp.where(used, jnp.maximum(sizes[:, 1], 0), 0)
        value = _mean(length[:, None] * own[front], lengths[front], jnp.zeros_like(own[front]))
        return points, own, lengths, inwards.at[inner].add(value)

    adds = [add] if method.shader is None else [add, average]
    points = linear_zeros((view.positions_clip.shape[0], 3), cotangent)
    inwards = linear_zeros(own.shape, cotangent)
    start = points, own, jnp.zeros_like(own[:, 0]), inwards
    points, own, lengths, inwards = _over_pieces(view, method, records, adds, start)
    return points, (inwards, jnp.where(lengths[:, None] > 0, 0, own))


def apply_linear(
    view: View,
    method: Method,
    records: Records,
    left: Array,
    points: Array,
    colors: tuple[Array, Array],
) -> Array:
    """`_push`, of which JAX knows both directions.

    The change of colours is given twice, at the centres of pixels and of their means; each time
    that of the image, and then that of a background which is one.
    """

    def each_view(way: Callable[..., Any]) -> Callable[..., Any]:
        return over_views(lambda view, *rest: way(view, method, *rest), view.face_image.size)

    push, pull = each_view(_push), each_view(_pull)
    return linear_map(
        lambda changes, nothing: push(view, records, left, *changes, nothing),
        lambda cotangent: pull(view, records, left, cotangent),
        (points, colors),
        jnp.zeros((view.size[0] * view.size[1], colors[0].shape[1]), colors[0].dtype),
    )
