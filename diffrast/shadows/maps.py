"""The pictures that a light takes of the scene.

Every texel holds the nearest face and its depth key. Where the keys of the 3×3 texels round one lie
on one smooth surface (their second differences are smaller than half a texel's width), what is near
that surface is in the light and what is behind it is not, without a look at any face. So each texel
also holds the slope of the keys and the largest of those differences: the error of extrapolation
from the texel's centre, infinite where the surface is not smooth.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._stored import assemble, stored
from diffrast.geometry import Geometry
from diffrast.light import ShiningLight
from diffrast.raster.coverage import faces_and_depths
from diffrast.shadows.views import LightView, Seen, homogeneous, is_parallel, sides

_BORDER = 2.0  # texels round what is seen
_SMALLEST = 1e-5  # side of a window, in units of the depth range or of a right angle's tangent
_SMOOTH = 0.5  # texels


class ShadowMap(NamedTuple):
    """What a light sees, of all its pictures one after another."""

    view: LightView
    window: Float[Array, "4 sides"]  # scale of x and y to texels, and their offsets
    face: Int[Array, "sides size size"]
    texel: Float[Array, "sides size size 4"]  # key, its slopes along columns and rows, their error


def draw_map(
    light: ShiningLight,
    view: LightView,
    geometry: Geometry,
    seen: Seen,
    wanted: Bool[Array, "*size"],
) -> ShadowMap:
    """Draw what the light sees of the part of the scene that holds the wanted points."""
    assert light.shadow is not None
    size = light.shadow.resolution

    def draw(side: Array) -> tuple[Array, Array, Array]:
        here = wanted & (seen.side == side)
        window = _fitted(light, view, seen, here, size)

        def picture() -> tuple[Array, Array]:
            columns = [geometry.positions[:, i] for i in range(3)]
            x, y, w, k = homogeneous(light, view, side, columns)
            x = 2 * (window[0] * x + window[2] * w) / size - w
            y = w - 2 * (window[1] * y + window[3] * w) / size
            z = -k if is_parallel(light) else jnp.zeros_like(k)
            clip = assemble(stored([x, y, z, w]))
            face, key = faces_and_depths(clip, geometry.faces, size=size)
            return face, _texels(light, view, key, window)

        def nothing() -> tuple[Array, Array]:
            zero = window[0] * 0  # varies as the data do
            face = jnp.full((size, size), -1, jnp.int32) + zero.astype(jnp.int32)
            return face, jnp.zeros((size, size, 4), zero.dtype) + zero

        return window, *lax.cond(jnp.any(here), picture, nothing)

    if sides(light) == 1:
        window, face, texel = (part[None] for part in draw(jnp.zeros((), jnp.int32)))
    else:
        window, face, texel = lax.map(draw, jnp.arange(sides(light)))
    return ShadowMap(view, window.T, face, texel)


def _fitted(light: ShiningLight, view: LightView, seen: Seen, here: Array, size: int) -> Array:
    """Scales and offsets that bring the points into the picture; the first centre is at 0.5."""
    smallest = jnp.asarray(_SMALLEST, seen.x.dtype)
    if is_parallel(light):
        smallest = smallest / jnp.abs(view.depth)
    scales, offsets = [], []
    for column in (seen.x, seen.y):
        low = jnp.min(jnp.where(here, column, jnp.inf))
        high = jnp.max(jnp.where(here, column, -jnp.inf))
        some = low <= high
        low, high = jnp.where(some, low, -smallest), jnp.where(some, high, smallest)
        span = jnp.maximum(high - low, smallest)
        scale = (size - 2 * _BORDER) / span
        scales.append(scale)
        offsets.append(size / 2 - scale * (low + high) / 2)
    return jnp.stack([*scales, *offsets])


def _texels(light: ShiningLight, view: LightView, key: Array, window: Array) -> Array:
    """Key, slopes and error at each texel; the error is infinite at the border."""
    size = key.shape[0]
    around = jnp.pad(key, 1, constant_values=-jnp.inf)

    def at(row: int, column: int) -> Array:
        return around[1 + row : 1 + row + size, 1 + column : 1 + column + size]

    right, left, below, above = at(0, 1), at(0, -1), at(1, 0), at(-1, 0)
    pairs = [(right, left), (below, above), (at(1, 1), at(-1, -1)), (at(1, -1), at(-1, 1))]
    error = jnp.zeros_like(key)
    for one, other in pairs:
        error = jnp.maximum(error, jnp.abs((one - key) + (other - key)))
    width = 1 / jnp.minimum(window[0], window[1])
    limit = _SMOOTH * width * (jnp.abs(view.depth) if is_parallel(light) else key)
    smooth = (error <= limit) & jnp.isfinite(key)  # NaN where there is nothing
    slopes = [jnp.where(smooth, (a - b) / 2, 0) for a, b in pairs[:2]]
    return assemble(stored([key, *slopes, jnp.where(smooth, error, jnp.inf)]))
