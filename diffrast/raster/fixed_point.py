"""Vertices on the sub-pixel grid, and faces sorted by the work they need.

Coverage is decided in integers, so that it is exact and the same on every device: vertices snap to
a grid of `subpixels(...)` steps a pixel (1/1024 pixel up to images of 8192 pixels), measured from
the image centre, where float32 is finest. The sign of an edge function of snapped end points has no
rounding at all; both owners of an edge, and the joined and the corner-split form of a mesh, agree
bit for bit.

A vertex is *regular* if it lies in front of the eye and inside the guard band of `2**22` grid steps
round the image centre. Small faces of regular vertices between the near and the far plane are drawn
by blocks of pixels; the class of all others keeps homogeneous coordinates, for vertices behind the
eye, far off the screen and beyond the near or far plane.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

GUARD_BITS = 22  # |fixed-point coordinate| <= 2**22, so that differences fit 24 bits
# Pixel blocks (rows, columns) that hold a face of each block class whole. They are of fewer than
# 2^11 pixels: twice the area of a face, in grid steps, fits int32.
BLOCKS = ((4, 4), (16, 16), (24, 32), (40, 48))

# Classes of faces, in drawing order: one a block size, then LARGE, CULLED.
LARGE, CULLED = range(len(BLOCKS), len(BLOCKS) + 2)


def subpixel_bits(height: int, width: int) -> int:
    """Return log2 of the grid steps a pixel: 10, or fewer for images beyond 8192 pixels."""
    half_extent = max(height, width, 2) // 2
    return min(10, GUARD_BITS - (half_extent - 1).bit_length())


class Vertices(NamedTuple):
    """What coverage needs to know of vertices, in columns: (V,), or (3, F) for corners of faces."""

    x_fixed: Int[Array, "*V"]  # grid steps right of the image centre; 0 if not regular
    y_fixed: Int[Array, "*V"]  # grid steps below the image centre
    x: Float[Array, "*V"]  # homogeneous pixel coordinates: x / w pixels right of the centre
    y: Float[Array, "*V"]
    z: Float[Array, "*V"]
    w: Float[Array, "*V"]
    rank: Float[Array, "*V"]  # numerator of the depth key: key = rank / w, larger is nearer
    outcode: Int[Array, "*V"]


# Outcode bits. A face with one of the first seven bits common to its corners cannot be seen.
_LEFT, _RIGHT, _BOTTOM, _TOP, NEAR, FAR, _BAD, IRREGULAR = (1 << i for i in range(8))


def snap_vertices(positions_clip: Float[Array, "V 4"], *, height: int, width: int) -> Vertices:
    """Bring clip positions to pixels and onto the sub-pixel grid.

    The depth key is 1/w, which keeps its relative precision whatever the planes near and far are.
    A parallel projection has the same w everywhere; its key is -z/w.
    """
    bits = subpixel_bits(height, width)
    x_clip, y_clip, z, w = (positions_clip[:, i] for i in range(4))
    x, y = x_clip * (width / 2), y_clip * (-height / 2)
    finite = jnp.isfinite(x) & jnp.isfinite(y) & jnp.isfinite(z) & jnp.isfinite(w)
    x_clip, y_clip, x, y, z, w = (jnp.where(finite, c, 0) for c in (x_clip, y_clip, x, y, z, w))

    in_front = w > 0
    inverse_w = 1 / jnp.where(in_front, w, 1)
    steps = float(1 << bits)
    x_steps, y_steps = x * inverse_w * steps, y * inverse_w * steps
    limit = float(1 << GUARD_BITS)
    regular = finite & in_front & (jnp.abs(x_steps) <= limit) & (jnp.abs(y_steps) <= limit)
    x_fixed = jnp.round(jnp.where(regular, x_steps, 0)).astype(jnp.int32)
    y_fixed = jnp.round(jnp.where(regular, y_steps, 0)).astype(jnp.int32)

    outcode = sum(
        jnp.where(condition, bit, 0)
        for condition, bit in (
            (x_clip < -w, _LEFT),
            (x_clip > w, _RIGHT),
            (y_clip < -w, _BOTTOM),
            (y_clip > w, _TOP),
            (z < -w, NEAR),
            (z > w, FAR),
            (~finite, _BAD),
            (~regular, IRREGULAR),
        )
    )
    largest_w = jnp.max(w)
    parallel = jnp.all((w == largest_w) | ~finite) & (largest_w > 0)
    rank = jnp.where(parallel, -z, jnp.ones_like(w))
    return Vertices(x_fixed, y_fixed, x, y, z, w, rank, jnp.asarray(outcode, jnp.int32))


def first_centre(size: int, bits: int) -> int:
    """Fixed-point coordinate of the first pixel's centre along an axis of `size` pixels."""
    return ((1 - size) << bits) // 2


