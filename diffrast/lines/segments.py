"""Lines on the screen: what is left of them in view, in pixels, with their depth.

Lines are cut in homogeneous coordinates, where a point behind the eye is as good as another: of
A + t (B - A) the interval of t is kept in which near, far and a guard band round the image hold,
with A the end of smaller coordinates: the other one's digits may be too coarse for the image.
The band, twice as wide as that of triangles (`fixed_point.GUARD_BITS`), leaves lines near the image
whole, and lets what follows count in fixed point. The cuts carry no derivative: a line that is cut
keeps its direction, and its cut ends are where nobody looks.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast.raster.fixed_point import GUARD_BITS, subpixel_bits


class Segments(NamedTuple):
    """Lines on the screen.

    Attributes:
        start: x to the right and y down, in pixels from the image's top left corner.
        end: likewise.
        keys: depth at both ends, larger is nearer, linear along the line on the screen.
        interval: t of both ends, from the line's first point to its second.
        seen: whether anything is left of the line. What is not seen has zeros.
    """

    start: Float[Array, "lines 2"]
    end: Float[Array, "lines 2"]
    keys: Float[Array, "lines 2"]
    interval: Float[Array, "lines 2"]
    seen: Bool[Array, " lines"]


def segments_from_pixels(
    points: Float[Array, "points 2"], lines: Int[Array, "lines 2"], *, height: int, width: int
) -> Segments:
    """Lines in the plane of the image; all of the same depth."""
    ones = jnp.ones_like(points[:, :1])
    homogeneous = jnp.concatenate([points, 0 * ones, ones], axis=1)
    return _cut(homogeneous, jnp.zeros_like(points[:, 0]), lines, height, width)


def segments_from_clip(
    positions_clip: Float[Array, "points 4"],
    lines: Int[Array, "lines 2"],
    *,
    height: int,
    width: int,
) -> Segments:
    """Lines in space, as a camera sees them."""
    x, y, z, w = (positions_clip[:, i] for i in range(4))
    in_pixels = jnp.stack([(x + w) * (width / 2), (w - y) * (height / 2), z, w], axis=1)
    return _cut(in_pixels, depth_rank(positions_clip), lines, height, width)


def depth_rank(positions_clip: Float[Array, "points 4"]) -> Float[Array, " points"]:
    """Numerators of the depth keys: rank / w is larger nearer to the eye.

    The key is 1/w, which keeps its precision whatever near and far are; a parallel projection has
    the same w everywhere, and its key is -z/w. As triangles have it (`raster.fixed_point`).
    """
    z, w = lax.stop_gradient((positions_clip[:, 2], positions_clip[:, 3]))
    parallel = jnp.all(w == w[0]) & (w[0] > 0)
    return jnp.where(parallel, -z, jnp.ones_like(w))


def _cut(points: Array, rank: Array, lines: Array, height: int, width: int) -> Segments:
    size = jnp.max(jnp.abs(lax.stop_gradient(points)), axis=1)
    swap = (size[lines[:, 0]] > size[lines[:, 1]])[:, None]
    lines = jnp.where(swap, lines[:, ::-1], lines)
    first, second = points[lines[:, 0]], points[lines[:, 1]]
    finite = jnp.all(jnp.isfinite(first) & jnp.isfinite(second), axis=1)
    first, second = (jnp.where(finite[:, None], p, 0) for p in (first, second))
    low, high = _interval(*lax.stop_gradient((first, second)), height, width)
    seen = finite & (low <= high)
    ends, keys = [], []
    ranks = [jnp.where(finite, rank[lines[:, k]], 0) for k in range(2)]
    for t in (low, high):
        # Uncut ends are the points themselves, to the bit.
        inside = (t > 0) & (t < 1)
        between = first + jnp.where(inside, t, 0)[:, None] * (second - first)
        point = jnp.where((t >= 1)[:, None], second, between)
        seen = seen & (point[:, 3] > 0)
        inverse = 1 / jnp.where(seen, point[:, 3], 1)
        ends.append(point[:, :2] * inverse[:, None])
        numerator = jnp.where(
            t >= 1, ranks[1], ranks[0] + jnp.where(inside, t, 0) * (ranks[1] - ranks[0])
        )
        keys.append(lax.stop_gradient(numerator * inverse))
    start, end, both = (jnp.where(seen[:, None], p, 0) for p in (*ends, jnp.stack(keys, axis=1)))
    interval = jnp.stack([low, high], axis=1)
    return Segments(
        jnp.where(swap, end, start),
        jnp.where(swap, start, end),
        jnp.where(swap, both[:, ::-1], both),
        jnp.where(swap, 1 - interval[:, ::-1], interval),
        seen,
    )


def _interval(first: Array, second: Array, height: int, width: int) -> tuple[Array, Array]:
    """Bounds of t between near and far and inside the guard band; empty if the first is larger."""
    guard = float(2 << (GUARD_BITS - subpixel_bits(height, width))) - 1
    low, high = jnp.zeros_like(first[:, 0]), jnp.ones_like(first[:, 0])

    def distances(p: Array) -> list[Array]:
        x, y, z, w = (p[:, i] for i in range(4))
        x, y = x - (width / 2) * w, y - (height / 2) * w
        return [w, w + z, w - z, guard * w - x, guard * w + x, guard * w - y, guard * w + y]

    for at_first, at_second in zip(distances(first), distances(second), strict=True):
        change = at_second - at_first
        crossing = -at_first / jnp.where(change != 0, change, 1)
        low = jnp.where((at_first < 0) & (change > 0), jnp.maximum(low, crossing), low)
        high = jnp.where((at_second < 0) & (change < 0), jnp.minimum(high, crossing), high)
        outside = (at_first < 0) & (at_second < 0)
        high = jnp.where(outside, -1, high)
    return low, high
