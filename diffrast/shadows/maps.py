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

from diffrast._stored import assemble, stored, stored_rows
from diffrast.geometry import Geometry
from diffrast.light import ShiningLight
from diffrast.linalg import apply_matrix
from diffrast.raster.coverage import faces_and_depths
from diffrast.shadows.views import LightView, Seen, is_parallel, matrices, sides

_BORDER = 2.0  # texels round what is seen
_SMALLEST = 1e-5  # side of a window, in units of the depth range or of a right angle's tangent
_SMOOTH = 0.5  # texels


class ShadowMap(NamedTuple):
    """What a light sees."""

    view: LightView
    window: Float[Array, "sides 4"]  # scale of x and y to texels, and their offsets
    face: Int[Array, "sides size size"]
    texel: Float[Array, "sides size size 4"]  # key, its slopes along columns and rows, their error


class Picture(NamedTuple):
    """One picture to be taken, or several along the first axis."""

    origin: Float[Array, "*n 3"]
    clip: Float[Array, "*n 4 4"]  # from (offset from the origin, 1)
    limit: Float[Array, "*n 2"]  # of a smooth surface's second differences: a + b key
    wanted: Bool[Array, "*n"]


def plan(
    light: ShiningLight, view: LightView, seen: Seen, wanted: Bool[Array, "*size"]
) -> tuple[Float[Array, "sides 4"], Picture]:
    """Fit the light's pictures to the wanted points: their windows, and how to take them."""
    assert light.shadow is not None
    size, count = light.shadow.resolution, sides(light)
    here = [wanted & (seen.side == side) if count > 1 else wanted for side in range(count)]
    ranges = [[_range(column, some) for column in (seen.x, seen.y)] for some in here]
    low, high = jnp.moveaxis(jnp.array(ranges), 2, 0)  # (sides, 2) each
    some = low[:, 0] <= high[:, 0]
    low, high = (jnp.where(some[:, None], end, 0) for end in (low, high))
    smallest = _SMALLEST / (jnp.abs(view.depth) if is_parallel(light) else 1)
    scale = (size - 2 * _BORDER) / jnp.maximum(high - low, smallest)
    offset = size / 2 - scale * (low + high) / 2

    x, y, w, k = jnp.moveaxis(matrices(light, view), 1, 0)
    half = size / 2
    rows = [
        (scale[:, :1] * x + offset[:, :1] * w) / half - w,
        w - (scale[:, 1:] * y + offset[:, 1:] * w) / half,
        -k if is_parallel(light) else jnp.zeros_like(k),
        w,
    ]
    width = _SMOOTH / jnp.min(scale, axis=1)
    zero = jnp.zeros_like(width)
    limit = (width * jnp.abs(view.depth), zero) if is_parallel(light) else (zero, width)
    picture = Picture(
        jnp.broadcast_to(view.origin, (count, 3)),
        jnp.stack(rows, axis=1),
        jnp.stack(limit, axis=1),
        some,
    )
    return jnp.concatenate([scale, offset], axis=1), picture


def take(
    pictures: Picture, geometry: Geometry, size: int
) -> tuple[Int[Array, "n size size"], Float[Array, "n size size 4"]]:
    """Faces and texels of pictures, one after another; of unwanted ones nothing."""

    def draw(picture: Picture) -> tuple[Array, Array]:
        def wanted() -> tuple[Array, Array]:
            offset = geometry.positions - picture.origin
            clip = stored_rows(apply_matrix(picture.clip[:, :3], offset) + picture.clip[:, 3])
            face, key = faces_and_depths(clip, geometry.faces, size=size)
            return face, _texels(key, picture.limit)

        def nothing() -> tuple[Array, Array]:
            zero = picture.origin[0] * 0  # varies as the data do
            face = jnp.full((size, size), -1, jnp.int32) + zero.astype(jnp.int32)
            return face, jnp.zeros((size, size, 4), zero.dtype) + zero

        return lax.cond(picture.wanted, wanted, nothing)

    if pictures.wanted.shape[0] > 1:
        return lax.map(draw, pictures)
    face, texel = draw(Picture(*(column[0] for column in pictures)))
    return face[None], texel[None]


def _range(column: Array, some: Array) -> tuple[Array, Array]:
    return jnp.min(jnp.where(some, column, jnp.inf)), jnp.max(jnp.where(some, column, -jnp.inf))


def _texels(key: Float[Array, "size size"], limit: Float[Array, "2"]) -> Array:
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
    smooth = error <= limit[0] + limit[1] * key  # NaN, and not smooth, where there is nothing
    slopes = [jnp.where(smooth, (a - b) / 2, 0) for a, b in pairs[:2]]
    return assemble(stored([key, *slopes, jnp.where(smooth, error, jnp.inf)]))
