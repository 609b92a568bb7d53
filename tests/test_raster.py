"""Which face each pixel sees, against the float64 oracle, and what must not change the answer."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from diffrast import shapes
from diffrast.camera import Camera, stack_cameras, world_to_clip
from diffrast.raster import Fragments, rasterize

HEIGHT, WIDTH = 96, 128
VERTICES, FACES = 6144, 2048  # every mesh is padded to these: one program draws them all

compiled = jax.jit(rasterize, static_argnames=("height", "width", "cull_backfaces"))


def padded(positions_clip, faces):
    """The mesh with vertices that no face uses and faces without area."""
    positions_clip = np.asarray(positions_clip, np.float32)
    more = VERTICES - len(positions_clip), FACES - len(faces)
    positions_clip = np.pad(positions_clip, ((0, more[0]), (0, 0)), mode="edge")
    return positions_clip, np.pad(np.asarray(faces, np.int32), ((0, more[1]), (0, 0)))


def draw(positions_clip, faces, **options):
    options = {"height": HEIGHT, "width": WIDTH} | options
    return compiled(*padded(positions_clip, faces), **options)


# -------------------------------------------------------------------------------------- the scenes


def perspective(eye, target=(0, 0, 0), up=(0, 1, 0), fov_y=0.7, near=0.1, far=100.0):
    return Camera.perspective(
        eye=eye, target=target, up=up, fov_y=fov_y, aspect=WIDTH / HEIGHT, near=near, far=far
    )


def corner_split(corners):
    return corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3)


def soup(count, size, spread=1.0, seed=0):
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-spread, spread, (count, 1, 3))
    return corner_split(centres + rng.normal(0, size, (count, 3, 3)))


def fan(count, middle):
    """A disk of slivers round a point that is not its centre."""
    angle = 2 * np.pi * np.arange(count) / count
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    side = np.arange(count)
    faces = np.stack([side, np.roll(side, -1), np.full(count, count)], axis=1)
    return np.concatenate([rim, [middle]]), faces


def ground():
    corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [0, 0, 0]]) * 1e3
    return corners, np.array([[0, 4, 1], [1, 4, 2], [2, 4, 3], [3, 4, 0]])


def hills():
    y, x = np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 32), indexing="ij")
    return mesh(shapes.height_field(0.15 * np.sin(5 * x) * np.cos(4 * y) + 0.05 * np.sin(13 * x)))


def mesh(shape):
    return np.asarray(shape.vertices), np.asarray(shape.faces)


SPHERE, TEAPOT = mesh(shapes.icosphere(3)), mesh(shapes.teapot(4))
LOOKING_DOWN = {"target": (5, 0, -6), "far": 1e4}
PARALLEL = Camera.orthographic(eye=(1, 2, 3), target=(0, 0, 0), height=2.5, near=-9, far=9)
CABINET = Camera.phigs(
    view_reference_point=(0, 0, 0),
    view_plane_normal=(0, 0, 1),
    view_up=(0, 1, 0),
    projection_reference_point=(0.35, 0.35, 1),
    window=(-2, 2, -1.5, 1.5),
    front=3,
    back=-3,
    projection="parallel",
)
