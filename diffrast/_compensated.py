"""Affine maps in twice the working precision.

A world point a million units from the origin, seen by a camera beside it, loses six of float32's
seven digits when `matrix @ point + offset` cancels. The sums here carry their rounding errors
along (Knuth's two-sum), and the factors are cut in halves whose products are exact, so the result
has the accuracy of its inputs. Because every product that meets a sum is exact, it does not matter
whether a compiler fuses the two.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from diffrast.linalg import apply_matrix


@jax.jit
def affine(
    matrix: Float[Array, "rows 4"],
    remainder: Float[Array, "rows"],
    points: Float[Array, "*batch 3"],
) -> Float[Array, "*batch rows"]:
    """`matrix @ (point, 1) + remainder`, rounded about once; differentiable to any order."""
    return _affine(matrix, remainder, points)


def affine_parts(
    matrix: Float[Array, "rows 4"],
    remainder: Float[Array, "rows"],
    points: Float[Array, "*batch 3"],
) -> tuple[Float[Array, "*batch rows"], Float[Array, "*batch rows"]]:
    """The value of `affine` as an unevaluated sum: the rounded value and what rounding took."""
    matrix_high, matrix_low = _halves(matrix[:, :3])
    points_high, points_low = _halves(points)
    total = jnp.broadcast_to(matrix[:, 3], (*points.shape[:-1], matrix.shape[0]))
    lost = jnp.broadcast_to(remainder, total.shape)
    for axis in range(3):
        high, low = points_high[..., axis, None], points_low[..., axis, None]
        total, error = _two_sum(total, high * matrix_high[:, axis])
        small = high * matrix_low[:, axis] + low * (matrix_high + matrix_low)[:, axis]
        lost = lost + (error + small)
    return _two_sum(total, lost)


@jax.custom_jvp
def _affine(matrix: Array, remainder: Array, points: Array) -> Array:
    return affine_parts(matrix, remainder, points)[0]


@_affine.defjvp
def _affine_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    return _affine(*primals), jax.jvp(_plain_affine, primals, tangents)[1]


def _plain_affine(matrix: Array, remainder: Array, points: Array) -> Array:
    return apply_matrix(matrix[:, :3], points) + (matrix[:, 3] + remainder)


def _two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """The rounded sum and its exact rounding error."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def _halves(values: Array) -> tuple[Array, Array]:
    """Two addends with half the digits each."""
    format_ = jnp.finfo(values.dtype)
    high = jax.lax.reduce_precision(values, format_.nexp, (format_.nmant + 1) // 2 - 1)
    return high, values - high


def difference_of_products(a: Array, b: Array, c: Array, d: Array) -> Array:
    """`a * b - c * d` with an error relative to the result, not to the products."""
    (a_high, a_low), (b_high, b_low) = _halves(a), _halves(b)
    (c_high, c_low), (d_high, d_low) = _halves(c), _halves(d)
    return (
        (a_high * b_high - c_high * d_high)
        + ((a_high * b_low - c_high * d_low) + (a_low * b_high - c_low * d_high))
        + (a_low * b_low - c_low * d_low)
    )
