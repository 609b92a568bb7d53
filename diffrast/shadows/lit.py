"""Which points a light sees.

Most points are told by one texel of the light's picture (see `maps`). The others, at the outlines
of shadows and where the picture is too coarse for the surface, are collected and looked at one by
one: the faces at the 3×3 texels round such a point are cut with its ray to the light. That needs no
tolerance but for rounding, since everything is taken relative to a corner of the point's own face,
and gives shadows straight and exact edges at any resolution.

A face that turns away from the light is dark, as it is on any closed body.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored
from diffrast.geometry import Geometry, Points
from diffrast.light import ShiningLight
from diffrast.raster.fixed_point import CULLED, group_by_class
from diffrast.shadows.maps import ShadowMap
from diffrast.shadows.views import Seen, homogeneous, is_parallel

_AT_ONCE = 512
_ROUNDINGS = 32
_SMALL = 4.0  # square texels, twice the area of a face


def lit(
    light: ShiningLight,
    shadow_map: ShadowMap,
    geometry: Geometry,
    points: Points,
    seen: Seen,
    towards: Bool[Array, "*size"],
) -> Float[Array, "*size"]:
    """1 at points that the light sees, 0 at others. Not differentiable: pass stopped gradients.

    Args:
        light: that casts shadows.
        shadow_map: its pictures.
        geometry: of the scene.
        points: on faces, of any shape.
        seen: where the light sees them.
        towards: whether their faces turn to the light.
    """
    shape = towards.shape
    seen = Seen(*(jnp.ravel(column) for column in seen))
    asked = jnp.ravel(towards) & seen.inside
    at = _texel_of(shadow_map, seen)
    key, slope_x, slope_y, error = _at_texels(shadow_map.texel, at.number).T
    depth = key + slope_x * at.x + slope_y * at.y
    rounding = _ROUNDINGS * jnp.finfo(key.dtype).eps * jnp.ones_like(key)
    if not is_parallel(light):
        rounding = rounding * seen.key
    bright = asked & (seen.key >= depth - error - rounding)
    order, starts = group_by_class(jnp.where(asked & jnp.isinf(error), 0, CULLED))
    face = jnp.ravel(points.face)
    barycentrics = jnp.stack([jnp.ravel(b) for b in points.barycentrics])

    def look_closer(n: Array, bright: Array) -> Array:
        slots = n * _AT_ONCE + jnp.arange(_AT_ONCE)
        chosen = order[jnp.minimum(slots, order.shape[0] - 1)]
        some = Points(face[chosen], list(barycentrics[:, chosen]), key[chosen])
        place = Place(*(column[chosen] for column in at))
        free = ~_blocked(light, shadow_map, geometry, some, place, seen.key[chosen])
        return bright.at[jnp.where(slots < starts[1], chosen, bright.size)].set(free, mode="drop")

    chunks = (starts[1] + _AT_ONCE - 1) // _AT_ONCE
    bright = lax.fori_loop(0, chunks, look_closer, bright).reshape(shape)
    return bright.astype(key.dtype)


class Place(NamedTuple):
    """A texel, and where points lie from its centre in texels."""

    side: Int[Array, " n"]
    row: Int[Array, " n"]
    column: Int[Array, " n"]
    number: Int[Array, " n"]
    x: Float[Array, " n"]
    y: Float[Array, " n"]


def _texel_of(shadow_map: ShadowMap, seen: Seen) -> Place:
    size = shadow_map.face.shape[1]
    scale_x, scale_y, offset_x, offset_y = _windows(shadow_map, seen.side)
    x, y = scale_x * seen.x + offset_x, scale_y * seen.y + offset_y
    column, row = (jnp.clip(jnp.floor(at), 0, size - 1).astype(jnp.int32) for at in (x, y))
    number = (seen.side * size + row) * size + column
    return Place(seen.side, row, column, number, x - (column + 0.5), y - (row + 0.5))


def _windows(shadow_map: ShadowMap, side: Array) -> Array:
    """The windows of each point's picture, four columns."""
    window = shadow_map.window
    return window[0] if window.shape[0] == 1 else window.T[:, side]


def _at_texels(values: Array, number: Array) -> Array:
    """Rows of an array (sides, size, size, ...)."""
    return values.reshape(-1, *values.shape[3:])[number]


