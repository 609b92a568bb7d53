"""The shadows of all lights of a scene."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._device import over_views
from diffrast._stored import looked_up, stored
from diffrast._topology import Edges
from diffrast.geometry import Geometry, Points, positions_at
from diffrast.light import DirectionalLight, Light, ShiningLight, casts_shadow
from diffrast.linalg import dot
from diffrast.mesh import face_normals
from diffrast.raster.evaluate import unit_of
from diffrast.shadows.lit import lit
from diffrast.shadows.maps import Pictures, Plan, plan, take
from diffrast.shadows.near import Rays
from diffrast.shadows.views import LightView, Seen, light_view, see, sides, source

Reached: TypeAlias = tuple[Array | None, ...]  # by each light: 1 at points it reaches, or 0


class _Regard(NamedTuple):
    """How one light sees points, and which of them it shines on if nothing is between."""

    seen: Seen
    asked: Bool[Array, "*size"]


class Shadows(NamedTuple):
    """What all lights that cast shadows see."""

    views: tuple[LightView, ...]
    turned: tuple[Bool[Array, " faces"], ...]  # whether faces turn their outside to the light
    windows: tuple[Float[Array, "sides 4"], ...]
    pictures: tuple[Pictures, ...]  # one for each resolution, in ascending order
    geometry: Geometry  # in a unit in which products of lengths stay in range
    neighbors: Int[Array, "F 3"]  # of the faces that cast them


def cast(
    lights: tuple[Light, ...],
    geometry: Geometry,
    neighbors: Int[Array, "F 3"],
    points: Points,
    by_corner: bool = False,
) -> tuple[Shadows, Reached]:
    """Take the pictures of the lights that cast shadows, fitted to points.

    Args:
        lights: of the scene.
        geometry: of the scene.
        neighbors: of its faces, see `Topology`.
        points: that shadows may fall on.
        by_corner: whether light falls on the corners of faces, and is interpolated.

    Returns:
        The shadows, and what `receive` tells of these points.
    """
    lights, geometry, points = lax.stop_gradient((lights, geometry, points))
    unit = unit_of(geometry.positions)
    geometry = geometry._replace(positions=geometry.positions / unit)
    casting = [_in_unit(unit, light) for light in lights if casts_shadow(light)]
    with jax.named_scope("shadow"):
        corners = geometry.faces if by_corner else None
        views = [light_view(light, geometry.positions, corners) for light in casting]
        turned = [_turned_to(*both, geometry) for both in zip(casting, views, strict=True)]
        regards = _regards(casting, views, turned, geometry, points)
        windows, plans = zip(
            *(
                plan(light, view, seen, asked)
                for light, view, (seen, asked) in zip(casting, views, regards, strict=True)
            ),
            strict=True,
        )
        pictures = []
        for size, members in by_resolution(casting):
            joined = zip(*(plans[i] for i in members), strict=True)
            together = Plan(*(jnp.concatenate(column) for column in joined))
            pictures.append(take(together, geometry, size))
        shadows = Shadows(
            tuple(views), tuple(turned), windows, tuple(pictures), geometry, neighbors
        )
        return shadows, _reached(lights, shadows, points, regards)


def receive(
    lights: tuple[Light, ...],
    shadows: Shadows,
    points: Points,
    told: Int[Array, "lights *size"] | None = None,
) -> Reached:
    """1 where a light reaches points, 0 where it does not, None for a light without shadows.

    Arguments as of `cast`; points far away from those that the shadows were cast for have whatever
    shadow is near. What is `told` of the lights with shadows, 1 or 0, is not asked again; -1 where
    it is not known.
    """
    lights, points = lax.stop_gradient((lights, points))
    casting = [light for light in lights if casts_shadow(light)]
    with jax.named_scope("shadow"):
        regards = _regards(casting, shadows.views, shadows.turned, shadows.geometry, points)
        if told is None:
            return _reached(lights, shadows, points, regards)
        asked = [
            regard._replace(asked=regard.asked & (known < 0))
            for regard, known in zip(regards, told, strict=True)
        ]
        reached = _reached(lights, shadows, points, asked)
        known = iter(jnp.maximum(told, 0))
        return tuple(
            part if part is None else part + next(known).astype(part.dtype) for part in reached
        )


def shone_on(
    lights: tuple[Light, ...], shadows: Shadows, points: Points
) -> Bool[Array, "lights *size"]:
    """Whether lights with shadows would reach points if nothing were in between."""
    casting = [light for light in lights if casts_shadow(light)]
    regards = _regards(casting, shadows.views, shadows.turned, shadows.geometry, points)
    return jnp.stack([asked for _, asked in regards])


def terminators(shadows: Shadows, edges: Edges) -> Bool[Array, " edges"]:
    """Edges between a face that is turned to a light with shadows and one that is not."""
    found = jnp.zeros_like(edges.seam)
    for turned in shadows.turned:
        one, other = turned[jnp.maximum(edges.faces, 0)].T
        found = found | (one != other)
    return found & (edges.faces[:, 1] >= 0)


def by_resolution(lights: list[ShiningLight]) -> list[tuple[int, list[int]]]:
    """Resolutions in ascending order, each with the numbers of its lights."""
    sizes = [light.shadow.resolution for light in lights if light.shadow is not None]
    return [(size, [i for i, s in enumerate(sizes) if s == size]) for size in sorted(set(sizes))]


def _regards(
    lights: list[ShiningLight],
    views: Sequence[LightView],
    turned: Sequence[Bool[Array, " faces"]],
    geometry: Geometry,
    points: Points,
) -> list[_Regard]:
    points = points._replace(position=None)  # which is in the world's unit
    position = stored(positions_at(geometry, points))
    visible = jnp.maximum(points.face, 0)
    regards = []
    for light, view, outside in zip(lights, views, turned, strict=True):
        # By the position: what is the same for all points is not made, and held, before that.
        seen = stored(see(light, view, position), position[0])
        regards.append(_Regard(seen, seen.inside & outside[visible] & (points.face >= 0)))
    return regards


def _in_unit(unit: Float[Array, ""], light: ShiningLight) -> ShiningLight:
    if isinstance(light, DirectionalLight):
        return light
    return replace(light, position=light.position / unit)


def _turned_to(light: ShiningLight, view: LightView, geometry: Geometry) -> Bool[Array, " faces"]:
    """Whether the light is on that side of faces which the normals at their corners point to."""
    normal = face_normals(geometry.positions, geometry.faces_outward)
    corner = geometry.positions[geometry.faces_outward[:, 0]]
    place = source(light, view)
    inside_out = jnp.zeros(normal.shape[0], bool)
    if geometry.normals is not None:
        inside_out = dot(normal, jnp.sum(geometry.normals[geometry.faces], axis=1)) < 0
    outside = jnp.where(inside_out, -1, 1) * dot(normal, place[:3] - place[3] * corner) > 0
    return looked_up(outside, corner[0, 0])


def _reached(
    lights: tuple[Light, ...],
    shadows: Shadows,
    points: Points,
    regards: list[_Regard],
) -> Reached:
    """Look at all points of all lights of one resolution at once."""
    casting = [light for light in lights if casts_shadow(light)]
    reached: dict[int, Array] = {}
    face, shape = jnp.ravel(points.face), points.face.shape
    barycentrics = jnp.stack([jnp.ravel(b) for b in points.barycentrics])
    for pictures, (_, members) in zip(shadows.pictures, by_resolution(casting), strict=True):
        parts, first = [], 0
        for i in members:
            seen, asked = regards[i]
            window = shadows.windows[i]
            scale_x, scale_y, offset_x, offset_y = (
                window[0] if sides(casting[i]) == 1 else window.T[:, seen.side]
            )
            x, y = stored((scale_x * seen.x + offset_x, scale_y * seen.y + offset_y))
            columns = seen.side + first, x, y, seen.key, seen.unit, asked
            parts.append(Rays(face, barycentrics, *map(jnp.ravel, columns)))
            first += sides(casting[i])
        together = zip(*parts, strict=True)
        rays = Rays(*(jnp.concatenate(column, axis=-1) for column in together))
        own_lit = over_views(lit, face.size)(pictures, shadows.geometry, shadows.neighbors, rays)
        reached.update(zip(members, own_lit.reshape(len(members), *shape), strict=True))
    numbers = iter(range(len(casting)))
    return tuple(reached[next(numbers)] if casts_shadow(light) else None for light in lights)
