"""Sheets of triangles without gaps and overlaps: every pixel centre has exactly one owner."""

import jax
import numpy as np
import pytest
import reference
from drawing import arrays, circle, corner_split, draw, fan, padded, perspective
from scipy.spatial import Delaunay

from diffrast import shapes
from diffrast.camera import world_to_clip
from diffrast.raster import rasterize

SIZE = 1024
CELLS = SIZE // 2 + 1
FACES = 2 * CELLS**2


@jax.jit
def face_ids(positions_clip, faces):
    return rasterize(positions_clip, faces, height=SIZE, width=SIZE).face


def draw_large(positions_clip, faces):
    return np.asarray(face_ids(*padded(positions_clip, faces, 3 * FACES, FACES)))


def assert_one_owner(draw_ids, positions_clip, faces):
    """The sheet covers every pixel once, whether its faces share their vertices or not.

    Multiplied by a power of two a face keeps its place on the screen, to the last bit, and changes
    its depth. With a digit of each face's number for the exponent, and then with the opposite
    exponents, any two faces that differ in that digit are drawn in both orders of depth: a pixel
    that both own would show first one and then the other.
    """
    ids = draw_ids(positions_clip, faces)
    assert np.all(ids >= 0)
    corners, split_faces = corner_split(positions_clip, faces)
    np.testing.assert_array_equal(draw_ids(corners, split_faces), ids)
    number, base = np.arange(len(faces)), 128
    while np.any(number):
        exponents = np.repeat(number % base - base // 2, 3)[:, None]
        for sign in (-1, 1):
            layered = np.ldexp(np.asarray(corners, np.float32), sign * exponents)
            np.testing.assert_array_equal(draw_ids(layered, split_faces), ids)
        number = number // base
    return ids


def near_edges(ids):
    """Number of pixels with another face beside or below them."""
    other = np.zeros(ids.shape, bool)
    other[:, :-1] |= ids[:, :-1] != ids[:, 1:]
    other[:-1] |= ids[:-1] != ids[1:]
    return np.sum(other)


def clip_from_pixels(pixels, w=1.0, size=SIZE):
    x, y = np.moveaxis(pixels / (size / 2), -1, 0)
    return np.stack([x - 1, 1 - y, 0 * x, 1 + 0 * x], axis=-1) * w


def lattice(seed=0):
    """Squares of 2 × 2 pixels with corners on pixel centres, cut along a random diagonal each.

    Every pixel centre is on a corner, a side or a diagonal. Returns positions in pixels, the faces,
    and which of them owns each pixel.
    """
    corner = 2.0 * np.arange(CELLS + 1) - 0.5
    pixels = np.stack(np.meshgrid(corner, corner), axis=-1).reshape(-1, 2)
    top_left = (np.arange(CELLS)[:, None] * (CELLS + 1) + np.arange(CELLS)).reshape(-1)
    top_right, bottom_left = top_left + 1, top_left + CELLS + 1
    bottom_right = bottom_left + 1
    falling = np.random.default_rng(seed).integers(0, 2, len(top_left)).astype(bool)
    last = np.where(falling, bottom_right, bottom_left), np.where(falling, top_left, top_right)
    upper = np.stack([top_left, last[0], top_right], axis=1)
    lower = np.stack([last[1], bottom_left, bottom_right], axis=1)
    faces = np.stack([upper, lower], axis=1).reshape(-1, 3)

    # By the top-left rule the centre lies a little to the right, and still less further down.
    column, row = np.meshgrid(np.arange(SIZE) + 1, np.arange(SIZE) + 1)
    cell = row // 2 * CELLS + column // 2
    x, y = column % 2, row % 2
    is_lower = np.where(falling[cell], x < y, x + y >= 2)
    return pixels, faces, 2 * cell + is_lower


def test_owners_of_a_million_centres_on_edges():
    pixels, faces, owner = lattice()
    flat = clip_from_pixels(pixels)
    np.testing.assert_array_equal(assert_one_owner(draw_large, flat, faces), owner)
    w = np.random.default_rng(1).uniform(0.5, 2, (len(pixels), 1))
    np.testing.assert_array_equal(draw_large(clip_from_pixels(pixels, w), faces), owner)


def test_shared_edges_anywhere():
    rng = np.random.default_rng(2)
    pixels, faces, _ = lattice()
    jitter = rng.uniform(-0.48, 0.48, pixels.shape)  # the squares stay convex
    w = rng.uniform(0.5, 2, (len(pixels), 1))
    sheet = clip_from_pixels(pixels + np.where(rng.random((len(pixels), 1)) < 0.2, 0, jitter), w)
    assert near_edges(assert_one_owner(draw_large, sheet, faces)) > 800_000


def test_shared_edges_of_faces_of_all_sizes():
    rng = np.random.default_rng(3)
    frame = np.array([[-9, -9], [1033, -9], [-9, 1033], [1033, 1033]])
    dense = 512 + 512 * rng.uniform(-1, 1, (12000, 2)) ** 5
    sparse = rng.integers(0, SIZE, (4000, 2)) + 0.5
    pixels = np.concatenate([frame, dense, sparse])
    faces = Delaunay(pixels).simplices
    w = rng.uniform(0.5, 2, (len(pixels), 1))
    ids = assert_one_owner(draw_large, clip_from_pixels(pixels, w), faces)
    assert near_edges(ids) > 100_000


@pytest.mark.parametrize("count", [4, 7, 1500])
@pytest.mark.parametrize("radius", [1200.0, 1e5])
def test_shared_edges_of_large_faces_and_slivers(count, radius):
    # The far rim is beyond the guard band: spokes have one end without a fixed-point position.
    pixels, faces = fan((400.5, 300.5), 512.5 + radius * circle(count)[:, :2])
    assert near_edges(assert_one_owner(draw_large, clip_from_pixels(pixels), faces)) > 30 * count


def ids_of_draw(positions_clip, faces):
    return np.asarray(draw(positions_clip, faces).face)


def test_inside_closed_surfaces():
    # Faces before, beside and behind the eye; the solids are convex: every ray meets one face.
    rng = np.random.default_rng(6)
    solids = [arrays(shapes.cube()), *(arrays(shapes.icosphere(level)) for level in range(3))]
    for _ in range(10):
        for positions, faces in solids:
            scale = 10 ** rng.uniform(-2, 2)
            eye, direction = scale * 0.4 * rng.uniform(-1, 1, 3), rng.normal(size=3)
            camera = perspective(
                eye, eye + direction, fov_y=rng.uniform(0.3, 2.5), near=1e-4 * scale, far=9 * scale
            )
            assert_one_owner(ids_of_draw, world_to_clip(camera, scale * positions), faces)


@pytest.mark.parametrize("height", [1e-3, 1.0])
def test_ground_under_the_viewer(height):
    rng = np.random.default_rng(4)
    points = rng.normal(size=(600, 2)) * 10 ** rng.uniform(-2, 3, (600, 1))
    points = np.concatenate([points, 1e5 * circle(9)[:, :2]])
    positions = np.insert(points, 1, 0.0, axis=1)
    camera = perspective((0, height, 0), (0, 0, -2 * height), near=1e-3 * height, far=1e6)
    faces = Delaunay(points).simplices
    assert_one_owner(ids_of_draw, world_to_clip(camera, positions), faces)


@pytest.mark.parametrize("roll", [0.0, 0.4, 1.5])
def test_edges_with_both_ends_far_outside(roll):
    # A zigzag between two lines to the far left and right of a viewer above the ground.
    along = np.array([-1e4, *np.linspace(-9, 9, 300), 1e4])
    left_right = np.where(np.arange(302) % 2, -1e4, 1e4)
    positions = np.stack([left_right, 0 * along, along], axis=1)
    faces = np.arange(300)[:, None] + np.arange(3)
    up = np.sin(roll), np.cos(roll), 0
    camera = perspective((0, 1, 0), (0, 0, -1.5), up, near=1e-3, far=1e5)
    ids = assert_one_owner(ids_of_draw, world_to_clip(camera, positions), faces)
    assert near_edges(ids) > 2000


def test_single_faces_own_what_exact_arithmetic_says():
    # Corners on pixel centres, quarter pixels or the finest grid, w a power of two: all exact.
    size, count = 16, 48
    rng = np.random.default_rng(5)
    steps = np.repeat([1, 1, 4, 1024], count // 4)[:, None, None]
    pixels = 8.5 + rng.integers(-10 * steps, 10 * steps + 1, (count, 3, 2)) / steps
    clip = clip_from_pixels(pixels, 2.0 ** rng.integers(-2, 3, (count, 3, 1)), size)
    clip = clip.astype(np.float32)

    @jax.jit
    @jax.vmap
    def alone(corners):
        return rasterize(corners, np.arange(3)[None], height=size, width=size).face == 0

    owned = np.asarray(alone(clip))
    every = clip.reshape(-1, 4), np.arange(3 * count).reshape(-1, 3), size, size
    np.testing.assert_array_equal(owned, reference.exact_owned(*every))
    on_outline = reference.exact_location(*every) == 0
    assert np.sum(on_outline) > 100
    assert 0.1 < np.mean(owned[on_outline]) < 0.9