def pixel_range(lowest: Array, highest: Array, *, size: int, bits: int) -> tuple[Array, Array]:
    """First and last pixel, inside the image, whose centre lies in [lowest, highest]."""
    origin = first_centre(size, bits)
    first = (lowest - origin + ((1 << bits) - 1)) >> bits
    last = (highest - origin) >> bits
    return jnp.maximum(first, 0), jnp.minimum(last, size - 1)


def twice_area_sign(x: list[Array], y: list[Array]) -> Array:
    """Exact sign of a snapped triangle's area: 1 is clockwise on the screen (y down).

    The product wraps in int32; where its true size might not fit, float32 is sure of the sign.
    """
    x1, y1, x2, y2 = x[1] - x[0], y[1] - y[0], x[2] - x[0], y[2] - y[0]
    wrapped = x1 * y2 - x2 * y1
    f = jnp.float32
    rounded = x1.astype(f) * y2.astype(f) - x2.astype(f) * y1.astype(f)
    return jnp.where(
        jnp.abs(rounded) > 2.0**30, jnp.sign(rounded).astype(jnp.int32), jnp.sign(wrapped)
    )


def classify_faces(
    vertices: Vertices, faces: Int[Array, "F 3"], *, height: int, width: int, cull_backfaces: bool
) -> Int[Array, " F"]:
    """Class of each face: the first of `BLOCKS` that holds it, LARGE or CULLED."""
    bits = subpixel_bits(height, width)
    corners = [faces[:, i] for i in range(3)]
    x = [vertices.x_fixed[c] for c in corners]
    y = [vertices.y_fixed[c] for c in corners]
    codes = [vertices.outcode[c] for c in corners]
    common = codes[0] & codes[1] & codes[2]
    union = codes[0] | codes[1] | codes[2]

    x_low, x_high = minimum3(x), maximum3(x)
    y_low, y_high = minimum3(y), maximum3(y)
    column, last_column = pixel_range(x_low, x_high, size=width, bits=bits)
    row, last_row = pixel_range(y_low, y_high, size=height, bits=bits)
    columns, rows = last_column - column + 1, last_row - row + 1
    area_sign = twice_area_sign(x, y)
    wrong_side = area_sign >= 0 if cull_backfaces else area_sign == 0

    # The arithmetic of blocks also needs the part of the face outside the image to be small.
    compact = (y_high - y_low <= (BLOCKS[-1][0] << bits)) & (
        x_high - x_low <= (BLOCKS[-1][1] << bits)
    )
    size = jnp.full_like(rows, LARGE)
    for index, block in reversed(list(enumerate(BLOCKS))):
        size = jnp.where(compact & (rows <= block[0]) & (columns <= block[1]), index, size)
    size = jnp.where((columns <= 0) | (rows <= 0) | wrong_side, CULLED, size)
    size = jnp.where((union & (IRREGULAR | NEAR | FAR)) != 0, LARGE, size)
    unseen = ((common & (_BAD - 1)) != 0) | ((union & _BAD) != 0)
    return jnp.where(unseen, CULLED, size)


def group_by_class(classes: Int[Array, " F"]) -> tuple[Int[Array, " F"], Int[Array, " starts"]]:
    """Face ids in class order, ascending within a class, and where each class starts.

    The counts of all drawn classes share one int32, six bits each, so that one scan over runs of
    32 faces ranks all of them at once.
    """
    run, field = 32, 6
    count = classes.shape[0]
    runs = -(-count // run)
    padded = jnp.full(runs * run, CULLED, jnp.int32).at[:count].set(classes).reshape(runs, run)
    drawn = padded < CULLED
    shift = field * jnp.minimum(padded, CULLED - 1)
    one = jnp.where(drawn, 1 << shift, 0)

    def add(total: Array, column: Array) -> tuple[Array, Array]:
        return total + column, total

    # The start is made from the data so that, under `shard_map`, it varies like them.
    totals, before = lax.scan(add, one[:, 0] & 0, one.T)
    mask = (1 << field) - 1
    totals = (totals[None, :] >> (field * jnp.arange(CULLED, dtype=jnp.int32)[:, None])) & mask
    ends = jnp.cumsum(totals.reshape(-1)).reshape(CULLED, runs)
    starts = ends - totals
    start_of_run = starts.reshape(-1)[
        shift // field * runs + jnp.arange(runs, dtype=jnp.int32)[:, None]
    ]
    rank = (before.T >> shift) & mask
    slot = jnp.where(drawn, start_of_run + rank, runs * run).reshape(-1)[:count]
    order = jnp.zeros(count, jnp.int32)
    order = order.at[slot].set(jnp.arange(count, dtype=jnp.int32), mode="drop", unique_indices=True)
    return order, jnp.concatenate([starts[:, 0], ends[-1:, -1]])


def minimum3(corner_values: list[Array]) -> Array:
    """Smallest of three corner values, elementwise."""
    return jnp.minimum(jnp.minimum(corner_values[0], corner_values[1]), corner_values[2])


def maximum3(corner_values: list[Array]) -> Array:
    """Largest of three corner values, elementwise."""
    return jnp.maximum(jnp.maximum(corner_values[0], corner_values[1]), corner_values[2])
