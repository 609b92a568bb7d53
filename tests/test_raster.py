"""Which face each pixel sees: against the float64 oracle, and what must not change the answer."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from drawing import (
    HEIGHT,
    WIDTH,
    arrays,
    circle,
    compiled,
    draw,
    fan,
    perspective,
    soup,
)

from diffrast import shapes
from diffrast.camera import Camera, world_to_clip
from diffrast.raster import rasterize
from diffrast.raster.edge_functions import Edge, Image, corners_of, edge_value, set_up
from diffrast.raster.fixed_point import snap_vertices, subpixel_bits

RNG = np.random.default_rng(0)

# ------------------------------------------------------------------------------------- the oracle


def ground(size=1e3):
    return fan((0, 0, 0), size * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]]))


def hills():
    y, x = np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 32), indexing="ij")
    return arrays(shapes.height_field(0.15 * np.sin(5 * x) * np.cos(4 * y) + 0.05 * np.sin(13 * x)))


SPHERE, TEAPOT = arrays(shapes.icosphere(3)), arrays(shapes.teapot(4))
SLIVERS = fan((0.01, 0.02, 0), circle(2000))
PIERCING = soup(30, 1.0, spread=0)
MIXED = soup(300, 10 ** RNG.uniform(-2, 3, (300, 1, 1)))
ABOVE = {"target": (5, 0, -6), "far": 1e4}
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
SCENES = {
    "sphere": (SPHERE, perspective((1.2, 1, 3))),
    "inside a sphere": (SPHERE, perspective((0.2, 0.1, 0.3), fov_y=2.1, near=0.01)),
    "cut by near and far": (SPHERE, perspective((0, 0, 1.5), near=0.7, far=1.9)),
    "teapot": (TEAPOT, perspective((3, -6, 4), (0, 0, 1.5), (0, 0, 1))),
    "inside the teapot": (
        TEAPOT,
        perspective((0.3, 0.2, 1), (2, 0, 1.3), (0, 0, 1), fov_y=1.5, near=0.01),
    ),
    "soup": (soup(300, 0.28), perspective((0, 0, 4))),
    "soup round the eye": (soup(300, 0.2), perspective((0, 0, 0.1), fov_y=1.2, near=1e-3)),
    "all sizes": (MIXED, perspective((0, 0, 4), near=0.01, far=1e4)),
    "ground": (ground(), perspective((0.3, 1, 0.7), near=0.01, **ABOVE)),
    "ground at the chin": (ground(), perspective((0.3, 0.01, 0.7), near=1e-3, **ABOVE)),
    "slivers": (SLIVERS, perspective((0.3, 0.2, 2.5))),
    "slivers from near": (SLIVERS, perspective((0.01, 0.02, 0.5), (0.01, 0.02, 0))),
    "hills": (hills(), perspective((0, -2.2, 1.4), up=(0, 0, 1))),
    "piercing": (PIERCING, perspective((0, 0, 5))),
    "parallel soup": (soup(300, 0.28), PARALLEL),
    "oblique teapot": (TEAPOT, CABINET),
    "oblique piercing": (PIERCING, CABINET),
}


def clear(truth, tolerance=1e-3):
    """Pixels that are no matter of rounding."""
    return (truth.edge_distance > tolerance) & (truth.depth_gap > 1e-5)


def steepness(positions_clip, faces):
    """Sine-like measure of how far each face's plane passes from the eye; 0 is seen edge-on."""
    corners = np.asarray(positions_clip, np.float64)[faces][..., [0, 1, 3]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=-1) * np.abs(corners).max(axis=(1, 2))
    return np.abs(np.sum(corners[:, 0] * normal, axis=-1)) / np.where(size > 0, size, 1)


def assert_agrees(fragments, truth, positions_clip, faces, tolerance=1e-3):
    face = np.asarray(fragments.face)
    decided = clear(truth, tolerance)
    assert np.mean(decided) > 0.97
    np.testing.assert_array_equal(face[decided], truth.face[decided])
    seen = (face == truth.face) & (face >= 0)
    # Single precision knows the depth of a face seen edge-on less well.
    allowed = 1e-5 * np.maximum(1, 0.01 / steepness(positions_clip, faces)[face[seen]])
    error = np.abs(fragments.barycentrics - truth.barycentrics).max(axis=-1)[seen]
    assert np.all(error <= allowed)
    ratio = np.asarray(fragments.inverse_depth)[seen] / truth.inverse_depth[seen]
    assert np.all(np.abs(ratio - 1) <= allowed)
    background = face < 0
    assert not np.any(np.asarray(fragments.barycentrics)[background])
    assert not np.any(np.asarray(fragments.inverse_depth)[background])


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_the_oracle(name):
    (positions, faces), camera = SCENES[name]
    positions_clip = np.asarray(world_to_clip(camera, positions))
    truth = reference.rasterize(positions_clip, faces, HEIGHT, WIDTH)
    assert np.mean(truth.face >= 0) > 0.1
    assert_agrees(draw(positions_clip, faces), truth, positions_clip, faces)


