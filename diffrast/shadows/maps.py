"""The pictures that a light takes of the scene.

Every texel holds the nearest face and its depth key. Where the keys of the 3×3 texels round one lie
on one smooth surface (their second differences are smaller than half a texel's width), what is near
that surface is in the light and what is far behind it is not, without a look at any face. So each
texel also holds the slopes of the keys, and its key less the largest of those differences, which is
the error of extrapolation from the texel's centre: minus infinity where the surface is not smooth.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._stored import assemble, stored
from diffrast.geometry import Geometry
from diffrast.light import ShiningLight
from diffrast.linalg import apply_matrix
from diffrast.raster.coverage import faces_and_depths
from diffrast.shadows.views import LightView, Seen, is_parallel, matrices, sides, source

_BORDER = 2.0  # texels round what is seen
_SMALLEST = 1e-5  # side of a window, in units of the depth range or of a right angle's tangent
_SMOOTH = 0.5  # texels


class Plan(NamedTuple):
    """Pictures to be taken, of one light or of several, one after another."""

    source: Float[Array, "n 4"]  # the light as a homogeneous point
    origin: Float[Array, "n 3"]
    matrix: Float[Array, "n 4 4"]  # from (offset from the origin, 1) to x, y in texels, w and k
    depth: Float[Array, "n"]  # clip z of k = 1
    limit: Float[Array, "n 2"]  # of a smooth surface's second differences: a + b key
    wanted: Bool[Array, "n"]


class Smooth(NamedTuple):
    """The surface at texels; apart, as arrays are read quickest."""

    floor: Float[Array, "n size size"]  # the lowest key in the light, or minus infinity
    slope_x: Float[Array, "n size size"]  # of the keys, from column to column
    slope_y: Float[Array, "n size size"]  # and from row to row


class Pictures(NamedTuple):
    """What lights see."""

    plan: Plan
    face: Int[Array, "n size size"]
    key: Float[Array, "n size size"]
    smooth: Smooth


def plan(
    light: ShiningLight, view: LightView, seen: Seen, wanted: Bool[Array, "*size"]
) -> tuple[Float[Array, "sides 4"], Plan]:
    """Fit the light's pictures to the wanted points: their windows, and how to take them.

    A window is the scale of x and y to texels, and the offsets.
    """
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
    x, y = (scale[:, i, None] * axis + offset[:, i, None] * w for i, axis in enumerate((x, y)))
    width = _SMOOTH / jnp.min(scale, axis=1)
    none = jnp.zeros_like(width)
    parallel = is_parallel(light)
    return jnp.concatenate([scale, offset], axis=1), Plan(
        source=jnp.broadcast_to(source(light, view), (count, 4)),
        origin=jnp.broadcast_to(view.origin, (count, 3)),
        matrix=jnp.stack([x, y, w, k], axis=1),
        depth=jnp.full_like(width, -1 if parallel else 0),
        limit=jnp.stack((width * jnp.abs(view.depth), none) if parallel else (none, width), axis=1),
        wanted=some,
    )


def take(plans: Plan, geometry: Geometry, size: int) -> Pictures:
    """Take pictures, one after another; unwanted ones stay empty."""

    def draw(plan: Plan) -> tuple[Array, Array, Smooth]:
        def wanted() -> tuple[Array, Array, Smooth]:
            offset = geometry.positions - plan.origin
            x, y, w, k = (apply_matrix(plan.matrix[:, :3], offset) + plan.matrix[:, 3]).T
            half = size / 2
            clip = assemble(stored([x / half - w, w - y / half, plan.depth * k, w]))
            face, key = faces_and_depths(clip, geometry.faces, size=size)
            return face, key, _smooth(key, plan.limit)

        def nothing() -> tuple[Array, Array, Smooth]:
            zero = plan.depth * 0  # varies as the data do
            face = jnp.full((size, size), -1, jnp.int32) + zero.astype(jnp.int32)
            zeros = jnp.zeros((size, size), zero.dtype) + zero
            return face, zeros, Smooth(zeros, zeros, zeros)

        return lax.cond(plan.wanted, wanted, nothing)

    if plans.wanted.shape[0] > 1:
        return Pictures(plans, *lax.map(draw, plans))
    alone = draw(Plan(*(column[0] for column in plans)))
    return Pictures(plans, *jax.tree.map(lambda column: column[None], alone))


def _range(column: Array, some: Array) -> tuple[Array, Array]:
    return jnp.min(jnp.where(some, column, jnp.inf)), jnp.max(jnp.where(some, column, -jnp.inf))


def _smooth(key: Float[Array, "size size"], limit: Float[Array, "2"]) -> Smooth:
    """The surface at each texel; none at the border."""
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
    return stored(Smooth(jnp.where(smooth, key - error, -jnp.inf), *slopes))
