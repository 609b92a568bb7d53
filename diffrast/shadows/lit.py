"""Which points a light sees.

Most points are told by one texel of the light's picture (see `maps`). The others, at the outlines
of shadows and where the picture is too coarse for the surface, are collected and looked at one by
one: the faces at the 3×3 texels round such a point, and those to which walks over the surface lead
from them towards the point, are cut with its ray to the light. So outlines are exact at any
resolution, also where faces at the rim are thinner than a texel, but for surfaces of which none of
the nine texels shows anything.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._selection import over_batches, prefix_sum, selected
from diffrast._stored import stored
from diffrast.edges.planes import cross_rows
from diffrast.geometry import Geometry
from diffrast.light import dot_columns
from diffrast.shadows.maps import Pictures
from diffrast.shadows.near import (
    ROUNDINGS,
    Line,
    Nearby,
    Rays,
    Texel,
    cut_by,
    face_corners,
    faces_near,
    texel_of,
)

_AT_ONCE = 1024
_WAYS_AT_ONCE = 256
_STEPS = 64  # from face to face
_SMALL = 4.0  # square texels, twice the area of a face


class _Ways(NamedTuple):
    """Ways over the surface."""

    face: Int[Array, " n"]
    turn: Float[Array, " n"]  # of the face before
    goes: Bool[Array, " n"]
    stops: Bool[Array, " n"]  # whether a face at the end stops the ray
    lost: Bool[Array, " n"]  # at the border of the surface


def lit(
    pictures: Pictures, geometry: Geometry, neighbors: Int[Array, "F 3"], rays: Rays
) -> Float[Array, " n"]:
    """1 where a light sees points that are asked for, 0 elsewhere. Not differentiable."""
    texel = texel_of(pictures, rays)
    key, slope_x, slope_y, error = _at_texels(pictures.texel, rays.picture, texel).T
    depth = key + slope_x * texel.x + slope_y * texel.y
    rounding = ROUNDINGS * jnp.finfo(key.dtype).eps * rays.unit
    bright = rays.asked & (rays.key >= depth - error - rounding)
    order, count = selected(rays.asked & jnp.isinf(error))

    def look_closer(chosen: Array, exists: Array, bright: Array) -> Array:
        some = stored(Rays(*(column[..., chosen] for column in rays)))
        place = jnp.where(exists, chosen, bright.size)
        return bright.at[place].set(~_blocked(pictures, geometry, neighbors, some), mode="drop")

    return over_batches(order, count, _AT_ONCE, look_closer, bright).astype(key.dtype)


def _at_texels(values: Array, picture: Array, texel: Texel) -> Array:
    """Entries of an array (pictures, size, size, ...)."""
    size = values.shape[1]
    number = (picture * size + texel.row) * size + texel.column
    return values.reshape(-1, *values.shape[3:])[stored(number)]


def _blocked(
    pictures: Pictures, geometry: Geometry, neighbors: Int[Array, "F 3"], rays: Rays
) -> Bool[Array, " n"]:
    """Whether faces near the rays from points to the light stop them."""
    nearby = faces_near(pictures, geometry, rays)
    texel, nine = texel_of(pictures, rays), jnp.arange(9)[:, None]
    slopes, _ = _slopes(pictures, rays, nearby.own)
    along_row = slopes[0] * (texel.x - (nine % 3 - 1))
    along_column = slopes[1] * (texel.y - (nine // 3 - 1))
    before = stored((nearby.key - rays.key) + along_row + along_column)
    hidden, unknown = _walk(geometry, neighbors, rays.face, nearby, before > 0)
    return hidden | (unknown & _hidden_by_small(pictures, rays, nearby, slopes, before[4]))


def _walk(
    geometry: Geometry,
    neighbors: Int[Array, "F 3"],
    own: Int[Array, " n"],
    nearby: Nearby,
    before: Bool[Array, "9 n"],
) -> tuple[Bool[Array, " n"], Bool[Array, " n"]]:
    """Whether the faces near rays, or those to which ways over the surface lead, stop them.

    Ways go from what the texels show before the plane of the ray's own face, each time across the
    edge beyond which the ray lies farthest; they end where the surface does, or turns away. Also
    returns whether the way from the nearest texel came to the surface's border, or to no end: then
    one cannot know what is beyond.
    """
    n = own.size
    hidden = jnp.any(nearby.cut.stops > 0, axis=0)
    ahead = jnp.where(nearby.face >= 0, _across(neighbors, nearby.face, nearby.cut.corner), -1)
    unknown = (nearby.face[4] >= 0) & (nearby.cut.corner[4] < 3) & (ahead[4] < 0)
    goes = before & (ahead >= 0) & (ahead != own) & ~hidden & (nearby.cut.turn != 0)
    nine = jnp.arange(9)[:, None]
    rank = jnp.where(nine == 4, -1, nine)
    told = before | (nearby.cut.corner == 3)
    for i in range(9):
        again = (ahead == nearby.face[i]) & told[i]
        again = again | ((ahead == ahead[i]) & before[i] & (rank > rank[i]))
        goes = goes & ~(again & (nine != 4))
    number = stored(prefix_sum(jnp.ravel(goes).astype(jnp.int32)))
    ahead, turn = stored((jnp.ravel(ahead), jnp.ravel(nearby.cut.turn)))

    def walk(slot: Array, exists: Array, known: tuple[Array, Array]) -> tuple[Array, Array]:
        way = stored(jnp.searchsorted(number, slot + 1, method="scan_unrolled"))
        way = jnp.minimum(way, 9 * n - 1)
        ray = stored(way % n)
        line = stored(Line(*(column[..., ray] for column in nearby.line)))
        end = own[ray]

        def step(state: tuple[Array, _Ways]) -> tuple[Array, _Ways]:
            steps, ways = state
            cut = cut_by(line, face_corners(geometry, ways.face))
            on = ways.goes & (cut.turn * ways.turn > 0)
            stops = on & (cut.corner == 3) & (cut.stops > 0)
            on = on & (cut.corner < 3)
            ahead = _across(neighbors, ways.face, cut.corner)
            lost = ways.lost | (on & (ahead < 0))
            on = on & (ahead >= 0) & (ahead != end)
            return steps + 1, stored(_Ways(ahead, cut.turn, on, ways.stops | stops, lost))

        def is_on_the_way(state: tuple[Array, _Ways]) -> Array:
            return (state[0] < _STEPS) & jnp.any(state[1].goes)

        start = _Ways(ahead[way], turn[way], exists, exists & False, exists & False)
        _, ways = lax.while_loop(is_on_the_way, step, (jnp.sum(way) & 0, stored(start)))
        hidden, unknown = known
        lost = (ways.lost | ways.goes) & (way // n == 4)
        return hidden.at[ray].max(ways.stops), unknown.at[ray].max(lost)

    slots = jnp.arange(-(-9 * n // _WAYS_AT_ONCE) * _WAYS_AT_ONCE, dtype=jnp.int32)
    return over_batches(slots, number[-1], _WAYS_AT_ONCE, walk, (hidden, unknown))


def _across(
    neighbors: Int[Array, "F 3"], face: Int[Array, "*n"], corner: Int[Array, "*n"]
) -> Array:
    """The face across the edge opposite to a corner; -1 where there is none."""
    beside = stored(neighbors[jnp.maximum(face, 0), jnp.minimum(corner, 2)])
    return jnp.where(corner < 3, beside, -1)


def _hidden_by_small(
    pictures: Pictures,
    rays: Rays,
    nearby: Nearby,
    own_slopes: list[Array],
    before: Float[Array, " n"],
) -> Bool[Array, " n"]:
    """Whether points lie behind the nearest texel, of faces too small for a texel each.

    What is compared are the planes of the point's own face and of the nearest texel's, with a
    margin for surfaces that curve from one to the other.
    """
    slopes, area = _slopes(pictures, rays, nearby.corners[:, :, 4])
    texel = texel_of(pictures, rays)
    margin = jnp.abs((slopes[0] - own_slopes[0]) * texel.x)
    margin = margin + jnp.abs((slopes[1] - own_slopes[1]) * texel.y)
    margin = margin + ROUNDINGS * jnp.finfo(margin.dtype).eps * rays.unit
    face = nearby.face[4]
    shown = jnp.any(nearby.face == rays.face, axis=0)
    hidden = (face >= 0) & (face != rays.face) & (before > margin)
    return hidden & ((area < _SMALL) | ~shown)


def _slopes(pictures: Pictures, rays: Rays, corners: Array) -> tuple[list[Array], Array]:
    """How the depth key changes from texel to texel on faces, and twice their area in texels.

    The area is infinite where a face reaches behind the light.
    """
    matrix = jnp.moveaxis(pictures.plan.matrix[rays.picture], 0, 2)  # (4, 4, n)
    offset = corners - pictures.plan.origin[rays.picture].T[:, None]
    x, y, w, k = (
        row[0] * offset[0] + row[1] * offset[1] + row[2] * offset[2] + row[3] for row in matrix
    )
    x, y = x - rays.x * w, y - rays.y * w
    rows = jnp.stack([x, y, w, k])
    first, one, other = rows[:, 0], rows[:, 1] - rows[:, 0], rows[:, 2] - rows[:, 0]

    def determinant(*columns: int) -> Array:
        a, b, c = (row[jnp.array(columns)] for row in (first, one, other))
        return dot_columns(a, cross_rows(b, c))

    volume = determinant(0, 1, 2)
    inverse = jnp.where(volume == 0, 0, 1) / jnp.where(volume == 0, 1, volume)
    slopes = [determinant(3, 1, 2) * inverse, determinant(0, 3, 2) * inverse]
    before = jnp.all(w > 0, axis=0)
    x, y = (column / jnp.where(before, w, 1) for column in (x, y))
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    return slopes, jnp.where(before, jnp.abs(area), jnp.inf)
