"""Cameras, lights and materials as parameters of a fit, and how far they are from the truth.

A picture tells the products of the colours of light and material, not the factors. With an unknown
material the colours of the first light therefore keep the values they start with, and errors are
those of the products.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from common import View
from jax import Array

import diffrast as dr

Params = dict[str, Any]
CAMERA_PARAMETERS = 7


class Start(NamedTuple):
    """What parameters are relative to, and what is not fitted; a pytree of arrays.

    Attributes:
        mesh: what is seen.
        rotation: (3, 3) of the view.
        eye: (3,)
        pivot: (3,) the middle of the mesh.
        size: half the diagonal of its bounding box.
        lens: fov_y, near, far.
        lights: at the start.
        material: at the start.
        background: (3,)
    """

    mesh: dr.Mesh
    rotation: Array
    eye: Array
    pivot: Array
    size: Array
    lens: Array
    lights: tuple[dr.DirectionalLight | dr.PointLight, ...]
    material: dr.Material
    background: Array


def start_of(mesh: dr.Mesh, view: View) -> Start:
    """Where a fit of this mesh starts."""
    vertices = np.asarray(mesh.vertices)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return Start(
        mesh=mesh,
        rotation=view_rotation(view.camera),
        eye=jnp.asarray(view.camera["eye"], jnp.float32),
        pivot=jnp.asarray((low + high) / 2),
        size=jnp.asarray(np.linalg.norm(high - low) / 2),
        lens=jnp.asarray([view.camera[name] for name in ("fov_y", "near", "far")], jnp.float32),
        lights=view.lights,
        material=view.material,
        background=view.background,
    )


def start_parameters(
    view: View, *, camera: bool = True, lights: bool = True, material: bool = False
) -> Params:
    """Parameters of what is to be fitted, at the start."""
    params: Params = {}
    if camera:
        params["camera"] = jnp.zeros(CAMERA_PARAMETERS)
    if lights:
        params["lights"] = [
            {"move": jnp.zeros(2 if isinstance(light, dr.DirectionalLight) else 3)}
            | (
                {}
                if material and i == 0
                else {"diffuse": light.diffuse, "specular": light.specular}
            )
            for i, light in enumerate(view.lights)
        ]
    if material:
        params["material"] = {"diffuse": view.material.diffuse, "ambient": view.material.ambient}
        if view.material.specular is not None:
            params["material"]["specular"] = view.material.specular
            params["material"]["log_shininess"] = jnp.log(view.material.shininess)
    return params


def moved_camera(start: Start, parameters: Array) -> dict[str, Array]:
    """Describe the camera that seven parameters, all of the order of one, make of the start.

    They are a rotation vector about the pivot in the camera's axes (radians), the shift of the
    pivot in the picture (in half heights of it), the logarithm of the size of the mesh in the
    picture, and that of tan(fov_y / 2) while this size stays. Each moves the outlines by about its
    value times half the height of the picture, but for the last, which only changes perspective.
    """
    pivot_eye = start.rotation @ (start.pivot - start.eye)
    half_height = jnp.tan(start.lens[0] / 2)
    extent = -pivot_eye[2] * half_height  # half the height of what is seen at the pivot's depth
    new_extent = extent * jnp.exp(-parameters[5])
    new_half_height = half_height * jnp.exp(parameters[6])
    depth = new_extent / new_half_height
    across = (pivot_eye[:2] / extent + parameters[3:5]) * new_extent
    rotation = dr.linalg.so3_exp(parameters[:3]) @ start.rotation
    eye = start.pivot - rotation.T @ jnp.append(across, -depth)
    return {
        "eye": eye,
        "target": eye - depth * rotation[2],
        "up": rotation[1],
        "fov_y": 2 * jnp.arctan(new_half_height),
        "near": start.lens[1],
        "far": start.lens[2],
    }


def _moved_light(start: Start, index: int, params: Params) -> dr.DirectionalLight | dr.PointLight:
    light = start.lights[index]
    colors = {
        "ambient": light.ambient,
        "diffuse": params.get("diffuse", light.diffuse),
        "specular": params.get("specular", light.specular),
    }
    if isinstance(light, dr.DirectionalLight):
        direction = dr.fit.direction_update(light.direction, params["move"])
        return dr.DirectionalLight(direction=direction, **colors)
    position = light.position + start.size * params["move"]
    return dr.PointLight(position=position, attenuation=light.attenuation, **colors)


def appearance_of(start: Start, params: Params) -> tuple[Any, dr.Material]:
    """Lights and material of the parameters."""
    lights, material = start.lights, start.material
    if "lights" in params:
        lights = tuple(_moved_light(start, i, p) for i, p in enumerate(params["lights"]))
    if "material" in params:
        values = dict(params["material"])
        if "log_shininess" in values:
            values["shininess"] = jnp.exp(values.pop("log_shininess"))
        material = dr.Material(**values)
    return lights, material


def view_of(start: Start, params: Params) -> View:
    """Return the view that the parameters stand for."""
    camera = moved_camera(start, params.get("camera", jnp.zeros(CAMERA_PARAMETERS)))
    return View(camera, *appearance_of(start, params), start.background)


# Errors -------------------------------------------------------------------------------------------


def view_rotation(camera: dict[str, Any]) -> Array:
    """Rotation (3, 3) from the world to the eye space of a described camera."""
    return dr.Camera.perspective(**camera).view[:3, :3]


def camera_errors(camera: dict[str, Any], truth: dict[str, Any]) -> dict[str, float]:
    """Rotation and angle of view in degrees, position in percent of the distance to the target."""
    turn = dr.linalg.so3_log(view_rotation(camera) @ view_rotation(truth).T)
    eye, true_eye = np.asarray(camera["eye"]), np.asarray(truth["eye"])
    distance = np.linalg.norm(true_eye - np.asarray(truth["target"]))
    return {
        "rotation_degrees": float(np.degrees(np.linalg.norm(turn))),
        "eye_percent": float(100 * np.linalg.norm(eye - true_eye) / distance),
        "fov_degrees": float(np.degrees(abs(camera["fov_y"] - truth["fov_y"]))),
    }


def view_errors(view: View, truth: View, size: float) -> dict[str, float]:
    """Errors of camera, lights and the reflected colours light × material (their largest channel).

    Args:
        view: what was found.
        truth: what is true, with lights of the same types in the same order.
        size: half the diagonal of the mesh's bounding box, of which light positions are percents.
    """
    errors = camera_errors(view.camera, truth.camera)
    for i, (light, true) in enumerate(zip(view.lights, truth.lights, strict=True)):
        if isinstance(light, dr.DirectionalLight):
            units = [dr.linalg.normalize(item.direction) for item in (light, true)]
            angle = 2 * np.arcsin(min(float(jnp.linalg.norm(units[0] - units[1])) / 2, 1.0))
            errors[f"light_{i}_degrees"] = float(np.degrees(angle))
        else:
            offset = np.linalg.norm(light.position - true.position)
            errors[f"light_{i}_position_percent"] = float(100 * offset / size)
        for kind in ("diffuse", "specular"):
            own, other = getattr(view.material, kind), getattr(truth.material, kind)
            if own is not None and other is not None:
                difference = getattr(light, kind) * own - getattr(true, kind) * other
                errors[f"light_{i}_{kind}"] = float(jnp.max(jnp.abs(difference)))
    if view.material.specular is not None and truth.material.specular is not None:
        errors["shininess_percent"] = float(
            100 * abs(view.material.shininess / truth.material.shininess - 1)
        )
    return errors
