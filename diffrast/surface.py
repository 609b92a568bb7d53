"""The colours of points on faces, one function a kind of shading."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from diffrast.camera import Camera, viewpoint
from diffrast.geometry import Geometry, Points, at_points, flat_normals
from diffrast.light import (
    AmbientLight,
    Columns,
    Light,
    casts_shadow,
    normalize_columns,
    without_ambient,
)
from diffrast.scene import Scene
from diffrast.shade import Reflectance, Surface, needs, phong
from diffrast.shadows import Shadows, cast, receive


class World(NamedTuple):
    """What shading knows besides the points."""

    scene: Scene
    camera: Camera
    geometry: Geometry
    shadows: Shadows


def lit_world(
    scene: Scene, camera: Camera, geometry: Geometry, points: Points, shading: str
) -> World:
    """Take the lights' pictures for the shadows at points."""
    none: Shadows = (None,) * len(scene.lights)
    if shading == "unlit" or not any(map(casts_shadow, scene.lights)):
        return World(scene, camera, geometry, none)
    normal = smooth_normals(geometry, points)
    return World(scene, camera, geometry, cast(scene.lights, geometry, points, normal))


def smooth_normals(geometry: Geometry, points: Points) -> Columns | None:
    """Normals as interpolated by the shading, of any length; None for those of the faces."""
    if geometry.normals is None:
        return None
    return at_points(geometry.normals, geometry, points)


def reach(world: World, points: Points) -> list[Array | None]:
    """For each light whether it reaches points, None if it casts no shadows."""
    if all(shadow is None for shadow in world.shadows):
        return [None] * len(world.shadows)
    normal = smooth_normals(world.geometry, points)
    return receive(world.scene.lights, world.shadows, world.geometry, points, normal)


def _shade_phong(world: World, points: Points) -> Columns:
    scene, camera, geometry, _ = world
    normal = smooth_normals(geometry, points)
    if normal is None:
        normal = flat_normals(geometry, points.face)
    reflectance = _reflectance(scene, geometry.object_of_face, points.face)
    with_position, with_viewer = needs(scene.lights, reflectance.specular is not None)
    position = at_points(geometry.positions, geometry, points) if with_position else None
    to_viewer = _to_viewer(camera, position) if with_viewer else None
    surface = Surface(normal, position, to_viewer)
    return phong(surface, reflectance, scene.lights, reach(world, points))


def _shade_gouraud(world: World, points: Points) -> Columns:
    """Interpolate the colours of vertices; of each light with shadows apart, which are sharp."""
    scene, camera, geometry, shadows = world
    assert geometry.normals is not None
    vertices = jnp.arange(geometry.positions.shape[0])
    reflectance = _reflectance(scene, geometry.object_of_vertex, vertices)
    position = [geometry.positions[:, i] for i in range(3)]
    normal = [geometry.normals[:, i] for i in range(3)]
    _, with_viewer = needs(scene.lights, reflectance.specular is not None)
    to_viewer = _to_viewer(camera, position) if with_viewer else None
    surface = Surface(normal, position, to_viewer)

    def at_vertices(lights: tuple[Light, ...]) -> Columns:
        color = phong(surface, reflectance, lights)
        return at_points(jnp.stack(color, axis=-1), geometry, points)

    everywhere, alone = [], []
    for light, shadow in zip(scene.lights, shadows, strict=True):
        if shadow is None or isinstance(light, AmbientLight):
            everywhere.append(light)
            continue
        alone.append(without_ambient(light))
        if light.ambient is not None:
            everywhere.append(AmbientLight(light.ambient))
    color = at_vertices(tuple(everywhere))
    parts = [part for part in reach(world, points) if part is not None]
    for light, part in zip(alone, parts, strict=True):
        color = [c + part * own for c, own in zip(color, at_vertices((light,)), strict=True)]
    return color


def _shade_unlit(world: World, points: Points) -> Columns:
    scene, geometry = world.scene, world.geometry
    diffuse = _reflectance(scene, geometry.object_of_face, points.face).diffuse
    return [jnp.broadcast_to(channel, points.face.shape) for channel in diffuse]


SHADERS: dict[str, Callable[[World, Points], Columns]] = {
    "phong": _shade_phong,
    "gouraud": _shade_gouraud,
    "flat": _shade_phong,
    "unlit": _shade_unlit,
}


def _to_viewer(camera: Camera, position: Columns | None) -> Columns:
    assert position is not None
    eye = viewpoint(camera)
    return normalize_columns([eye[i] - eye[3] * position[i] for i in range(3)])[0]


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
        )
    which = object_of[jnp.maximum(index, 0)]

    def looked_up(values: list[Array]) -> Columns:
        table = jnp.stack(values)
        return [table[:, c][which] for c in range(3)]

    none = jnp.zeros(3, scene.background.dtype)
    return Reflectance(
        looked_up([m.ambient for m in materials]),
        looked_up([m.diffuse for m in materials]),
        looked_up([none if m.specular is None else m.specular for m in materials])
        if specular
        else None,
        jnp.stack([m.shininess for m in materials])[which] if specular else None,
    )
