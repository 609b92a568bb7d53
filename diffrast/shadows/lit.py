"""Which points a light sees.

Most points are told by one texel of the light's picture (see `maps`). The others, at the outlines
of shadows and where the picture is too coarse for the surface, are collected and looked at one by
one. If one of the 3×3 texels round such a point shows anything before the plane of the point's
face, its ray to the light is cut with the faces there, and with those to which ways over the
surface lead from them towards the ray. So outlines are exact at any resolution, also where faces at
the rim are thinner than a texel, but for surfaces of which none of the nine texels shows anything.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._device import lanes
from diffrast._selection import compacted, divided, over_batches, selected, work_off
from diffrast._stored import stored
from diffrast.edges.planes import cross_rows
from diffrast.geometry import Geometry
from diffrast.light import dot_columns
from diffrast.shadows.maps import Pictures
from diffrast.shadows.near import (
    ROUNDINGS,
    Line,
    Rays,
    Texel,
    at_texels,
    cut_by,
    face_corners,
    line_of,
    number_of,
    texel_of,
    texels_round,
)

T = TypeVar("T")

_AT_ONCE = 4096
_WAYS_AT_ONCE = 256
_STEPS = 64  # from face to face
_LOST, _HIDDEN = 1, 2  # fates
_SMALL = 4.0  # square texels, twice the area of a face
_CLOSE = 8.0  # behind a smooth surface by less than so many half texels: what is steep between them


class _Sight(NamedTuple):
    """What is known of rays from the nine texels round each."""

    line: Line
    faces: Int[Array, "9 n"]  # that these show
    slopes: Float[Array, "2 n"]  # of the keys on the faces on which they begin
    before: Float[Array, "9 n"]  # by how much the nine texels show more than the faces' planes


class _Way(NamedTuple):
    """Ways over the surface."""

    ray: Int[Array, " n"]
    face: Int[Array, " n"]
    turn: Float[Array, " n"]  # of the face before; 0 at first
    steps: Int[Array, " n"]
    central: Bool[Array, " n"]  # whether they come from the nearest texel


@jax.jit
def lit(
    pictures: Pictures, geometry: Geometry, neighbors: Int[Array, "F 3"], rays: Rays
) -> Float[Array, " n"]:
    """1 where a light sees points that are asked for, 0 elsewhere. Not differentiable."""
    texel = texel_of(pictures, rays)
    floor, slope_x, slope_y = _smooth_at(pictures, rays.picture, texel)
    behind = (floor + slope_x * texel.x + slope_y * texel.y) - rays.key
    constant, per_key = jnp.max(pictures.plan.limit, axis=0)
    close = rays.asked & (behind < _CLOSE * (constant + per_key * rays.key))
    smooth = (behind <= _rounding(rays)) & ~jnp.isinf(floor)
    order, count = selected(close & ~smooth)
    few = 512 * -(-rays.x.size // 4096)  # of few, as edges have
    at_once = min(lanes() * min(_AT_ONCE, few), rays.x.size)

    def look_closer(chosen: Array, exists: Array, bright: Array) -> Array:
        some = _entries(rays, chosen)
        sight = stored(_sight(pictures, geometry, some))
        doubt = exists & jnp.any(sight.before > 0, axis=0)
        hidden = _hidden(pictures, geometry, neighbors, some, sight, doubt)
        return bright.at[jnp.where(hidden, chosen, bright.size)].set(False, mode="drop")

    return over_batches(order, count, at_once, look_closer, close).astype(floor.dtype)


def _entries(columns: T, chosen: Int[Array, " n"]) -> T:
    """Some entries of arrays, along their last axis."""
    return stored(jax.tree.map(lambda column: column[..., chosen], columns))


def _smooth_at(pictures: Pictures, picture: Array, texel: Texel) -> list[Array]:
    number = number_of(pictures, picture, texel.row, texel.column)
    return [at_texels(values, number) for values in pictures.smooth]


def _rounding(rays: Rays) -> Array:
    return ROUNDINGS * jnp.finfo(rays.unit.dtype).eps * rays.unit


def _sight(pictures: Pictures, geometry: Geometry, rays: Rays) -> _Sight:
    own = face_corners(geometry, rays.face)
    texel, nine = texel_of(pictures, rays), jnp.arange(9)[:, None]
    texels = texels_round(pictures, rays, texel)
    key = at_texels(pictures.key, texels)
    slopes, _ = _slopes(pictures, rays, own)
    along_row = slopes[0] * (texel.x - (nine % 3 - 1).astype(texel.x.dtype))
    along_column = slopes[1] * (texel.y - (nine // 3 - 1).astype(texel.y.dtype))
    before = (key - rays.key) + along_row + along_column - _rounding(rays)
    faces = at_texels(pictures.face, texels)
    return _Sight(line_of(pictures, rays, own), faces, jnp.stack(slopes), before)


def _hidden(
    pictures: Pictures,
    geometry: Geometry,
    neighbors: Int[Array, "F 3"],
    rays: Rays,
    sight: _Sight,
    doubt: Bool[Array, " n"],
) -> Bool[Array, " n"]:
    """Which of the doubtful rays are stopped by faces near them.

    Ways over the surface begin at the face that the nearest texel shows, then, for rays that are
    not stopped yet, at those that the others show before the plane of the ray's own face. They lead
    each time across the edge beyond which the ray lies farthest, and end at a face that it passes,
    where the surface ends, or where it turns away. Of a ray that is lost, at the surface's border
    or on an endless way from the nearest texel, one cannot know what is beyond.
    """
    count, nine = doubt.size, jnp.arange(9)[:, None]
    at_once = lanes() * _WAYS_AT_ONCE

    def begin(way: Array) -> _Way:
        face = sight.faces.reshape(-1)[way]
        zero = jnp.zeros_like(way)
        texel, ray = divided(way, count)
        return _Way(ray, face, zero.astype(rays.key.dtype), zero, texel == 4)

    def walk(way: _Way, goes: Array, fate: Array) -> tuple[_Way, Array, Array]:
        own = rays.face[way.ray]
        passed = cut_by(_entries(sight.line, way.ray), face_corners(geometry, way.face))
        same = jnp.where(way.steps > 0, passed.turn * way.turn > 0, passed.turn != 0)
        on = goes & same & (way.face != own) & (way.face >= 0)
        stops = on & (passed.corner == 3) & (passed.stops > 0)
        on = on & (passed.corner < 3)
        ahead = _across(neighbors, way.face, passed.corner)
        lost = on & way.central & ((ahead < 0) | (way.steps == _STEPS))
        on = on & (ahead >= 0) & (way.steps < _STEPS)
        fate = fate.at[way.ray].max(jnp.where(stops, _HIDDEN, jnp.where(lost, _LOST, 0)))
        return _Way(way.ray, ahead, passed.turn, way.steps + 1, way.central), on, fate

    def follow(turn: Array, fate: Array) -> Array:
        others = (nine != 4) & (sight.before > 0) & (fate < _HIDDEN)
        ways, size = selected(doubt & jnp.where(turn == 0, nine == 4, others))
        return work_off(size, at_once, lambda slot: begin(ways[slot]), walk, fate)

    fate = lax.fori_loop(0, 2, follow, (doubt & False).astype(jnp.int32))
    order, size = compacted(fate == _LOST, jnp.arange(count, dtype=jnp.int32))

    def guess(ray: Array, exists: Array, hidden: Array) -> Array:
        some = _is_hidden_by_small(pictures, geometry, _entries(rays, ray), _entries(sight, ray))
        return hidden.at[ray].max(some & exists)

    return over_batches(order, size, at_once, guess, fate == _HIDDEN)


def _across(
    neighbors: Int[Array, "F 3"], face: Int[Array, "*n"], corner: Int[Array, "*n"]
) -> Array:
    """The face across the edge opposite to a corner; -1 where there is none."""
    beside = stored(neighbors[jnp.maximum(face, 0), jnp.minimum(corner, 2)])
    return jnp.where(corner < 3, beside, -1)


def _is_hidden_by_small(
    pictures: Pictures, geometry: Geometry, rays: Rays, sight: _Sight
) -> Bool[Array, " n"]:
    """Whether points lie behind the nearest texel, of faces too small for a texel each.

    What is compared are the planes of the point's own face and of the nearest texel's, with a
    margin for surfaces that curve from one to the other.
    """
    texel = texel_of(pictures, rays)
    faces = sight.faces
    slopes, area = _slopes(pictures, rays, face_corners(geometry, faces[4]))
    margin = jnp.abs((slopes[0] - sight.slopes[0]) * texel.x)
    margin = margin + jnp.abs((slopes[1] - sight.slopes[1]) * texel.y)
    shown = jnp.any(faces == rays.face, axis=0)
    hidden = (faces[4] >= 0) & (faces[4] != rays.face) & (sight.before[4] > margin)
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
