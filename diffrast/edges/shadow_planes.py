"""The planes of shadows: through lights and edges, and where they meet those of faces.

With h the weight of points, 1 for places and 0 for directions, (x, y, w, h) are coordinates of
space for a perspective camera, which drops h. For a parallel projection h is the weight that tells
depth (see `Depth`), and moves with the light. A plane is (r, r'), r · (x, y, w) + r' h = 0; it and
another one (p, p') meet on the screen where (r' p − p' r) · (x, y, 1) = 0.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from diffrast._stored import stored
from diffrast.edges.planes import cross_rows, dot_rows, largest

_ROUNDINGS = 64  # in a line's coefficients


class Plane(NamedTuple):
    """Planes in space, as homogeneous coordinates of the screen have it."""

    normal: Float[Array, "3 *n"]  # of x, y and w
    offset: Float[Array, "*n"]  # of h


def face_plane(corners: Float[Array, "3 3 *n"]) -> Plane:
    """The plane of faces; its offset is not negative."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    plane = _through(cross_rows(b - a, c - a), a)
    sign = jnp.where(plane.offset < 0, -1, 1)
    return Plane(sign * plane.normal, sign * plane.offset)


def shadow_plane(source: Array, weight: Array, start: Array, end: Array) -> Plane:
    """The plane through light and edge."""
    return _through(cross_rows(source - weight * start, end - start), start)


def end_plane(source: Array, weight: Array, shadow: Plane, start: Array, end: Array) -> Plane:
    """The plane through light and start at right angles to the shadow's; positive at the end."""
    plane = _through(cross_rows(shadow.normal, source - weight * start), start)
    sign = jnp.where(dot_rows(plane.normal, end - start) < 0, -1, 1)
    return Plane(sign * plane.normal, sign * plane.offset)


def edge_plane(shadow: Plane, start: Array, end: Array) -> Plane:
    """The plane through the edge at right angles to the shadow's."""
    return _through(cross_rows(end - start, shadow.normal), start)


def behind_edge(source: Array, weight: Array, shadow: Plane, start: Array, end: Array) -> Plane:
    """The plane through the edge likewise; positive on the other side than the light."""
    plane = edge_plane(shadow, start, end)
    sign = jnp.where(dot_rows(plane.normal, source) + plane.offset * weight > 0, -1, 1)
    return Plane(sign * plane.normal, sign * plane.offset)


def meeting(ground: Plane, plane: Plane) -> Float[Array, "3 *n"]:
    """The line a x + b y + c = 0 on the screen where planes meet: (a, b, c)."""
    return ground.offset * plane.normal - plane.offset * ground.normal


def line_of(ground: Plane, shadow: Plane) -> tuple[Array, Array, Array]:
    """Where planes meet on the screen: unit normal, and point next to the pixel's centre.

    Also the factor that makes distances of what `meeting` tells, 0 where rounding leaves no line.
    """
    line = meeting(ground, shadow)
    steepness = jnp.hypot(line[0], line[1])
    size = largest(shadow.normal[:2]) * jnp.abs(ground.offset)
    size = size + largest(ground.normal[:2]) * jnp.abs(shadow.offset)
    steep = steepness > _ROUNDINGS * jnp.finfo(line.dtype).eps * size
    inverse = 1 / jnp.where(steep, steepness, 1)
    normal = line[:2] * inverse
    return normal, -line[2] * inverse * normal, jnp.where(steep, inverse, 0)


def nonzero(value: Array) -> Array:
    """The value, or 1 for 0."""
    return jnp.where(value == 0, 1, value)


def _through(normal: Array, place: Array) -> Plane:
    """The plane through a place; its normal is scaled to a largest component of one."""
    normal = stored(normal / nonzero(largest(normal)))
    return Plane(normal, -dot_rows(normal, place))
