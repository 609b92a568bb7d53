"""The colours of points on faces, one function a kind of shading."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from diffrast._stored import assemble, stored
from diffrast._topology import Topology
from diffrast.camera import Camera, direction_to_clip, viewpoint, world_to_clip
from diffrast.edges import Cast
from diffrast.geometry import (
    Geometry,
    Points,
    at_points,
    normals_at,
    positions_at,
    scene_topology,
)
from diffrast.light import (
    AmbientLight,
    Columns,
    DirectionalLight,
    Light,
    casts_shadow,
    dot_columns,
    needs_viewer_distance,
    normalize_columns,
    without_ambient,
)
from diffrast.linalg import where_finite
from diffrast.scene import Scene
from diffrast.shade import Reflectance, Surface, needs, phong
from diffrast.shadows import Reached, Shadows, cast, outlines, receive
from diffrast.texturing import Paints, texel_colors


class World(NamedTuple):
    """What shading knows besides the points."""

    scene: Scene
    camera: Camera
    geometry: Geometry
    shadows: Shadows | None
    paints: Paints = ()
    rays: Array | None = None  # `central_rays`; None with distortion


def cast_shadows(
    scene: Scene, camera: Camera, geometry: Geometry, points: Points, shading: str
) -> tuple[World, Reached]:
    """The world with the shadows that fall on points, and which lights reach those."""
    if shading == "unlit" or not any(map(casts_shadow, scene.lights)):
        return World(scene, camera, geometry, None), (None,) * len(scene.lights)
    neighbors = jnp.asarray(scene_topology(scene).neighbors)
    by_corner = shading == "gouraud"
    shadows, reached = cast(scene.lights, geometry, neighbors, points, by_corner)
    return World(scene, camera, geometry, shadows), reached


def cast_outlines(
    world: World, topology: Topology, positions_clip: Array, points: Points, reached: Reached
) -> Cast | None:
    """The outlines of shadows between the pixels of an image; None without shadows."""
    scene, camera, _, shadows = world[:4]
    if shadows is None:
        return None
    casting = [light for light in scene.lights if casts_shadow(light)]
    source = jnp.stack(
        [
            direction_to_clip(camera, -light.direction)
            if isinstance(light, DirectionalLight)
            else world_to_clip(replace(camera, distortion=None), light.position)
            for light in casting
        ]
    )
    weight = [0 if isinstance(light, DirectionalLight) else 1 for light in casting]
    lit = jnp.stack([part > 0 for part in reached if part is not None])
    return Cast(
        between=outlines(scene.lights, shadows, topology, positions_clip, points, lit),
        lit=lit,
        patches=topology.patches,
        turned=jnp.stack(shadows.turned),
        source=source,
        weight=jnp.array(weight, source.dtype),
        parallel=jnp.zeros((), bool),
    )


def receive_shadows(world: World, points: Points, told: Array | None = None) -> Reached:
    """Which lights reach points, where it is not `told` for those with shadows: 1, 0, or -1."""
    if world.shadows is None:
        return (None,) * len(world.scene.lights)
    return receive(world.scene.lights, world.shadows, points, told)


def glow(shading: str, world: World, light: Array, points: Points) -> Columns:
    """What one light adds to the colours of points that it reaches.

    Which light may differ from point to point: `light` counts those that cast shadows.
    """
    colors: list[Array] | None = None
    for i, own in enumerate(filter(casts_shadow, world.scene.lights)):
        alone = replace(world.scene, lights=(without_ambient(own),))
        lit = SHADERS[shading](world._replace(scene=alone, shadows=None), points, (None,))
        colors = (
            lit if colors is None else jax.tree.map(partial(jnp.where, light == i), lit, colors)
        )
    assert colors is not None
    return colors


def _shade_phong(world: World, points: Points, reached: Reached) -> Columns:
    scene, camera, geometry = world[:3]
    normal = normals_at(geometry, points)
    reflectance = _reflectance(scene, geometry.object_of_face, points.face)
    texel = texel_colors(scene, world.paints, geometry, points)
    if texel is not None:
        reflectance = reflectance._replace(
            ambient=_times(reflectance.ambient, texel), diffuse=_times(reflectance.diffuse, texel)
        )
    with_position, with_viewer = needs(scene.lights, reflectance.specular is not None)
    position = positions_at(geometry, points) if with_position else None
    to_viewer = _to_viewer(world, position, points.place) if with_viewer else None
    distance = _viewer_distance(scene.lights, camera, position)
    surface = Surface(normal, position, to_viewer, distance)
    return phong(surface, reflectance, scene.lights, reached)


def _shade_gouraud(world: World, points: Points, reached: Reached) -> Columns:
    """Interpolate the colours of vertices; of each light with shadows apart, which are sharp."""
    scene, camera, geometry = world[:3]
    assert geometry.normals is not None
    vertices = jnp.arange(geometry.positions.shape[0])
    reflectance = _reflectance(scene, geometry.object_of_vertex, vertices)
    _, with_viewer = needs(scene.lights, reflectance.specular is not None)
    corners = jnp.concatenate([geometry.positions, geometry.normals], axis=1)
    texel = texel_colors(scene, world.paints, geometry, points)

    def shaded(reflectance: Reflectance, lights: tuple[Light, ...], corners: Array) -> Array:
        columns = [corners[:, i] for i in range(6)]
        position, normal = columns[:3], columns[3:]
        to_viewer = _to_viewer(world, position) if with_viewer else None
        distance = _viewer_distance(scene.lights, camera, position)
        surface = Surface(normal, position, to_viewer, distance)
        return assemble(stored(phong(surface, reflectance, lights)))

    def at_vertices(lights: tuple[Light, ...]) -> Columns:
        if texel is None:
            return interpolated(reflectance, lights)
        color = _times(interpolated(reflectance._replace(specular=None), lights), texel)
        if reflectance.specular is None:
            return color
        black = [jnp.zeros_like(texel[0], shape=())] * 3
        shine = interpolated(reflectance._replace(ambient=black, diffuse=black), lights)
        return [c + s for c, s in zip(color, shine, strict=True)]

    def interpolated(reflectance: Reflectance, lights: tuple[Light, ...]) -> Columns:
        color = where_finite(partial(shaded, reflectance, lights), corners)
        return at_points(color, geometry, points)

    everywhere, alone = [], []
    for light, part in zip(scene.lights, reached, strict=True):
        if part is None or isinstance(light, AmbientLight):
            everywhere.append(light)
            continue
        alone.append(without_ambient(light))
        if light.ambient is not None:
            everywhere.append(AmbientLight(light.ambient))
    color = at_vertices(tuple(everywhere))
    parts = [part for part in reached if part is not None]
    for light, part in zip(alone, parts, strict=True):
        color = [c + part * own for c, own in zip(color, at_vertices((light,)), strict=True)]
    return color


def _shade_unlit(world: World, points: Points, reached: Reached) -> Columns:
    scene, geometry = world.scene, world.geometry
    diffuse = _reflectance(scene, geometry.object_of_face, points.face).diffuse
    texel = texel_colors(scene, world.paints, geometry, points)
    if texel is not None:
        diffuse = _times(diffuse, texel)
    return [jnp.broadcast_to(channel, points.face.shape) for channel in diffuse]


SHADERS: dict[str, Callable[[World, Points, Reached], Columns]] = {
    "phong": _shade_phong,
    "gouraud": _shade_gouraud,
    "flat": _shade_phong,
    "unlit": _shade_unlit,
}


def _to_viewer(world: World, position: Columns | None, place: Columns | None = None) -> Columns:
    """Unit vectors; against the rays of pixels, which do not depend on what these show."""
    if world.rays is not None and place is not None:
        centre, right, down = world.rays
        x, y = (half_pixels / 2 for half_pixels in place)
        # Products are stored: whether XLA joins one with a sum depends on the program round it.
        across, up = stored(([x * part for part in right], [y * part for part in down]))
        back = [up[i] - across[i] - centre[i] for i in range(3)]
    else:
        assert position is not None
        eye = viewpoint(world.camera)
        back = [eye[i] - eye[3] * position[i] for i in range(3)]
    return normalize_columns(back)[0]


def _viewer_distance(
    lights: tuple[Light, ...], camera: Camera, position: Columns | None
) -> Array | None:
    """Distance of points from the origin of the eye system, if a light asks for it."""
    if not any(map(needs_viewer_distance, lights)):
        return None
    assert position is not None
    view = camera.view
    eye = [dot_columns(view[i], position) + view[i, 3] for i in range(3)]
    return normalize_columns(eye)[1]


def _times(colors: Columns, texel: Columns) -> Columns:
    return [a * b for a, b in zip(colors, texel, strict=True)]


def _reflectance(scene: Scene, object_of: Array, index: Array) -> Reflectance:
    """Material at each point: numbers if there is one object, else looked up by object."""
    materials = [item.material for item in scene.objects]
    specular = [m.specular for m in materials if m.specular is not None]
    if len(materials) == 1:
        material = materials[0]
        return Reflectance(
            [material.ambient[c] for c in range(3)],
            [material.diffuse[c] for c in range(3)],
            None if material.specular is None else [material.specular[c] for c in range(3)],
            material.shininess if specular else None,
            material.highlight == "blinn",
        )
    which = object_of[jnp.maximum(index, 0)]

    def looked_up(values: list[Array]) -> Columns:
        table = jnp.stack(values)
        return [table[:, c][which] for c in range(3)]

    none = jnp.zeros_like(materials[0].diffuse)
    blinn = [m.highlight == "blinn" for m in materials if m.specular is not None]
    mixed = jnp.array([m.highlight == "blinn" for m in materials])
    return Reflectance(
        looked_up([m.ambient for m in materials]),
        looked_up([m.diffuse for m in materials]),
        looked_up([none if m.specular is None else m.specular for m in materials])
        if specular
        else None,
        jnp.stack([m.shininess for m in materials])[which] if specular else None,
        mixed[which] if len(set(blinn)) > 1 else all(blinn),
    )
