"""The shadows of all lights of a scene."""

from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool

from diffrast._stored import stored
from diffrast.geometry import Geometry, Points, at_points
from diffrast.light import Light, ShiningLight, casts_shadow
from diffrast.linalg import dot
from diffrast.shadows.lit import lit
from diffrast.shadows.maps import Picture, ShadowMap, plan, take
from diffrast.shadows.views import LightView, Seen, is_parallel, light_view, see

T = TypeVar("T")
Shadows: TypeAlias = tuple[ShadowMap | None, ...]  # one entry a light, None if it casts none
Reached: TypeAlias = tuple[Array | None, ...]  # the same: 1 where it reaches a point, or 0


def cast(lights: tuple[Light, ...], geometry: Geometry, points: Points) -> tuple[Shadows, Reached]:
    """Draw what each light sees of the scene round the points, where it casts shadows.

    Args:
        lights: of the scene.
        geometry: of the scene.
        points: that shadows may fall on.

    Returns:
        The shadows, and what `receive` tells of these points.
    """
    lights, geometry, points = lax.stop_gradient((lights, geometry, points))
    with jax.named_scope("shadow"):
        casting = [light for light in lights if casts_shadow(light)]
        views = [light_view(light, geometry.positions) for light in casting]
        regards = [
            _regard(light, view, geometry, points)
            for light, view in zip(casting, views, strict=True)
        ]
        seen = [seen for seen, _ in regards]
        wanted = [(points.face >= 0) & seen.inside & towards for seen, towards in regards]
        maps = _draw(casting, views, seen, wanted, geometry)
        bright = [
            lit(light, shadow_map, geometry, points, seen, towards)
            for light, shadow_map, (seen, towards) in zip(casting, maps, regards, strict=True)
        ]
    return _for_all(lights, maps), _for_all(lights, bright)


def receive(
    lights: tuple[Light, ...],
    shadows: Shadows,
    geometry: Geometry,
    points: Points,
) -> Reached:
    """1 where a light reaches points, 0 where it does not, None for a light without shadows.

    Arguments as of `cast`; points far away from those that the shadows were cast for have whatever
    shadow is near.
    """
    lights, geometry, points = lax.stop_gradient((lights, geometry, points))
    casting = [light for light in lights if casts_shadow(light)]
    maps = [shadow_map for shadow_map in shadows if shadow_map is not None]
    bright = []
    with jax.named_scope("shadow"):
        for light, shadow_map in zip(casting, maps, strict=True):
            seen, towards = _regard(light, shadow_map.view, geometry, points)
            bright.append(lit(light, shadow_map, geometry, points, seen, towards))
    return _for_all(lights, bright)


def _draw(
    lights: list[ShiningLight],
    views: list[LightView],
    seen: list[Seen],
    wanted: list[Array],
    geometry: Geometry,
) -> list[ShadowMap]:
    """Draw the lights' pictures, all those of one size by one program."""
    plans = [plan(*each) for each in zip(lights, views, seen, wanted, strict=True)]
    maps: dict[int, ShadowMap] = {}
    sizes = [light.shadow.resolution for light in lights if light.shadow is not None]
    for size in sorted(set(sizes)):
        members = [i for i, own in enumerate(sizes) if own == size]
        joined = [jnp.concatenate(c) for c in zip(*(plans[i][1] for i in members), strict=True)]
        face, texel = take(Picture(*joined), geometry, size)
        first = 0
        for i in members:
            window = plans[i][0]
            own = slice(first, first + window.shape[0])
            maps[i] = ShadowMap(views[i], window, face[own], texel[own])
            first += window.shape[0]
    return [maps[i] for i in range(len(lights))]


def _for_all(lights: tuple[Light, ...], values: list[T]) -> tuple[T | None, ...]:
    """Values of the lights that cast shadows, and None for the others."""
    rest = iter(values)
    return tuple(next(rest) if casts_shadow(light) else None for light in lights)


def _regard(
    light: ShiningLight,
    view: LightView,
    geometry: Geometry,
    points: Points,
) -> tuple[Seen, Bool[Array, "*size"]]:
    """Where the light sees points, and whether their faces turn to it."""
    seen = see(light, view, at_points(geometry.positions, geometry, points))
    towards = _turned_to(light, view, geometry)
    return stored(seen), towards[jnp.maximum(points.face, 0)]


def _turned_to(light: ShiningLight, view: LightView, geometry: Geometry) -> Bool[Array, " F"]:
    """Whether the light is on that side of faces which the normals at their corners point to."""
    corners = geometry.positions[geometry.faces_outward]
    normal = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    to_light = -view.axes[2] if is_parallel(light) else view.origin - corners[:, 0]
    inside_out = jnp.zeros(normal.shape[0], bool)
    if geometry.normals is not None:
        inside_out = dot(normal, jnp.sum(geometry.normals[geometry.faces], axis=1)) < 0
    return jnp.where(inside_out, -1, 1) * dot(normal, to_light) > 0
