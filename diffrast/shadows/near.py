"""The faces near rays to lights, and where rays pass faces.

Which faces are near is read from lights' pictures. Everything is cut relative to a corner of the
face on which a ray begins, so that no bias is needed but for rounding.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, Shaped

from diffrast._stored import stored
from diffrast.edges.planes import cross_rows, lowest
from diffrast.geometry import Geometry
from diffrast.light import dot_columns
from diffrast.shadows.maps import Pictures

ROUNDINGS = 32  # units in the last place
_LAST_DIGITS = 8  # such units, of world positions


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


class Line(NamedTuple):
    """Rays, and where they begin: at a point from the first corner of the face there."""

    corner: Float[Array, "3 *n"]
    point: Float[Array, "3 *n"]
    ray: Float[Array, "3 *n"]
    endless: Bool[Array, "*n"]


class Cut(NamedTuple):
    """Where rays pass faces."""

    stops: Float[Array, "*n"]  # positive for faces that stop the ray
    turn: Float[Array, "*n"]  # -1 or 1: the side that faces turn to the light; 0 edge-on
    corner: Int[Array, "*n"]  # opposite to the edge beyond which the ray lies farthest; 3: inside


class Nearby(NamedTuple):
    """The faces at the 3×3 texels round rays; corners are x, y and z by rows."""

    face: Int[Array, "9 n"]
    key: Float[Array, "9 n"]
    corners: Float[Array, "3 3 9 n"]
    cut: Cut


class Texel(NamedTuple):
    """Texels, and where points lie from their centres."""

    row: Int[Array, " n"]
    column: Int[Array, " n"]
    x: Float[Array, " n"]
    y: Float[Array, " n"]


def texel_of(pictures: Pictures, rays: Rays) -> Texel:
    """The texels in which rays begin."""
    last = pictures.face.shape[1] - 1
    column, row = (jnp.clip(jnp.floor(at), 0, last) for at in (rays.x, rays.y))
    x, y = rays.x - (column + 0.5), rays.y - (row + 0.5)
    return Texel(row.astype(jnp.int32), column.astype(jnp.int32), x, y)


def number_of(
    pictures: Pictures, picture: Int[Array, " n"], row: Int[Array, "*n"], column: Int[Array, "*n"]
) -> Int[Array, "*n"]:
    """Numbers of texels, as `at_texels` wants them."""
    size = pictures.face.shape[1]
    return stored((picture * size + row) * size + column)


def at_texels(values: Shaped[Array, "pictures size size"], number: Int[Array, "*n"]) -> Array:
    """What pictures show at texels."""
    return values.reshape(-1)[number]


def texels_round(pictures: Pictures, rays: Rays, texel: Texel) -> Int[Array, "9 n"]:
    """Numbers of the 3×3 texels round those in which rays begin."""
    last, nine = pictures.face.shape[1] - 1, jnp.arange(9, dtype=jnp.int32)[:, None]
    row = jnp.clip(texel.row + nine // 3 - 1, 0, last)
    column = jnp.clip(texel.column + nine % 3 - 1, 0, last)
    return number_of(pictures, rays.picture, row, column)


def line_of(pictures: Pictures, rays: Rays, own: Float[Array, "3 3 n"]) -> Line:
    """Rays and where they begin, on faces with these corners."""
    origin = own[:, 0]
    total = jnp.sum(rays.barycentrics, axis=0)
    shares = rays.barycentrics / jnp.where(total == 0, 1, total)
    point = shares[1] * (own[:, 1] - origin) + shares[2] * (own[:, 2] - origin)
    source = pictures.plan.source[rays.picture].T
    ray = (source[:3] - source[3] * origin) - source[3] * point
    return Line(origin, point, ray, source[3] == 0)


def faces_near(pictures: Pictures, geometry: Geometry, rays: Rays, line: Line) -> Nearby:
    """The faces at the 3×3 texels round rays, and which of them stop these."""
    texels = texels_round(pictures, rays, texel_of(pictures, rays))
    around = stored(at_texels(pictures.face, texels))
    others = face_corners(geometry, around)
    cut = cut_by(Line(*(column[..., None, :] for column in line)), others)
    foreign = (around >= 0) & (around != rays.face)
    cut = cut._replace(stops=jnp.where(foreign, cut.stops, -1))
    return Nearby(around, at_texels(pictures.key, texels), others, cut)


def cut_by(line: Line, corners: Float[Array, "3 3 *n"]) -> Cut:
    """Cut rays with faces, everything relative to where the rays begin."""
    corners = stored((corners - line.corner[:, None]) - line.point[:, None])
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = cross_rows(b - a, c - a)
    along = dot_columns(normal, line.ray)
    sides = [dot_columns(line.ray, cross_rows(*edge)) for edge in ((b, c), (c, a), (a, b))]
    distance = dot_columns(normal, a)
    extent = jnp.maximum(jnp.maximum(jnp.abs(a), jnp.abs(b)), jnp.abs(c))
    # Of what is computed here, and of positions: surfaces that touch do so but for the last digits.
    size = ROUNDINGS * extent + _LAST_DIGITS * jnp.abs(line.corner + line.point)
    rounding = dot_columns(jnp.abs(normal), size) * jnp.finfo(corners.dtype).eps
    along, sides, distance, rounding = stored((along, sides, distance, rounding))
    sign = jnp.where(along < 0, -1, 1)
    values = [sign * side for side in sides]
    least, corner = lowest(values)
    outside = least < 0
    before = sign * distance
    before = jnp.where(line.endless, before, jnp.minimum(before, sign * along - before))
    stops = jnp.where((along != 0) & ~outside, before - rounding, -1)
    return Cut(stops, jnp.sign(along), jnp.where(outside, corner, 3).astype(jnp.int32))


def face_corners(geometry: Geometry, face: Int[Array, "*n"]) -> Float[Array, "3 3 *n"]:
    """x, y and z by rows of the three corners of faces."""
    return stored(geometry.positions.T[:, geometry.faces.T[:, jnp.maximum(face, 0)]])


def seen_by_light(pictures: Pictures, picture: Int[Array, " n"]) -> Callable[[Array], Array]:
    """The function from places (3, ..., n) to x, y in texels and w in lights' pictures."""
    origin = stored(pictures.plan.origin[picture].T)
    matrix = stored(jnp.moveaxis(pictures.plan.matrix[picture][:, :3], 0, 2))  # (x y w, 4, n)

    def seen(place: Array) -> Array:
        x, y, z = (place[i] - origin[i] for i in range(3))
        return jnp.stack([r[0] * x + r[1] * y + r[2] * z + r[3] for r in matrix])

    return seen
