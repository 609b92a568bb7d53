"""The shadows of all lights of a scene."""

from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from diffrast.geometry import Geometry, Points, at_points, flat_normals
from diffrast.light import AmbientLight, Columns, Light, ShiningLight
from diffrast.shadows.lit import lit
from diffrast.shadows.maps import ShadowMap, draw_map
from diffrast.shadows.views import LightView, Seen, is_parallel, light_view, see

Shadows: TypeAlias = tuple[ShadowMap | None, ...]  # one entry a light, None if it casts none


def cast(
    lights: tuple[Light, ...], geometry: Geometry, points: Points, normal: Columns | None
) -> Shadows:
    """Draw what each light sees of the scene round the points, where it casts shadows.

    Args:
        lights: of the scene.
        geometry: of the scene.
        points: that shadows may fall on.
        normal: surface normals there as the shading has them, which tell the outside of open
            surfaces; None for those of the faces.
    """
    maps: list[ShadowMap | None] = []
    lights, geometry, points, normal = lax.stop_gradient((lights, geometry, points, normal))
    for light in lights:
        if isinstance(light, AmbientLight) or light.shadow is None:
            maps.append(None)
            continue
        with jax.named_scope("shadow"):
            view = light_view(light, geometry.positions)
            seen, towards = _regard(light, view, geometry, points, normal)
            wanted = (points.face >= 0) & seen.inside & towards
            maps.append(draw_map(light, view, geometry, seen, wanted))
    return tuple(maps)


def receive(
    lights: tuple[Light, ...],
    shadows: Shadows,
    geometry: Geometry,
    points: Points,
    normal: Columns | None,
) -> list[Float[Array, "*size"] | None]:
    """1 where a light reaches points, 0 where it does not, None for a light without shadows.

    Arguments as of `cast`; points far away from those that the shadows were cast for have whatever
    shadow is near.
    """
    lights, geometry, points, normal = lax.stop_gradient((lights, geometry, points, normal))
    reached: list[Array | None] = []
    for light, shadow_map in zip(lights, shadows, strict=True):
        if shadow_map is None:
            reached.append(None)
            continue
        assert not isinstance(light, AmbientLight)
        with jax.named_scope("shadow"):
            seen, towards = _regard(light, shadow_map.view, geometry, points, normal)
            bright = lit(light, shadow_map, geometry, points, seen, towards)
            reached.append(bright.astype(points.barycentrics[0].dtype))
    return reached


def _regard(
    light: ShiningLight,
    view: LightView,
    geometry: Geometry,
    points: Points,
    normal: Columns | None,
) -> tuple[Seen, Bool[Array, "*size"]]:
    """Where the light sees points, and whether their faces, with the normals, turn to it."""
    position = at_points(geometry.positions, geometry, points)
    facing = flat_normals(geometry, points.face)
    if is_parallel(light):
        to_light = [-view.axes[2, i] for i in range(3)]
    else:
        to_light = [view.origin[i] - position[i] for i in range(3)]
    seen = see(light, view, position)
    turned = _dot(facing, to_light)
    outside = jnp.ones_like(turned) if normal is None else _dot(facing, normal)
    return seen, ((turned > 0) & (outside > 0)) | ((turned < 0) & (outside < 0))


def _dot(a: Columns, b: Columns) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
