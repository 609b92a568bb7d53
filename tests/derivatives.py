"""A check of derivatives in three small compiled programs, where `check_grads` takes dozens."""

import jax
import numpy as np
from jax.flatten_util import ravel_pytree


def check_derivatives(function, *arguments, step=1e-5, rtol=1e-6, atol=1e-6):
    """Forward mode against central differences and reverse mode against forward mode.

    Along one random direction in the space of all arguments. Call it under `jax.enable_x64`.
    """
    flat, unravel = ravel_pytree(arguments)

    def value(x):
        return ravel_pytree(function(*unravel(x)))[0]

    def forward(x, direction):
        return jax.jvp(value, (x,), (direction,))[1]

    def reverse(x, weights):
        return jax.vjp(value, x)[1](weights)[0]

    rng = np.random.default_rng(0)
    direction = rng.normal(size=flat.shape)
    compiled = jax.jit(value)
    difference = (compiled(flat + step * direction) - compiled(flat - step * direction)) / (
        2 * step
    )
    slope = jax.jit(forward)(flat, direction)
    np.testing.assert_allclose(slope, difference, rtol=rtol, atol=atol)
    weights = rng.normal(size=slope.shape)
    back = jax.jit(reverse)(flat, weights) @ direction
    scale = np.abs(slope) @ np.abs(weights)
    np.testing.assert_allclose(back, slope @ weights, atol=1e-12 * scale)
