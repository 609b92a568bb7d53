"""How a light sees the world: where on its pictures each point is shown.

A directional light sees by parallel projection, a spot by perspective along its axis, and a point
light by six perspectives, through the sides of a cube. Seen from `origin` a point has coordinates
x, y across and z along the light's way; w is 1 in a parallel projection and z in a perspective.
The picture shows it at (x/w, y/w), in a window fitted to the points that need it.

Depth is told by the key k/w, larger for what is nearer to the light: 1/w in a perspective, and in a
parallel projection a number between -1 and 1, -1 farthest away. Either is affine over the picture
on a plane, as the rasteriser has it.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast.light import Columns, DirectionalLight, PointLight, ShiningLight, SpotLight
from diffrast.linalg import apply_matrix
from diffrast.viewing import view_axes

_INNER = 0.99  # of the way to the planes near and far: nothing is cut off
_WIDEST = 8.0  # tangent of the widest angle at which a spot sees


class LightView(NamedTuple):
    """Where a light sees from."""

    origin: Float[Array, "3"]
    axes: Float[Array, "3 3"]  # across, up and along the light's way; of a point light the world's
    depth: Float[Array, ""]  # key of z = 1 in a parallel projection
    reach: Float[Array, ""]  # tangent of the angle to its axis at which a spot still sees


class Seen(NamedTuple):
    """Points as a light sees them."""

    side: Int[Array, "*size"]  # which of its pictures shows them
    x: Float[Array, "*size"]  # x/w and y/w: where
    y: Float[Array, "*size"]
    key: Float[Array, "*size"]
    unit: Float[Array, "*size"]  # of the key, for rounding errors
    inside: Bool[Array, "*size"]  # whether the light shines there at all


def is_parallel(light: ShiningLight) -> bool:
    """Whether the rays of a light are parallel."""
    return isinstance(light, DirectionalLight)


def sides(light: ShiningLight) -> int:
    """Number of pictures."""
    return 6 if isinstance(light, PointLight) else 1


def light_view(
    light: ShiningLight,
    positions: Float[Array, "V 3"],
    lit_by_corner: Int[Array, "F 3"] | None = None,
) -> LightView:
    """Place the light, so that its pictures may show any of the positions.

    A spot sees what is in its cone, and of faces that are `lit_by_corner` all of those with a
    corner in the cone, as they carry its light beyond.
    """
    dtype = positions.dtype
    one = jnp.ones((), dtype)
    if isinstance(light, PointLight):
        return LightView(light.position, jnp.eye(3, dtype=dtype), one, one)
    axes = view_axes(light.direction, jnp.zeros(3, dtype)) * jnp.array([1, 1, -1], dtype)[:, None]
    if isinstance(light, SpotLight):
        reach = jnp.tan(light.cutoff)
        if lit_by_corner is not None:
            x, y, z = apply_matrix(axes, positions - light.position).T
            tangent = jnp.hypot(x, y) / jnp.where(z > 0, z, 1)
            corners = jnp.where(z > 0, tangent, jnp.where(z <= 0, jnp.inf, jnp.nan))[lit_by_corner]
            lit = jnp.min(corners, axis=1) < reach
            farthest = jnp.max(jnp.where(lit, jnp.max(corners, axis=1), 0), initial=0)
            reach = jnp.maximum(reach, jnp.minimum(farthest, _WIDEST))
        return LightView(light.position, axes, one, reach)
    finite = jnp.all(jnp.isfinite(positions), axis=1, keepdims=True)
    low = jnp.min(jnp.where(finite, positions, jnp.inf), axis=0)
    high = jnp.max(jnp.where(finite, positions, -jnp.inf), axis=0)
    origin = jnp.where(low <= high, (low + high) / 2, 0)
    reach = jnp.max(jnp.abs(apply_matrix(axes[2:], jnp.where(finite, positions - origin, 0))))
    return LightView(origin, axes, -_INNER / jnp.where(reach > 0, reach, 1), one)


def see(light: ShiningLight, view: LightView, position: Columns) -> Seen:
    """Where the light sees points, each on the picture that shows it."""
    offset = [position[i] - view.origin[i] for i in range(3)]
    side = jnp.zeros(offset[0].shape, jnp.int32)
    if isinstance(light, PointLight):
        side = cube_side(offset)
        axis = side // 2
        across = [_of_axis(axis, [*offset[k:], *offset[:k]]) for k in (1, 2)]
        x, y, z = *across, jnp.abs(_of_axis(axis, offset))
    else:
        x, y, z = (sum(row[i] * offset[i] for i in range(3)) for row in view.axes)
    if is_parallel(light):
        return Seen(side, x, y, view.depth * z, jnp.ones_like(z), jnp.ones(z.shape, bool))
    inside = z > 0
    inverse = 1 / jnp.where(inside, z, 1)
    x, y = x * inverse, y * inverse
    if isinstance(light, SpotLight):
        inside = inside & (x * x + y * y < view.reach * view.reach)
    return Seen(side, x, y, inverse, inverse, inside)


def cube_side(offset: Columns) -> Int[Array, "*size"]:
    """Which of a point light's pictures shows points: the axes by twos, forwards and backwards."""
    size = [jnp.abs(component) for component in offset]
    first = (size[0] >= size[1]) & (size[0] >= size[2])
    axis = jnp.where(first, 0, jnp.where(size[1] >= size[2], 1, 2))
    return 2 * axis + (_of_axis(axis, offset) < 0).astype(jnp.int32)


def source(light: ShiningLight, view: LightView) -> Float[Array, "4"]:
    """The light as a homogeneous point; from p it lies in the direction of x, y, z - w p."""
    if is_parallel(light):
        return jnp.append(-view.axes[2], 0)
    return jnp.append(view.origin, 1)


def matrices(light: ShiningLight, view: LightView) -> Float[Array, "sides 4 4"]:
    """For each picture the matrix that takes (offset from the origin, 1) to x, y, w and k."""
    dtype = view.axes.dtype
    last = jnp.array([0, 0, 0, 1], dtype)
    found = []
    for side in range(sides(light)):
        first = side // 2 + 1 if isinstance(light, PointLight) else 0
        x, y, z = (jnp.append(view.axes[(first + k) % 3], 0) for k in range(3))
        z = -z if side % 2 else z
        rows = [x, y, last, view.depth * z] if is_parallel(light) else [x, y, z, last]
        found.append(jnp.stack(rows))
    return jnp.stack(found)


def _of_axis(axis: Array, values: Columns) -> Array:
    return jnp.where(axis == 0, values[0], jnp.where(axis == 1, values[1], values[2]))
