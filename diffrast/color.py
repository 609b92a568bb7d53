"""Colour: the sRGB transfer functions."""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from diffrast._check import float_array


def srgb_to_linear(encoded: ArrayLike) -> Float[Array, "..."]:
    """Linear light of sRGB values; 0 to 1 goes to 0 to 1, any shape.

    Exact and differentiable for every number: the straight piece near black continues below zero,
    the curve continues above one. FEATURES S6, IEC 61966-2-1.
    """
    encoded = float_array("encoded", encoded, finite=False)
    straight = encoded <= 0.04045
    curved = jnp.where(straight, 1, (encoded + 0.055) / 1.055)
    return jnp.where(straight, encoded / 12.92, curved**2.4)


def linear_to_srgb(linear: ArrayLike) -> Float[Array, "..."]:
    """Encode linear light as sRGB values: the inverse of `srgb_to_linear`."""
    linear = float_array("linear", linear, finite=False)
    straight = linear <= 0.0031308
    curved = jnp.where(straight, 1, linear)
    return jnp.where(straight, 12.92 * linear, 1.055 * curved ** (1 / 2.4) - 0.055)