def test_culled_faces_are_those_of_the_oracle():
    for (positions, faces), camera in (SCENES["soup"], SCENES["soup round the eye"]):
        positions_clip = np.asarray(world_to_clip(camera, positions))
        truth = reference.rasterize(positions_clip, faces, HEIGHT, WIDTH, cull_backfaces=True)
        assert_agrees(draw(positions_clip, faces, True), truth, positions_clip, faces)
    positions, faces = SPHERE
    outside, inside = (
        world_to_clip(SCENES[name][1], positions) for name in ("sphere", "inside a sphere")
    )
    assert_same(draw(outside, faces, True), draw(outside, faces))
    assert_same(draw(inside, faces[:, ::-1], True), draw(inside, faces[:, ::-1]))
    assert np.all(draw(inside, faces, True).face == -1)


@pytest.mark.parametrize(
    ("function", "height", "width"),
    [(compiled, 1, 1), (rasterize, 3, 2), (compiled, 4, 4096)],
    ids=["one pixel", "3 x 2, not compiled", "4 x 4096"],
)
def test_images_of_odd_sizes(function, height, width):
    positions_clip = np.random.default_rng(1).normal(size=(60, 4)).astype(np.float32)
    faces = np.arange(60).reshape(-1, 3)
    truth = reference.rasterize(positions_clip, faces, height, width)
    fragments = function(positions_clip, faces, height=height, width=width)
    assert_agrees(fragments, truth, positions_clip, faces)


def test_large_image():
    height, width, every = 2000, 3000, 20
    positions, faces = shapes.icosahedron().vertices, np.asarray(shapes.icosahedron().faces)
    camera = perspective((0.7, 0.4, 1.3), fov_y=1.0, near=0.6, far=1.5)
    positions_clip = np.asarray(world_to_clip(camera, positions))
    fragments = compiled(positions_clip, faces, height=height, width=width)
    row, column = 7, 13
    part = jax.tree.map(lambda image: image[row::every, column::every], fragments)
    offset = (column + 0.5) / every, (row + 0.5) / every
    truth = reference.rasterize(
        positions_clip, faces, height // every, width // every, offset=offset
    )
    assert len(np.unique(truth.face)) > 4
    assert_agrees(part, truth, positions_clip, faces, tolerance=1e-3 / every)


def test_fixed_point_fits_its_range():
    assert [subpixel_bits(1, size) for size in (1, 8192, 8194, 16384, 16386)] == [10, 10, 9, 9, 8]


