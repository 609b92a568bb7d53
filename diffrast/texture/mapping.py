"""Mappings: from a point of a surface and its normal to the texture (FEATURES X1; A23–A26).

A mapping is made of two steps. What changes linearly over a face is found at the vertices and
interpolated as any attribute is (`vertex_attributes`); the rest is a closed form at every point
(`coordinates`). So a mapping is exact however coarse the mesh, has no seams within faces, and its
derivative by the pixel is analytic. All of it happens in the mesh's own coordinates: the texture
moves with the object.
"""

from typing import TypeAlias

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from diffrast._check import ArrayInput, float_array, instance_of, one_of, real_number
from diffrast._pytree import pytree_dataclass, set_field, static
from diffrast.light import Columns, normalize_columns
from diffrast.linalg import dot

SPHERES = ("arcsine", "longitude")


@pytree_dataclass
class PlanarMapping:
    """A rectangle that holds the image, seen along its normal (A23, A25).

    A point p = corner + u across + v up + w (across × up) has the coordinates (u, v): in the plane
    of the rectangle these are the planar mapping's, elsewhere those of its projection.

    Attributes:
        corner: (3,) where the lower left corner of the image lies; differentiable, as are the
            others.
        across: (3,) from there to the lower right corner.
        up: (3,) from there to the upper left corner.

    Raises:
        ValueError: for wrong shapes and numbers that are not finite.
    """

    corner: Float[Array, "3"]
    across: Float[Array, "3"]
    up: Float[Array, "3"]

    def __init__(self, *, corner: ArrayInput, across: ArrayInput, up: ArrayInput) -> None:
        for name, value in (("corner", corner), ("across", across), ("up", up)):
            set_field(self, name, float_array(name, value, (3,)))


@pytree_dataclass
class SphereMapping:
    """By the direction n from a centre to the point (A24), the normal of a sphere round it.

    "arcsine" is the source's u = asin(n_x) / pi + 1/2, v = asin(n_y) / pi + 1/2: one picture of the
    half towards +z, repeated mirrored on the other. "longitude" wraps one picture of twice that
    width round the sphere, u = atan2(n_x, n_z) / 2 pi + 1/2 and v the same; the middle of the
    picture is at +z, and its sides meet at -z.

    Attributes:
        centre: (3,) differentiable.
        rotation: (3, 3) whose rows are the directions x, y, z; differentiable. The source takes
            the camera's.
        kind: "arcsine" or "longitude", static.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and an unknown kind.
    """

    centre: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    kind: str = static()

    def __init__(
        self,
        *,
        centre: ArrayInput = (0.0, 0.0, 0.0),
        rotation: ArrayInput | None = None,
        kind: str = "arcsine",
    ) -> None:
        set_field(self, "centre", float_array("centre", centre, (3,)))
        set_field(self, "rotation", _rotation(rotation))
        set_field(self, "kind", one_of("kind", kind, SPHERES))


@pytree_dataclass
class CubeMapping:
    """By the place where the normal at a point meets a cube round the body (A26).

    The cube map that this is for is a `CubeTexture`.

    Attributes:
        centre: (3,) of the cube; differentiable.
        half_size: half the cube's edge, in the unit of the mesh, differentiable; None for a cube so
            large that only the normal counts.
        rotation: (3, 3) whose rows are the directions of the cube's axes; differentiable.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and a size not above 0.
    """

    centre: Float[Array, "3"]
    half_size: Float[Array, ""] | None
    rotation: Float[Array, "3 3"]

    def __init__(
        self,
        *,
        centre: ArrayInput = (0.0, 0.0, 0.0),
        half_size: ArrayInput | None = None,
        rotation: ArrayInput | None = None,
    ) -> None:
        if half_size is not None:
            half_size = real_number("half_size", half_size, above=0.0)
        set_field(self, "centre", float_array("centre", centre, (3,)))
        set_field(self, "half_size", half_size)
        set_field(self, "rotation", _rotation(rotation))


Mapping: TypeAlias = PlanarMapping | SphereMapping | CubeMapping


def map_points(
    mapping: Mapping, points: ArrayInput, normals: ArrayInput | None = None
) -> Float[Array, "*size coordinates"]:
    """Texture coordinates of points: what `sample_texture` takes.

    Args:
        mapping: any.
        points: (..., 3) in the mapping's coordinates.
        normals: (..., 3) of any length; a `CubeMapping` needs them.

    Returns:
        (..., 2) u and v, or (..., 3) directions for a `CubeMapping`. Differentiable in everything.

    Raises:
        ValueError: for wrong shapes, and missing normals.
    """
    instance_of("mapping", mapping, PlanarMapping, SphereMapping, CubeMapping)
    points = float_array("points", points, ("...", 3), finite=False)
    if normals is not None:
        normals = float_array("normals", normals, points.shape, finite=False)
    elif isinstance(mapping, CubeMapping):
        raise ValueError("normals: wanted those of the points for a CubeMapping, got None")
    attributes = vertex_attributes(mapping, points, normals)
    columns = [attributes[..., i] for i in range(attributes.shape[-1])]
    return jnp.stack(coordinates(mapping, columns), axis=-1)


