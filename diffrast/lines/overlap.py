"""How much of a pixel a line covers: the exact area of a rectangle in a unit square.

A line of width w from a to b is the rectangle of length |b - a| and width w round it (B: the box
filter). Its area inside a box is the sum over its sides of the area between side and axis, counted
with the side's direction and with heights clamped to the box: the contributions outside cancel.
Each is the integral of a clamped linear function, in closed form.

Near the pixel all numbers are of the size of a pixel. What is left to get right is how far the
pixel lies from the line: hundreds of pixels from the ends that alone are known, a thousandth of a
pixel matters. That distance is computed in twice the working precision, its derivative in one.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from diffrast._compensated import difference_of_products

_REACH = 1.0  # a pixel's farthest point is less than this away from its centre


def coverage(
    start: Float[Array, "n 2"],
    end: Float[Array, "n 2"],
    centre: Float[Array, "n 2"],
    line_width: float,
) -> Float[Array, " n"]:
    """Share of pixels that lines cover; 0 for lines without length.

    Differentiable in `start` and `end`.

    Args:
        start: first ends of the lines, in pixels.
        end: second ends.
        centre: centres of the pixels.
        line_width: in pixels.
    """
    along = end - start
    span = jnp.max(jnp.abs(lax.stop_gradient(along)), axis=1)
    exists = span > 0
    unit = along / jnp.where(exists, span, 1)[:, None]
    size = jnp.sqrt(jnp.where(exists, jnp.sum(unit * unit, axis=1), 1))
    dx, dy = unit[:, 0] / size, unit[:, 1] / size
    beside = _distance(start, end, centre, jnp.where(exists, span * size, 1))
    from_start, to_end = centre - start, end - centre
    # Beyond the pixel it does not matter how far the line goes on.
    reach = _REACH + line_width
    back = jnp.clip(dx * from_start[:, 0] + dy * from_start[:, 1], -reach, reach)
    ahead = jnp.clip(dx * to_end[:, 0] + dy * to_end[:, 1], -reach, reach)
    # Corners, relative to the centre; the line passes at -beside times the normal (-dy, dx).
    t = jnp.stack([-back, ahead, ahead, -back])
    side = np.array([[-1], [-1], [1], [1]], np.float32) * (line_width / 2)
    offset = side.astype(t.dtype) - beside
    x, y = t * dx - offset * dy, t * dy + offset * dx
    # Rightward sides lie below: the sum is the negative of the area.
    area = -jnp.sum(_area_under(x, y, jnp.roll(x, -1, axis=0), jnp.roll(y, -1, axis=0)), axis=0)
    return jnp.where(exists, area, 0)


def _distance(start: Array, end: Array, centre: Array, length: Array) -> Array:
    """Signed distance of points from lines, (end - start) x (centre - start) / length."""

    def cross(a: Array, b: Array) -> Array:
        return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]

    plain = cross(end - start, centre - start)
    a, b, p = lax.stop_gradient((start, end, centre))
    along, lost_along = _exact_difference(b, a)
    away, lost_away = _exact_difference(p, a)
    exact = difference_of_products(along[:, 0], away[:, 1], along[:, 1], away[:, 0])
    exact = exact + (cross(along, lost_away) + cross(lost_along, away))
    return (plain + (exact - lax.stop_gradient(plain))) / length


def _exact_difference(a: Array, b: Array) -> tuple[Array, Array]:
    """The rounded difference and its exact rounding error (Knuth)."""
    total = a - b
    part = total - a
    return total, (a - (total - part)) - (b + part)


def _area_under(x0: Array, y0: Array, x1: Array, y1: Array) -> Array:
    """Integral along a side of its height above the lower border of a unit square round 0."""
    left, right = jnp.clip(x0, -0.5, 0.5), jnp.clip(x1, -0.5, 0.5)
    run, rise = x1 - x0, y1 - y0
    upright = jnp.abs(run) <= jnp.finfo(run.dtype).eps * jnp.abs(rise)
    slope = jnp.where(upright, 0, rise) / jnp.where(upright, 1, run)
    # From the nearer end: an end inside the square is met exactly, and one on its border has half
    # the derivative of either side in both factors.
    low, high = y0 + (left - x0) * slope, y1 + (right - x1) * slope
    return (right - left) * _mean_clamped(low + 0.5, high + 0.5)


def _mean_clamped(a: Array, b: Array) -> Array:
    """Mean of a linear function from a to b, clamped to 0 to 1.

    It is smooth where only one of the two is 0 or 1: there what lies inside has all of the
    derivative. Where both are, it has a kink, and half of it.
    """
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    inner_low = jnp.where(low < 0, 0, jnp.where(low < 1, low, 1))
    inner_high = jnp.where(high <= 0, 0, jnp.where(high <= 1, high, 1))
    middle = (inner_low + inner_high) / 2
    crosses = ((low < 0) & (high > 0)) | ((low < 1) & (high > 1))
    height = jnp.where(crosses, high - low, 1)
    above = jnp.where(high > 1, high - 1, 0)
    partly = ((inner_high - inner_low) * middle + above) / height
    return jnp.where(crosses, partly, middle)
