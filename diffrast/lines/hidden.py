"""What hides a line: the depth of the surface at each pixel, and how sure it is.

At each step along a line the pixel that it passes is looked at. The surface at the pixel's centre
is not the surface where the line passes: that lies up to half a pixel across, and at a line's ends
as much along. So a line on a surface is as near as the surface give or take what the surface's
depth changes over that distance: only what is farther behind is hidden. There is no bias to set,
and no scale.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast.lines.segments import depth_rank
from diffrast.raster import Fragments
from diffrast.raster.evaluate import corners_at

_ROUNDINGS = 16  # of a depth key, relative to it


class Surface(NamedTuple):
    """Depth of what triangles show, for every pixel, row after row.

    Attributes:
        key: as lines have it; -inf where there is nothing.
        slopes: how much the key changes over a pixel to the side, and over one downwards.
    """

    key: Float[Array, " pixels"]
    slopes: tuple[Float[Array, " pixels"], Float[Array, " pixels"]]


def from_middle(
    height: int, width: int, dtype: jnp.dtype
) -> tuple[Float[Array, " width"], Float[Array, "height 1"]]:
    """Where the centres of pixels lie from the picture's middle, to the right and upwards."""
    right = jnp.arange(width).astype(dtype) + (1 - width) / 2
    return right, ((height - 1) / 2 - jnp.arange(height).astype(dtype))[:, None]


@jax.jit
def surface_of(
    positions_clip: Float[Array, "points 4"],
    faces: Int[Array, "faces 3"],
    fragments: Fragments,
) -> Surface:
    """The surface that the triangles' fragments show. No derivative.

    With X_i = x_i - px w_i and Y_i = y_i - py w_i in pixels, the edge function e_0 = X_1 Y_2 - X_2
    Y_1, and so on in turn, the key is sum(e_i rank_i) / sum(e_i w_i). The denominator is the same
    at all pixels, so the key is linear on the screen, for every sign of w.
    """
    positions_clip, fragments = lax.stop_gradient((positions_clip, fragments))
    height, width = fragments.face.shape
    # In units of the largest coordinate, so that products stay in range; the key is the same.
    unit = jnp.max(jnp.abs(jnp.where(jnp.isfinite(positions_clip), positions_clip, 0)))
    unit = jnp.where(unit > 0, unit, 1)
    rank, positions_clip = depth_rank(positions_clip) / unit, positions_clip / unit
    corners = corners_at(faces, fragments.face)
    x_pixel, y_pixel = from_middle(height, width, positions_clip.dtype)
    ranks, weights, x, y = [], [], [], []
    for corner in corners:
        w = positions_clip[corner, 3]
        x.append(positions_clip[corner, 0] * (width / 2) - x_pixel * w)
        y.append(positions_clip[corner, 1] * (height / 2) - y_pixel * w)
        weights.append(w)
        ranks.append(rank[corner])
    share = [fragments.barycentrics[..., k] for k in range(3)]
    depth = sum(b * w for b, w in zip(share, weights, strict=True))
    covered = (fragments.face >= 0) & (depth != 0)
    numerator = sum(b * r for b, r in zip(share, ranks, strict=True))
    key = jnp.where(covered, numerator, 0) / jnp.where(covered, depth, 1)
    determinant = jnp.zeros_like(key)
    change = [jnp.zeros_like(key)] * 2
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        determinant = determinant + (x[i] * y[j] - x[j] * y[i]) * weights[k]
        change[0] = change[0] + (weights[j] * y[i] - weights[i] * y[j]) * ranks[k]
        change[1] = change[1] + (weights[i] * x[j] - weights[j] * x[i]) * ranks[k]
    solid = covered & (determinant != 0)
    inverse = jnp.where(solid, 1, 0) / jnp.where(solid, determinant, 1)
    sideways, downwards = (jnp.abs(part * inverse).reshape(-1) for part in change)
    return Surface(jnp.where(covered, key, -jnp.inf).reshape(-1), (sideways, downwards))


def hides(
    surface: Surface,
    place: Int[Array, " n"],
    key: Float[Array, " n"],
    steep: Bool[Array, " n"],
    beyond: Float[Array, " n"],
) -> Bool[Array, " n"]:
    """Whether the surface lies before points of lines.

    Args:
        surface: what may hide them.
        place: pixels that the lines pass.
        key: depth of the lines.
        steep: whether a line goes down rather than to the side.
        beyond: by how much, in pixels along the line, the pixel's centre lies beyond its ends.
    """
    here, sideways, downwards = (column[place] for column in (surface.key, *surface.slopes))
    across = jnp.where(steep, sideways, downwards)
    along = jnp.where(steep, downwards, sideways)
    covered = here > -jnp.inf
    here = jnp.where(covered, here, 0)
    rounding = _ROUNDINGS * jnp.finfo(key.dtype).eps * jnp.abs(here)
    return covered & (key < here - (across / 2 + along * beyond + rounding))