def _blocked(
    light: ShiningLight,
    shadow_map: ShadowMap,
    geometry: Geometry,
    points: Points,
    place: Place,
    key: Array,
) -> Bool[Array, " n"]:
    """Whether faces near the rays from points to the light stop them."""
    size = shadow_map.face.shape[1]
    nine = jnp.arange(9)[:, None]
    row = jnp.clip(place.row + nine // 3 - 1, 0, size - 1)
    column = jnp.clip(place.column + nine % 3 - 1, 0, size - 1)
    around = stored(shadow_map.face[place.side, row, column])
    table = geometry.positions.T

    def corners_of(face: Array) -> Array:
        """The corners' x, y and z, shape (3, 3 corners, *face)."""
        return stored(table[:, geometry.faces.T[:, jnp.maximum(face, 0)]])

    own, others = corners_of(points.face), corners_of(around)
    origin = own[:, 0]
    total = points.barycentrics[0] + points.barycentrics[1] + points.barycentrics[2]
    shares = [b / jnp.where(total == 0, 1, total) for b in points.barycentrics]
    point = shares[1] * (own[:, 1] - origin) + shares[2] * (own[:, 2] - origin)
    view = shadow_map.view
    if is_parallel(light):
        ray = jnp.broadcast_to(-view.axes[2][:, None], point.shape)
    else:
        ray = (view.origin[:, None] - origin) - point
    ray, corners = stored((ray, (others - origin[:, None, None]) - point[:, None, None]))
    stops = _stops(corners, ray[:, None], endless=is_parallel(light))
    foreign = (around >= 0) & (around != points.face)
    found = jnp.max(jnp.where(foreign, stops, -1), axis=0) > 0
    # Faces too small to be found.
    nearest = around[4]
    slopes, small = _slopes(light, shadow_map, place, others[:, :, 4])
    own_slopes, _ = _slopes(light, shadow_map, place, own)
    beyond = _at_texels(shadow_map.texel, place.number)[:, 0] - key
    beyond = beyond + own_slopes[0] * place.x + own_slopes[1] * place.y
    margin = sum(
        jnp.abs((a - b) * at)
        for a, b, at in zip(slopes, own_slopes, (place.x, place.y), strict=True)
    )
    margin = margin + _ROUNDINGS * jnp.finfo(key.dtype).eps * jnp.abs(key)
    own_seen = jnp.any(around == points.face, axis=0)
    hidden = (nearest >= 0) & (nearest != points.face) & (beyond > margin)
    return found | (hidden & (small | ~own_seen))


def _stops(corners: Array, ray: Array, *, endless: bool) -> Array:
    """Positive where faces, given from the beginning of rays, stop them before their end."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = _cross(b - a, c - a)
    along, distance = _dot(normal, ray), _dot(normal, a)
    sign = jnp.where(along < 0, -1, 1)
    inside = along != 0
    for start, end in ((a, b), (b, c), (c, a)):
        inside = inside & (sign * _dot(ray, _cross(start, end)) >= 0)
    rounding = _dot(jnp.abs(normal), jnp.max(jnp.abs(corners), axis=1))
    rounding = rounding * (_ROUNDINGS * jnp.finfo(corners.dtype).eps)
    before = sign * distance
    if not endless:
        before = jnp.minimum(before, sign * along - before)
    return stored(jnp.where(inside, before - rounding, -1))


def _slopes(
    light: ShiningLight, shadow_map: ShadowMap, place: Place, corners: Array
) -> tuple[list[Array], Array]:
    """How the depth key changes from texel to texel on faces, and whether they are small."""
    x, y, w, k = homogeneous(light, shadow_map.view, place.side, list(corners))
    scale_x, scale_y, offset_x, offset_y = _windows(shadow_map, place.side)
    at_x, at_y = place.column + 0.5 + place.x, place.row + 0.5 + place.y
    x = scale_x * x + (offset_x - at_x) * w
    y = scale_y * y + (offset_y - at_y) * w
    rows = jnp.stack([x, y, w, k])
    first, one, other = rows[:, 0], rows[:, 1] - rows[:, 0], rows[:, 2] - rows[:, 0]

    def determinant(*columns: int) -> Array:
        a, b, c = (row[jnp.array(columns)] for row in (first, one, other))
        return _dot(a, _cross(b, c))

    volume = determinant(0, 1, 2)
    inverse = jnp.where(volume == 0, 0, 1) / jnp.where(volume == 0, 1, volume)
    slopes = [determinant(3, 1, 2) * inverse, determinant(0, 3, 2) * inverse]
    before = jnp.all(w > 0, axis=0)
    flat_x, flat_y = (column / jnp.where(before, w, 1) for column in (x, y))
    twice = (flat_x[1] - flat_x[0]) * (flat_y[2] - flat_y[0]) - (flat_x[2] - flat_x[0]) * (
        flat_y[1] - flat_y[0]
    )
    return slopes, before & (jnp.abs(twice) < _SMALL)


def _cross(a: Array, b: Array) -> Array:
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
