"""Pictures for the tests: many meshes in one size, so that one compiled program draws them all."""

import jax
import numpy as np

from diffrast.camera import Camera
from diffrast.raster import rasterize

HEIGHT, WIDTH = 96, 128
FACES = 2048
VERTICES = 3 * FACES

compiled = jax.jit(rasterize, static_argnames=("height", "width", "cull_backfaces"))


def draw(positions_clip, faces, cull_backfaces=False):
    """Rasterise a mesh in single precision."""
    positions_clip, faces = padded(positions_clip, faces, VERTICES, FACES)
    return compiled(
        positions_clip, faces, height=HEIGHT, width=WIDTH, cull_backfaces=cull_backfaces
    )


def padded(positions_clip, faces, vertices, count):
    """The mesh with vertices that no face uses, and with faces without area."""
    positions_clip = np.asarray(positions_clip, np.float32)
    rest = ((0, vertices - len(positions_clip)), (0, 0))
    positions_clip = np.pad(positions_clip, rest, mode="edge")
    return positions_clip, np.pad(np.asarray(faces, np.int32), ((0, count - len(faces)), (0, 0)))


def perspective(eye, target=(0, 0, 0), up=(0, 1, 0), fov_y=0.7, near=0.1, far=100.0):
    return Camera.perspective(
        eye=eye, target=target, up=up, fov_y=fov_y, aspect=WIDTH / HEIGHT, near=near, far=far
    )


def arrays(mesh):
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def corner_split(positions, faces):
    """Every face with vertices of its own."""
    corners = np.asarray(positions)[faces]
    return corners.reshape(-1, corners.shape[-1]), np.arange(3 * len(faces)).reshape(-1, 3)


def soup(count, size, spread=1.0, seed=0):
    """Random triangles round random centres."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-spread, spread, (count, 1, 3))
    corners = centres + size * rng.normal(size=(count, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def fan(middle, rim):
    """Triangles between a point and the sides of a polygon."""
    side = np.arange(len(rim))
    faces = np.stack([side, np.roll(side, -1), np.full(len(rim), len(rim))], axis=1)
    return np.concatenate([rim, [middle]]), faces


def circle(count):
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