def vertex_attributes(
    mapping: Mapping, points: Float[Array, "*size 3"], normals: Float[Array, "*size 3"] | None
) -> Float[Array, "*size attributes"]:
    """What of a mapping changes linearly over a face."""
    if isinstance(mapping, PlanarMapping):
        return _in_rectangle(mapping, points)
    offset = _turned(mapping.rotation, points - mapping.centre)
    if isinstance(mapping, SphereMapping):
        return offset
    assert normals is not None
    direction = _turned(mapping.rotation, normals)
    if mapping.half_size is None:
        return direction
    return jnp.concatenate([offset / mapping.half_size, direction], axis=-1)


def attribute_count(mapping: Mapping | None) -> int:
    """How many attributes `vertex_attributes` makes; two uvs without a mapping."""
    if isinstance(mapping, CubeMapping):
        return 3 if mapping.half_size is None else 6
    return 3 if isinstance(mapping, SphereMapping) else 2


def coordinates(mapping: Mapping | None, attributes: Columns) -> Columns:
    """Texture coordinates u, v or x, y, z of interpolated attributes, as columns.

    Only the mapping's kind is used.
    """
    if isinstance(mapping, SphereMapping):
        x, y, z = attributes
        v = _angle(y, _length(x, z)) / jnp.pi + 0.5
        if mapping.kind == "arcsine":
            return [_angle(x, _length(y, z)) / jnp.pi + 0.5, v]
        return [_angle(x, z) / (2 * jnp.pi) + 0.5, v]
    if isinstance(mapping, CubeMapping) and mapping.half_size is not None:
        return _on_cube(attributes[:3], attributes[3:])
    return attributes


def _rotation(rotation: ArrayInput | None) -> Array:
    if rotation is None:
        return jnp.eye(3)
    return float_array("rotation", rotation, (3, 3))


def _turned(rotation: Array, vectors: Array) -> Array:
    return jnp.stack([dot(vectors, rotation[i]) for i in range(3)], axis=-1)


def _in_rectangle(mapping: PlanarMapping, points: Array) -> Array:
    """(u, v) by the vectors that are dual to the sides; zero where the rectangle has no area.

    Sides are scaled first, so that no product of them under- or overflows.
    """
    sides = jnp.stack([mapping.across, mapping.up])
    size = jnp.max(jnp.abs(lax.stop_gradient(sides)), axis=1)
    known = jnp.all(size > 0)
    size = jnp.where(known, size, 1)
    across, up = sides / size[:, None]
    normal = jnp.cross(across, up)
    square = dot(normal, normal)
    known = known & (square > 0)
    inverse = jnp.where(known, 1, 0) / jnp.where(known, square, 1)
    duals = jnp.stack([jnp.cross(up, normal), jnp.cross(normal, across)]) * inverse
    offset = points - mapping.corner
    return jnp.stack([dot(offset, duals[i]) / size[i] for i in range(2)], axis=-1)


def _length(a: Array, b: Array) -> Array:
    return normalize_columns([a, b, jnp.zeros_like(a)])[1]


def _angle(opposite: Array, adjacent: Array) -> Array:
    """Their arctangent, of either relative to the larger one; 0 where both are zero."""
    size = jnp.maximum(*(jnp.abs(lax.stop_gradient(part)) for part in (opposite, adjacent)))
    somewhere = size > 0
    inverse = 1 / jnp.where(somewhere, size, 1)
    return jnp.arctan2(opposite * inverse, jnp.where(somewhere, adjacent * inverse, 1))


def _on_cube(point: Columns, normal: Columns) -> Columns:
    """Where the ray from a point along its normal first meets a plane of the unit cube.

    That is at the least positive t = (±1 - p_i) / n_i; the point itself without a normal.
    """
    least = jnp.full_like(point[0], jnp.inf)
    for p, n in zip(point, normal, strict=True):
        crosses = n != 0
        for plane in (-1, 1):
            t = (plane - p) / jnp.where(crosses, n, 1)
            least = jnp.where(crosses & (t > 0) & (t < least), t, least)
    least = jnp.where(least < jnp.inf, least, 0)
    return [p + least * n for p, n in zip(point, normal, strict=True)]
