"""Coarser versions of images, for fits that start many pixels off."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from diffrast._check import float_array, is_concrete, positive_int, real_number


def gaussian_blur(
    image: ArrayLike, sigma: ArrayLike, *, radius: int | None = None
) -> Float[Array, "height width *channels"]:
    """Blur an image (height, width) or (height, width, channels) with a Gaussian.

    Near the border the weights that fall outside are left out and the others scaled up, so a
    constant image stays constant. Differentiable in the image and in `sigma`.

    Args:
        image: of any number of channels.
        sigma: standard deviation in pixels. Below 0.1 the image stays as it is.
        radius: pixels to either side that are looked at; by default 4 sigma rounded up. Needed
            where `sigma` is traced.

    Raises:
        ValueError: for an image of another rank or without pixels, or a traced `sigma` without
            `radius`.
    """
    image = _image(image)
    if 0 in image.shape[:2]:
        raise ValueError(f"image: wanted at least one pixel, got shape {image.shape}")
    sigma = real_number("sigma", sigma)
    if radius is None:
        if not is_concrete(sigma):
            raise ValueError("radius: wanted an integer, as sigma is traced; got None")
        # What lies further away than the image is large is outside anyway.
        radius = math.ceil(min(4 * max(float(sigma), 0.0), max(image.shape[:2])))
    radius = positive_int("radius", radius, minimum=0)
    offsets = np.arange(-radius, radius + 1, dtype=sigma.dtype)
    kernel = jnp.exp(-0.5 * (offsets / jnp.maximum(sigma, 0.1)) ** 2).astype(image.dtype)
    return _convolve(_convolve(image, kernel, axis=0), kernel, axis=1)


def _convolve(image: Array, kernel: Array, axis: int) -> Array:
    """Mean along an axis, weighted by the kernel as far as it lies inside the image."""
    lines = jnp.moveaxis(image, axis, -1)
    flat = lines.reshape(-1, 1, lines.shape[-1])
    filtered = functools.partial(
        jax.lax.conv_general_dilated,
        rhs=kernel[None, None],
        window_strides=(1,),
        padding="SAME",
        precision=jax.lax.Precision.HIGHEST,
    )
    mean = filtered(flat) / filtered(jnp.ones_like(flat[:1]))
    return jnp.moveaxis(mean.reshape(lines.shape), -1, axis)


def downsample(image: ArrayLike, factor: int) -> Float[Array, "height width *channels"]:
    """Average blocks of factor × factor pixels of an image (height, width[, channels]).

    Raises:
        ValueError: for an image whose height or width is no multiple of `factor`.
    """
    image, factor = _image(image), positive_int("factor", factor)
    height, width, *channels = image.shape
    if height % factor or width % factor:
        raise ValueError(
            f"factor: wanted a divisor of height {height} and width {width}, got {factor}"
        )
    blocks = image.reshape(height // factor, factor, width // factor, factor, *channels)
    return blocks.mean(axis=(1, 3))


def _image(image: ArrayLike) -> Array:
    array = float_array("image", image, finite=False)
    if array.ndim not in (2, 3):
        raise ValueError(
            f"image: wanted shape (height, width) or (height, width, channels), got {array.shape}"
        )
    return array
