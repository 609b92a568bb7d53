"""Which points a light sees.

Most points are told by one texel of the light's picture (see `maps`). The others, at the outlines
of shadows and where the picture is too coarse for the surface, are collected and looked at one by
one: the faces at the 3×3 texels round such a point are cut with its ray to the light, everything
relative to a corner of the point's own face, so that no bias is needed but for rounding. Outlines
of faces larger than a texel are exact at any resolution; those of smaller ones, which none of the
nine texels may show, are good to half a texel.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._selection import over_batches, selected
from diffrast._stored import stored
from diffrast.edges.planes import cross_rows
from diffrast.geometry import Geometry
from diffrast.light import dot_columns
from diffrast.shadows.maps import Pictures

_AT_ONCE = 512
_ROUNDINGS = 32
_SMALL = 4.0  # square texels, twice the area of a face


class Rays(NamedTuple):
    """Points on faces and the pictures that may show them; all of one shape (n,)."""

    face: Int[Array, " n"]
    barycentrics: Float[Array, "3 n"]
    picture: Int[Array, " n"]
    x: Float[Array, " n"]  # in texels
    y: Float[Array, " n"]
    key: Float[Array, " n"]
    unit: Float[Array, " n"]  # of the key, for rounding errors
    asked: Bool[Array, " n"]  # false where the light does not shine


class Nearby(NamedTuple):
    """The faces at the 3×3 texels round rays; corners are x, y and z by rows."""

    face: Int[Array, "9 n"]
    key: Float[Array, "9 n"]
    corners: Float[Array, "3 3 9 n"]
    own: Float[Array, "3 3 n"]  # of the face on which the ray begins
    stops: Float[Array, "9 n"]  # positive for faces that stop the ray


class _Texel(NamedTuple):
    """Texels, and where points lie from their centres."""

    row: Int[Array, " n"]
    column: Int[Array, " n"]
    x: Float[Array, " n"]
    y: Float[Array, " n"]


def lit(pictures: Pictures, geometry: Geometry, rays: Rays) -> Float[Array, " n"]:
    """1 where a light sees points that are asked for, 0 elsewhere. Not differentiable."""
    texel = _texel_of(pictures, rays)
    key, slope_x, slope_y, error = _at_texels(pictures.texel, rays.picture, texel).T
    depth = key + slope_x * texel.x + slope_y * texel.y
    rounding = _ROUNDINGS * jnp.finfo(key.dtype).eps * rays.unit
    bright = rays.asked & (rays.key >= depth - error - rounding)
    order, count = selected(rays.asked & jnp.isinf(error))

    def look_closer(chosen: Array, exists: Array, bright: Array) -> Array:
        some = stored(Rays(*(column[..., chosen] for column in rays)))
        place = jnp.where(exists, chosen, bright.size)
        return bright.at[place].set(~_blocked(pictures, geometry, some), mode="drop")

    return over_batches(order, count, _AT_ONCE, look_closer, bright).astype(key.dtype)


def _texel_of(pictures: Pictures, rays: Rays) -> _Texel:
    last = pictures.face.shape[1] - 1
    column, row = (jnp.clip(jnp.floor(at), 0, last).astype(jnp.int32) for at in (rays.x, rays.y))
    return _Texel(row, column, rays.x - (column + 0.5), rays.y - (row + 0.5))


def _at_texels(values: Array, picture: Array, texel: _Texel) -> Array:
    """Entries of an array (pictures, size, size, ...)."""
    size = values.shape[1]
    number = (picture * size + texel.row) * size + texel.column
    return values.reshape(-1, *values.shape[3:])[stored(number)]


def _blocked(pictures: Pictures, geometry: Geometry, rays: Rays) -> Bool[Array, " n"]:
    """Whether faces near the rays from points to the light stop them."""
    nearby = faces_near(pictures, geometry, rays)
    return (jnp.max(nearby.stops, axis=0) > 0) | _hidden_by_small(pictures, rays, nearby)


def face_corners(geometry: Geometry, face: Int[Array, "*n"]) -> Float[Array, "3 3 *n"]:
    """x, y and z by rows of the three corners of faces."""
    return stored(geometry.positions.T[:, geometry.faces.T[:, jnp.maximum(face, 0)]])


def faces_near(pictures: Pictures, geometry: Geometry, rays: Rays) -> Nearby:
    """The faces at the 3×3 texels round rays, and which of them stop these."""
    texel = _texel_of(pictures, rays)
    last = pictures.face.shape[1] - 1
    nine = jnp.arange(9)[:, None]
    row = jnp.clip(texel.row + nine // 3 - 1, 0, last)
    column = jnp.clip(texel.column + nine % 3 - 1, 0, last)
    around = stored(pictures.face[rays.picture, row, column])
    own, others = face_corners(geometry, rays.face), face_corners(geometry, around)
    origin = own[:, 0]
    total = jnp.sum(rays.barycentrics, axis=0)
    shares = rays.barycentrics / jnp.where(total == 0, 1, total)
    point = shares[1] * (own[:, 1] - origin) + shares[2] * (own[:, 2] - origin)
    source = pictures.plan.source[rays.picture].T
    ray = (source[:3] - source[3] * origin) - source[3] * point
    ray, corners = stored((ray, (others - origin[:, None, None]) - point[:, None, None]))
    stops = _stops(corners, ray[:, None], endless=source[3] == 0)
    foreign = (around >= 0) & (around != rays.face)
    key = pictures.texel[rays.picture, row, column, 0]
    return Nearby(around, key, others, own, jnp.where(foreign, stops, -1))


def _hidden_by_small(pictures: Pictures, rays: Rays, nearby: Nearby) -> Bool[Array, " n"]:
    """Whether points lie behind the nearest texel, of faces too small for a texel each.

    What is compared are the planes of the point's own face and of the nearest texel's, with a
    margin for surfaces that curve from one to the other.
    """
    own_slopes, _ = _slopes(pictures, rays, nearby.own)
    slopes, area = _slopes(pictures, rays, nearby.corners[:, :, 4])
    texel = _texel_of(pictures, rays)
    at = texel.x, texel.y
    behind = nearby.key[4] - rays.key
    behind = behind + own_slopes[0] * at[0] + own_slopes[1] * at[1]
    margin = jnp.abs((slopes[0] - own_slopes[0]) * at[0])
    margin = margin + jnp.abs((slopes[1] - own_slopes[1]) * at[1])
    margin = margin + _ROUNDINGS * jnp.finfo(margin.dtype).eps * rays.unit
    face = nearby.face[4]
    shown = jnp.any(nearby.face == rays.face, axis=0)
    hidden = (face >= 0) & (face != rays.face) & (behind > margin)
    return hidden & ((area < _SMALL) | ~shown)


def _stops(corners: Array, ray: Array, *, endless: Array) -> Array:
    """Positive where faces, given from the beginning of rays, stop them before their end."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = cross_rows(b - a, c - a)
    along, distance = dot_columns(normal, ray), dot_columns(normal, a)
    sign = jnp.where(along < 0, -1, 1)
    inside = along != 0
    for start, end in ((a, b), (b, c), (c, a)):
        inside = inside & (sign * dot_columns(ray, cross_rows(start, end)) >= 0)
    rounding = dot_columns(jnp.abs(normal), jnp.max(jnp.abs(corners), axis=1))
    rounding = rounding * (_ROUNDINGS * jnp.finfo(corners.dtype).eps)
    before = sign * distance
    before = jnp.where(endless, before, jnp.minimum(before, sign * along - before))
    return stored(jnp.where(inside, before - rounding, -1))


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