@pytest.mark.parametrize("size", [5793, 8192, 16384])
def test_edges_of_pictures_as_wide_as_the_guard_band(size):
    """Faces round the picture's border, of which most corners are beyond the guard band."""
    rng = np.random.default_rng(2)
    about = rng.uniform(-1.3, 1.3, (4000, 1, 2))
    corners = (about + rng.uniform(-0.4, 0.4, (4000, 3, 2))).reshape(-1, 2)
    w = 2.0 ** rng.integers(-2, 3, (12000, 1))  # powers of two, which take no digit of the corners
    corners = corners.astype(np.float32).astype(float)
    clip = jnp.asarray(np.concatenate([corners, 0 * w, 0 * w + 1], axis=1) * w, jnp.float32)
    vertices = snap_vertices(clip, height=size, width=size)
    faces = jnp.arange(12000, dtype=jnp.int32).reshape(-1, 3)
    image = Image(size, size, subpixel_bits(size, size))
    edges = set_up(corners_of(vertices, faces, jnp.arange(4000)), image, False).edges
    places = rng.integers(0, size, (2, 300))
    places[:, :150] = np.where(places[:, :150] < size // 2, 5, size - 5)  # of the image's corners
    column, row = jnp.asarray(places, jnp.int32)
    values = edge_value(Edge(*(member[..., None] for member in edges)), column, row)
    inside = np.all(np.asarray(values) >= 0, axis=0)

    x, y = ((2 * place + 1) / size - 1 for place in places)
    a = corners.reshape(-1, 3, 2) * [1, -1]
    b = np.roll(a, -1, axis=1)
    cross = (b - a)[..., :1] * (y - a[..., 1:]) - (b - a)[..., 1:] * (x - a[..., :1])
    distance = cross / np.linalg.norm(b - a, axis=-1, keepdims=True) * size / 2
    truth = np.all(distance > 0, axis=1) | np.all(distance < 0, axis=1)
    sure = np.min(np.abs(distance), axis=1) > 4 / 1024 * 2 ** (10 - image.bits)
    assert np.sum(truth & sure) > 5000
    np.testing.assert_array_equal(inside[sure], truth[sure])


# ----------------------------------------------------------------- what must not change the answer


def soup_clip(name="soup"):
    (positions, faces), camera = SCENES[name]
    return np.array(world_to_clip(camera, positions)), faces


def renumbered(fragments, ids):
    face = np.asarray(fragments.face)
    return dataclasses.replace(fragments, face=jnp.asarray(np.where(face < 0, -1, ids[face])))


def assert_same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("name", ["soup", "soup round the eye", "parallel soup"])
def test_order_of_faces_and_repetition_change_nothing(name):
    positions_clip, faces = soup_clip(name)
    once, again = draw(positions_clip, faces), draw(positions_clip, faces)
    assert_same(once, again)
    order = np.random.default_rng(1).permutation(len(faces))
    shuffled = draw(positions_clip, faces[order])
    assert_same(once, renumbered(shuffled, order))


@pytest.mark.parametrize("exponent", [-66, 50])
def test_scale_of_clip_coordinates_changes_nothing(exponent):
    for name in ("soup", "soup round the eye", "ground"):
        positions_clip, faces = soup_clip(name)
        usual = draw(positions_clip, faces)
        scaled = draw(np.ldexp(positions_clip, exponent), faces)
        inverse_depth = jnp.ldexp(scaled.inverse_depth, exponent)
        assert_same(dataclasses.replace(scaled, inverse_depth=inverse_depth), usual)


@pytest.mark.parametrize("name", ["soup", "parallel soup", "ground"])
def test_first_of_coincident_faces_is_seen(name):
    positions_clip, faces = soup_clip(name)
    count = len(faces)
    twice = draw(positions_clip, np.concatenate([faces, faces]))
    assert_same(twice, draw(positions_clip, faces))
    copies = np.concatenate([positions_clip, positions_clip])
    behind = draw(copies, np.concatenate([faces + len(positions_clip), faces]))
    assert np.max(behind.face) < count


def test_faces_out_of_view_leave_the_background():
    positions, faces = SPHERE
    cameras = {
        "behind": perspective((0, 0, 4), (0, 0, 9)),
        "beside": perspective((0, 0, 4), (9, 0, 4)),
        "nearer than near": perspective((0, 0, 4), near=6),
        "farther than far": perspective((0, 0, 4), far=2),
    }
    for camera in cameras.values():
        empty = draw(world_to_clip(camera, positions), faces)
        assert np.all(empty.face == -1)
        assert not np.any(empty.barycentrics)
        assert not np.any(empty.inverse_depth)


def test_near_and_far_plane_cut_every_sample():
    wall = np.array([[-1, -9, 2], [-1, 9, 2], [-1, 9, -50], [-1, -9, -50]])  # x = -1
    camera = Camera.perspective(
        eye=(0, 0, 0), target=(0, 0, -1), fov_y=np.pi / 2, near=2.0, far=8.0
    )
    fragments = draw(world_to_clip(camera, wall), [[0, 1, 2], [0, 2, 3]])
    x_ndc = 2 * (np.arange(WIDTH) + 0.5) / WIDTH - 1
    expected = (x_ndc > -1 / 2) & (x_ndc < -1 / 8)
    np.testing.assert_array_equal(fragments.face >= 0, np.tile(expected, (HEIGHT, 1)))
    depth = np.where(expected, -x_ndc, 0)  # x = -1 = x_ndc w
    np.testing.assert_allclose(fragments.inverse_depth, np.tile(depth, (HEIGHT, 1)), rtol=1e-5)


# ------------------------------------------------------------------------- degenerate and bad input


@pytest.mark.parametrize("name", ["soup", "parallel soup"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_faces_with_numbers_that_are_not_finite_are_not_drawn(name, value):
    positions_clip, faces = soup_clip(name)
    bad = np.tile(positions_clip[:3], (4, 1))
    bad[3 * np.arange(4), np.arange(4)] = value
    mixed = np.concatenate([bad, positions_clip])
    faces = np.concatenate([np.arange(12).reshape(-1, 3), faces + 12])
    fragments = draw(mixed, faces)
    usual = draw(positions_clip, faces[4:] - 12)
    assert_same(fragments, renumbered(usual, 4 + np.arange(len(faces))))


def test_any_corner_of_a_face_next_to_the_eye_may_be_the_first():
    """Two corners a millionth from the eye, in its plane or behind it, and one far away."""
    generator = np.random.default_rng(0)
    corners = generator.normal(size=(300, 3, 4)).astype(np.float32)
    corners[:, 1:] *= 1e-6
    corners[..., 2] = 0.9 * corners[..., 3]

    @jax.jit
    @jax.vmap
    def faces(positions):
        turns = [[0, 1, 2], [1, 2, 0], [2, 0, 1]]
        return [rasterize(positions, jnp.array([f]), height=8, width=8).face for f in turns]

    first, second, third = (np.asarray(image) for image in faces(corners))
    np.testing.assert_array_equal(second, first)
    np.testing.assert_array_equal(third, first)
    assert 0.1 < np.mean(first == 0) < 0.5
    for positions, image in zip(corners[:50].astype(float), first, strict=False):
        want = reference.rasterize(positions, [[0, 1, 2]], 8, 8)
        clear = want.edge_distance > 0.01
        np.testing.assert_array_equal(image[clear], want.face[clear])


def test_faces_without_area_are_not_drawn():
    inside = np.array([[-0.5, -0.5, 0, 1], [0.5, -0.5, 0, 1], [0.5, 0.5, 0, 1]])
    line = np.array([[-0.5, -0.5, 0, 1], [0, 0, 0, 1], [0.5, 0.5, 0, 1]])
    point = np.zeros((3, 4))
    behind, at_eye = inside * [1, 1, 1, -1], inside * [1, 1, 1, 0]
    through_eye = np.array([[-1, 0, 0, 1], [1, 0, 0, 1], [0, 0, 0, -1]])  # in the plane y = 0
    repeated = inside[[0, 0, 1]]
    parts = [line, point, behind, at_eye, through_eye, repeated]
    count = 3 * len(parts)
    fragments = draw(np.concatenate(parts), np.arange(count).reshape(-1, 3))
    assert np.all(fragments.face == -1)
    with_face = draw(np.concatenate([*parts, inside]), np.arange(count + 3).reshape(-1, 3))
    assert set(np.unique(with_face.face)) == {-1, len(parts)}
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(with_face))


TRIANGLE = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [0, 1, 0, 1]], np.float32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions_clip": TRIANGLE[:, :3]}, r"positions_clip: wanted shape \(V, 4\), got \(3, 3"),
        ({"positions_clip": TRIANGLE[None]}, r"positions_clip: wanted shape \(V, 4\), got \(1, 3"),
        ({"positions_clip": TRIANGLE * np.nan}, "positions_clip: wanted finite numbers, got nan"),
        ({"positions_clip": TRIANGLE * 1j}, "positions_clip: wanted real numbers"),
        ({"positions_clip": "triangle"}, "positions_clip: wanted an array of numbers"),
        ({"faces": [[0, 1]]}, r"faces: wanted shape \(F, 3\), got \(1, 2\)"),
        ({"faces": [0, 1, 2]}, r"faces: wanted shape \(F, 3\), got \(3,\)"),
        ({"faces": [[0, 1, 3]]}, r"faces: wanted indices in \[0, 3\), got 3"),
        ({"faces": [[0, 1, -1]]}, r"faces: wanted indices in \[0, 3\), got -1"),
        ({"faces": [[0.0, 1.0, 2.0]]}, "faces: wanted integers, got dtype float"),
        ({"faces": np.zeros((0, 3), int)}, "faces: wanted at least one face, got none"),
        ({"height": 0}, "height: wanted an integer of at least 1, got 0"),
        ({"width": -3}, "width: wanted an integer of at least 1, got -3"),
        ({"width": True}, "width: wanted an integer of at least 1, got True"),
    ],
)
def test_bad_input(change, message):
    arguments = {"positions_clip": TRIANGLE, "faces": np.array([[0, 1, 2]])}
    with pytest.raises(ValueError, match=message):
        rasterize(**(arguments | {"height": 2, "width": 2} | change))
