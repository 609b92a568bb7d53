"""Cameras, lights and materials as parameters, and their fit to a picture, coarse to fine.

The derivative of `diffrast.render` is that of the faces that are seen; what an outline does when
the camera moves is not part of it. So the derivative by the camera is taken here by central
differences of pictures, two renders for each of its seven parameters, with steps about as long as
the picture is blurred; that by lights and materials is the renderer's own, in forward mode.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import diffrast as dr

Params = dict[str, Any]


class CameraGuess(NamedTuple):
    """Where a fit of the camera starts: `rotation` is that of the view, (3, 3)."""

    rotation: Any
    eye: Any
    pivot: Any
    fov_y: Any
    near: Any
    far: Any


def camera_guess(camera: dict[str, Any], mesh: dr.Mesh) -> CameraGuess:
    """Turn a description (eye, target, up, fov_y, near, far) into a start that turns about `mesh`."""
    view = np.asarray(dr.Camera.perspective(**camera).view)
    vertices = np.asarray(mesh.vertices)
    pivot = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    eye = np.asarray(camera["eye"], np.float32)
    numbers = (np.float32(camera[name]) for name in ("fov_y", "near", "far"))
    return CameraGuess(view[:3, :3], eye, pivot, *numbers)


def moved_camera(guess: CameraGuess, parameters: Array) -> dict[str, Array]:
    """Describe the camera that seven parameters, all of the order of one, make of the guess.

    They are a rotation vector about the pivot in the camera's axes (radians), the shift of the
    pivot in the picture (in half heights of it), the logarithm of the size of the picture of the
    mesh, and that of tan(fov_y / 2) while the size stays. Each moves the outlines by about its
    value times half the height of the picture, but for the last, which only changes perspective.
    """
    pivot_eye = guess.rotation @ (guess.pivot - guess.eye)
    half_height = jnp.tan(guess.fov_y / 2)
    extent = -pivot_eye[2] * half_height
    new_extent = extent * jnp.exp(-parameters[5])
    new_half_height = half_height * jnp.exp(parameters[6])
    across = (pivot_eye[:2] / extent + parameters[3:5]) * new_extent
    new_pivot_eye = jnp.append(across, -new_extent / new_half_height)
    rotation = dr.linalg.so3_exp(parameters[:3]) @ guess.rotation
    return {
        "eye": guess.pivot - rotation.T @ new_pivot_eye,
        "direction": -rotation[2],
        "up": rotation[1],
        "fov_y": 2 * jnp.arctan(new_half_height),
        "near": guess.near,
        "far": guess.far,
    }
