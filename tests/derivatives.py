"""A check of derivatives in one compiled program, where `check_grads` takes dozens."""

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

    @jax.jit
    def all_of_it(x, direction, weights):
        image, slope = jax.jvp(value, (x,), (direction,))
        return image, slope, jax.vjp(value, x)[1](weights)[0]

    rng = np.random.default_rng(0)
    direction = rng.normal(size=flat.shape)
    weights = rng.normal(size=jax.eval_shape(value, flat).shape)
    _, slope, back = all_of_it(flat, direction, weights)
    ahead, behind = (all_of_it(flat + s * step * direction, direction, weights)[0] for s in (1, -1))
    difference = (ahead - behind) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=rtol, atol=atol)
    scale = np.abs(slope) @ np.abs(weights)
    np.testing.assert_allclose(back @ direction, slope @ weights, atol=1e-12 * scale)
