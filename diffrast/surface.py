"""The colours of points on faces, one function a kind of shading."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from diffrast.camera import Camera, viewpoint
from diffrast.geometry import Geometry, Points, at_points, flat_normals
from diffrast.light import Columns, normalize_columns
from diffrast.scene import Scene
from diffrast.shade import Reflectance, Surface, needs, phong


def _shade_phong(
    scene: Scene, camera: Camera, geometry: Geometry, pixels: Points, flat: bool = False
) -> Columns:
    if flat:
        normal = flat_normals(geometry, pixels.face)
    else:
        assert geometry.normals is not None
        normal = at_points(geometry.normals, geometry, pixels)
    reflectance = _reflectance(scene, geometry.object_of_face, pixels.face)
    with_position, with_viewer = needs(scene.lights, reflectance.specular is not None)
    position = at_points(geometry.positions, geometry, pixels) if with_position else None
    to_viewer = _to_viewer(camera, position) if with_viewer else None
    return phong(Surface(normal, position, to_viewer), reflectance, scene.lights)


def _shade_flat(scene: Scene, camera: Camera, geometry: Geometry, pixels: Points) -> Columns:
    return _shade_phong(scene, camera, geometry, pixels, flat=True)


def _shade_gouraud(scene: Scene, camera: Camera, geometry: Geometry, pixels: Points) -> Columns:
    assert geometry.normals is not None
    vertices = jnp.arange(geometry.positions.shape[0])
    reflectance = _reflectance(scene, geometry.object_of_vertex, vertices)
    position = [geometry.positions[:, i] for i in range(3)]
    normal = [geometry.normals[:, i] for i in range(3)]
    _, with_viewer = needs(scene.lights, reflectance.specular is not None)
    to_viewer = _to_viewer(camera, position) if with_viewer else None
    color = phong(Surface(normal, position, to_viewer), reflectance, scene.lights)
    return at_points(jnp.stack(color, axis=-1), geometry, pixels)


def _shade_unlit(scene: Scene, camera: Camera, geometry: Geometry, pixels: Points) -> Columns:
    diffuse = _reflectance(scene, geometry.object_of_face, pixels.face).diffuse
    return [jnp.broadcast_to(channel, pixels.face.shape) for channel in diffuse]


SHADERS: dict[str, Callable[..., Columns]] = {
    "phong": _shade_phong,
    "gouraud": _shade_gouraud,
    "flat": _shade_flat,
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
