"""Forms of the program for other devices than a CPU, run here on the CPU: they see the same."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawing import FACES, HEIGHT, VERTICES, WIDTH, padded
from test_raster import SCENES
from test_watertight import SIZE, clip_from_pixels, lattice

import diffrast as dr
from diffrast.camera import world_to_clip
from diffrast.raster import all_at_once, coverage
from diffrast.raster.all_at_once import draw_at_once
from diffrast.raster.one_by_one import draw_one_by_one

RNG = np.random.default_rng(0)
BOTH = [
    jax.jit(draw, static_argnames=("height", "width", "cull_backfaces"))
    for draw in (draw_one_by_one, draw_at_once)
]


def clip_of(name):
    (positions, faces), camera = SCENES[name]
    return padded(world_to_clip(camera, positions), faces, VERTICES, FACES)


def assert_same(positions_clip, faces, **options):
    (want, keys), (got, own_keys) = (draw(positions_clip, faces, **options) for draw in BOTH)
    np.testing.assert_array_equal(got, want)
    seen = np.asarray(want) >= 0
    np.testing.assert_array_equal(own_keys[~seen], -np.inf)
    scale = np.max(np.abs(keys[seen]), initial=0)
    np.testing.assert_allclose(own_keys[seen], keys[seen], atol=3e-6 * scale)
    return np.asarray(got)


@pytest.mark.parametrize("cull_backfaces", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_all_at_once_sees_what_one_by_one_sees(name, cull_backfaces):
    size = {"height": HEIGHT, "width": WIDTH}
    assert_same(*clip_of(name), **size, cull_backfaces=cull_backfaces)


@pytest.mark.parametrize("name", SCENES)
def test_all_at_once_in_double_precision(name):
    """Indices have 32 bits all the same: scatters warn where what they add has more."""
    with jax.enable_x64(True):
        positions_clip, faces = clip_of(name)
        assert_same(np.float64(positions_clip), faces, height=20, width=20, cull_backfaces=False)


@pytest.mark.parametrize("name", SCENES)
def test_faces_that_are_few_for_the_picture_are_drawn_in_larger_blocks(name):
    size = 192
    assert FACES * min(all_at_once._BLOCKS) ** 2 < size**2
    assert_same(*clip_of(name), height=size, width=size, cull_backfaces=False)


def test_of_equal_faces_the_same_one_is_seen():
    """Small ones come before large ones, then the lower number counts."""
    positions_clip, faces = clip_of("soup")
    order = RNG.integers(0, 300, FACES)
    large = np.concatenate([4 * positions_clip[:, :2], positions_clip[:, 2:]], axis=1)
    doubled = np.concatenate([positions_clip, large])
    faces = np.concatenate([faces[order] + VERTICES, faces[order]])
    flat = doubled * [1, 1, 0, 0] + [0, 0, 0, 1]
    size = {"height": HEIGHT, "width": WIDTH}
    ids = assert_same(np.float32(flat), faces, **size, cull_backfaces=False)
    assert np.all(np.unique(ids[ids >= FACES]) < 2 * FACES)


def test_owners_of_a_million_centres_on_edges():
    pixels, faces, owner = lattice()
    ids, _ = BOTH[1](
        np.float32(clip_from_pixels(pixels)), faces, height=SIZE, width=SIZE, cull_backfaces=False
    )
    np.testing.assert_array_equal(ids, owner)


def test_views_of_views_and_meshes_of_their_own(monkeypatch):
    """In several chunks of faces, and batches of blocks."""
    monkeypatch.setattr(all_at_once, "_FACES_AT_ONCE", 1000)
    monkeypatch.setattr(all_at_once, "_PIXELS_AT_ONCE", 256 * 16)
    scenes = [clip_of(name) for name in ("teapot", "soup round the eye", "parallel soup", "hills")]
    positions, faces = (jnp.stack(column) for column in zip(*scenes, strict=True))
    one = partial(draw_at_once, height=24, width=40, cull_backfaces=False)
    want = [BOTH[0](*scene, height=24, width=40, cull_backfaces=False)[0] for scene in scenes]
    got, _ = jax.vmap(one)(positions, faces)
    np.testing.assert_array_equal(got, want)
    shared, _ = jax.vmap(one, (0, None))(positions[::-1], faces[1])
    np.testing.assert_array_equal(shared[2], want[1])
    pairs = positions.reshape(2, 2, VERTICES, 4)
    got, _ = jax.vmap(jax.vmap(one))(pairs, faces.reshape(2, 2, FACES, 3))
    np.testing.assert_array_equal(got.reshape(4, 24, 40), want)
    got, _ = jax.vmap(jax.vmap(one, (None, 0)), (0, None))(positions[:2], faces[:2])
    np.testing.assert_array_equal([got[0, 0], got[1, 1]], want[:2])
    with pytest.raises(ValueError, match="positions_clip: wanted fewer at once, got 4 views of"):
        jax.eval_shape(
            jax.vmap(partial(one, height=1 << 15, width=1 << 15), (0, None)), positions, faces[0]
        )


@pytest.fixture
def as_elsewhere(monkeypatch, compiled_quickly):
    """As if programs were made for another device."""
    del compiled_quickly

    def change():
        jax.clear_caches()
        monkeypatch.setattr(jax, "default_backend", lambda: "another")
        monkeypatch.setattr(coverage, "draw_one_by_one", draw_at_once)
        monkeypatch.setattr(coverage, "draws_on_cpu", lambda: True)  # else the platform decides

    yield change
    jax.clear_caches()


def test_views_in_chunks_are_those_of_a_cpu(as_elsewhere):
    def picture(shared, eye):
        camera = dr.Camera.perspective(eye=eye, target=(0, 0, 0), fov_y=0.8, near=0.1, far=9)
        settings = dr.RenderSettings(height=9, width=9, antialias=False)
        return shared * dr.render(dr.Scene(objects=[dr.Object(dr.shapes.cube())]), camera, settings)

    eyes = np.float32(np.array([0, 0, 5]) + RNG.normal(size=(11, 3)))

    def found():
        many = dr.views.map_views(picture, eyes, 2.0, chunk=4)
        return many, dr.views.sum_views(jax.grad(lambda x, e: jnp.sum(picture(x, e))), eyes, 2.0)

    want = found()
    as_elsewhere()
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5), found(), want)


def test_pictures_and_gradients_with_edges_are_those_of_a_cpu(as_elsewhere):
    """Of bodies that pierce each other: of one view, and of views in groups."""
    ball, ring = dr.shapes.icosphere(1), dr.shapes.torus(major_segments=8, minor_segments=5)
    settings = dr.RenderSettings(height=20, width=20)
    weight = jnp.asarray(RNG.normal(size=(20, 20, 3)), jnp.float32)
    eyes, direction = jnp.array([[1.0, 2, 3], [-1, 2, 3], [1, 1, 4]]), jnp.array([-1.0, -1, -0.5])

    def picture(eye, direction):
        camera = dr.Camera.perspective(eye=eye, target=(0, 0, 0), fov_y=0.8, near=0.1, far=9)
        grey, moved = dr.Material(diffuse=(0.5, 0.6, 0.7)), dr.linalg.translation((0.5, 0.3, 0.2))
        objects = [dr.Object(ball, grey), dr.Object(ring, grey, moved)]
        light = dr.DirectionalLight(direction=direction)
        return dr.render(dr.Scene(objects=objects, lights=[light]), camera, settings)

    def loss(eye, direction):
        image = picture(eye, direction)
        return jnp.sum(weight * image), image

    gradient = jax.grad(loss, (0, 1), has_aux=True)
    one_by_one = jax.jit(gradient)
    want = jax.tree.map(lambda *x: jnp.stack(x), *(one_by_one(eye, direction) for eye in eyes))
    # Rounding must not decide which of the pixels round it changes as a surface does.
    for n, eye in enumerate(eyes):
        nearly, _ = one_by_one(eye + jnp.array([3e-7, -3e-7, 3e-7]), direction)
        same = partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-3)
        jax.tree.map(same, nearly, jax.tree.map(lambda part, n=n: part[n], want[0]))
    as_elsewhere()
    got = jax.jit(jax.vmap(gradient, (0, None)))(eyes, direction)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4), got, want)
    # What few pieces of edges hide is looked at in more detail: these are others here.
    alone = jax.jit(picture)(eyes[0], direction)
    assert np.mean(np.abs(alone - want[1][0])) < 1e-4


def test_pictures_with_shadows_are_those_of_a_cpu(as_elsewhere):
    """Of one view, and with edges of views in groups."""
    ball = dr.Object(dr.shapes.icosphere(1))
    floor = dr.Object(dr.shapes.cube(), transform=dr.linalg.translation((0, -2, 0)))
    light = dr.DirectionalLight(direction=(-1, -1, -0.5), shadow=dr.Shadow(resolution=32))
    scene = dr.Scene(objects=[ball, floor], lights=[light])
    eyes = jnp.array([[1.0, 2, 5], [-9, 2, 5], [0, 9, 1]])

    def picture(eye, **settings):
        camera = dr.Camera.perspective(eye=eye, target=(0, -1, 0), fov_y=0.8, near=0.1, far=19)
        return dr.render(scene, camera, dr.RenderSettings(**settings))

    jagged = {"height": 40, "width": 40, "antialias": False}
    one = jax.jit(partial(picture, height=20, width=20))
    want, views = picture(eyes[0], **jagged), jnp.stack([one(eye) for eye in eyes])
    as_elsewhere()
    np.testing.assert_allclose(picture(eyes[0], **jagged), want, atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.vmap(one))(eyes), views, rtol=1e-5, atol=1e-6)
