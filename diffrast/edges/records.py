"""Records of the visible pieces, which the derivative is a sum over.

There is room for so many rows. Where that does not hold all, the next ones are made when these have
been read: by the batch of edges or pixels in which they begin, and those after it.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._selection import prefix_sum
from diffrast._stored import stored


class Start(NamedTuple):
    """Where records begin."""

    row: Int[Array, ""]  # the first one, as all are counted
    batch: Int[Array, ""]  # in which it is found,
    before: Int[Array, ""]  # and the rows before this batch


class Records(NamedTuple):
    """Visible pieces: of the rows that were found those from `row` on, as far as there is room."""

    row: Int[Array, ""]  # the first one here
    total: Int[Array, ""]  # rows that were found, in the batches before these, too
    batch: Int[Array, ""]  # as many were worked off
    following: Start  # of the next records, if there are any
    integers: Int[Array, "capacity 6"]  # pixel, pixels of front, beyond, rim; two vertices
    jump: Float[Array, "capacity channels"]  # of the colour outwards, as the piece moves
    weights: Float[Array, "capacity 2"]  # area beyond as the pixel's centre sees it; rim's length
    motion: Float[Array, "capacity 6"]  # of the area with x, y, w of the two vertices

    @property
    def columns(self) -> tuple[Array, ...]:
        """What each row holds."""
        return self.integers, self.jump, self.weights, self.motion


def no_records(
    capacity: int, channels: int, dtype: Any, start: Start | None, zero: Int[Array, ""]
) -> Records:
    """Room for records that begin at `start`, or with the first piece; `zero` as in `collect`."""
    start = start or Start(zero, zero, zero)
    return Records(
        start.row,
        start.before,
        start.batch,
        start._replace(row=start.row + capacity),
        jnp.zeros((capacity, 6), jnp.int32) + zero,
        jnp.zeros((capacity, channels), dtype) + zero.astype(dtype),
        jnp.zeros((capacity, 2), dtype) + zero.astype(dtype),
        jnp.zeros((capacity, 6), dtype) + zero.astype(dtype),
    )


def has_room(records: Records) -> Bool[Array, ""]:
    """Whether more pieces would be recorded."""
    return records.total < records.following.row


def after_batch(records: Records, exists: Bool[Array, ""]) -> Records:
    """The same after a batch, if it exists: in the first that is not recorded the next begin."""
    batch = records.batch + exists.astype(records.batch.dtype)
    fits = exists & has_room(records)
    following = Start(
        records.following.row,
        jnp.where(fits, batch, records.following.batch),
        jnp.where(fits, records.total, records.following.before),
    )
    return records._replace(batch=batch, following=following)


def with_rows(records: Records | None, used: Array, rows: tuple[Array, ...]) -> Records | None:
    """Write rows behind those in use, as far as there is room; None where nothing is recorded."""
    if records is None:
        return None
    capacity = records.jump.shape[0]
    ends = prefix_sum(used.astype(jnp.int32))
    slot = records.total + ends - 1 - records.row
    slot = jnp.where(used & (slot >= 0), slot, capacity)
    integers, jump, weights, motion = (
        old.at[slot].set(new.astype(old.dtype), mode="drop")
        for old, new in zip(records.columns, rows, strict=True)
    )
    return records._replace(
        total=records.total + ends[-1],
        integers=integers,
        jump=jump,
        weights=weights,
        motion=motion,
    )


def with_lines(
    records: Records | None,
    used: Array,
    pixel: Array,
    places: list[Array],
    jump: Array,
    area: Array,
    vertices: Array,
    motion: Array,
) -> Records | None:
    """Record lines that move with more vertices, as several rows each: two in every row."""
    rows = [
        (
            jnp.stack([pixel, places[1], places[0], places[0], *vertices[i]], axis=-1),
            jump,
            jnp.stack([area * float(i == 0), jnp.zeros_like(area)], axis=-1),
            stored(motion[i].T),
        )
        for i in range(len(used))
    ]
    joined = tuple(jnp.concatenate(column) for column in zip(*rows, strict=True))
    return with_rows(records, used.reshape(-1), joined)
