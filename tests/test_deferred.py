"""Pixels shaded in batches are those of a whole image, in value and in every derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrast as dr
from diffrast import deferred
from diffrast.camera import pivoted_matrix
from diffrast.raster.evaluate import Drawn, Projection

pytestmark = pytest.mark.usefixtures("compiled_quickly")

HEIGHT, WIDTH = 24, 37  # no multiple of a run
MESH = dr.shapes.icosphere(1)
RNG = np.random.default_rng(0)
WEIGHTS = jnp.asarray(RNG.normal(size=(3, HEIGHT, WIDTH)), jnp.float32)
LIT = jnp.asarray(RNG.uniform(size=(HEIGHT, WIDTH)) < 0.6, jnp.float32)
VIEWS = jax.sharding.PartitionSpec("views")
START = {
    "eye": jnp.array([0.5, 0.4, 4.0]),
    "vertices": MESH.vertices,
    "color": jnp.ones(3),
    "background": jnp.array([0.1, 0.2, 0.3]),
}
WAY = jax.tree.map(lambda x: jnp.asarray(RNG.normal(size=x.shape), jnp.float32), START)


def shade(color, points, reached):
    normal, position = points.normal, points.position
    bright = reached[1] * jnp.sin(3 * normal[0] + position[1])
    return [color[0] * bright, color[1] * position[2] * normal[1], color[2] * points.inverse_depth]


def colors(params):
    """Of an image whose pixels are shaded in batches if the limits of `deferred` are small."""
    eye = params["eye"]
    camera = dr.Camera.perspective(
        eye=eye, target=(0, 0, 0), up=(0, 1, 0), fov_y=0.7, near=0.1, far=10
    )
    clip = dr.world_to_clip(camera, params["vertices"])
    face = dr.rasterize(clip, MESH.faces, height=HEIGHT, width=WIDTH).face
    matrix, pivot = pivoted_matrix(camera)
    attributes = params["vertices"], params["vertices"] ** 2
    drawn = Drawn(clip, MESH.faces, attributes, Projection(matrix[np.array([0, 1, 3])], pivot))
    behind = list(params["background"])
    found = deferred.shade_covered(
        shade, params["color"], drawn, face, (None, LIT), behind, in_batches=True
    )
    return jnp.stack(found)


def loss(params):
    return jnp.sum(WEIGHTS * colors(params) ** 2)


def derivatives(params):
    """The image, its change along a way, a gradient, and the gradient's change along the way."""
    moved, slope = jax.jvp(colors, (params,), (WAY,))
    gradient, bend = jax.jvp(jax.grad(loss), (params,), (WAY,))
    return moved, slope, gradient, bend


@pytest.fixture
def small_batches(monkeypatch):
    monkeypatch.setattr(deferred, "LARGE", 0)
    monkeypatch.setattr(deferred, "RUNS_AT_ONCE", 4)


@pytest.fixture(scope="module")
def whole():
    return jax.jit(derivatives)(START)


def test_batches_give_the_same_derivatives(whole, small_batches):
    got = jax.jit(lambda params: derivatives(params))(START)
    assert np.mean(got[0] != 0) > 0.1
    for some, wanted in zip(jax.tree.leaves(got), jax.tree.leaves(whole), strict=True):
        error = np.linalg.norm(some - wanted) / np.linalg.norm(wanted)
        assert error < 1e-5


def test_batches_under_shard_map_of_vmap_of_grad(whole, small_batches):
    devices = jax.make_mesh((1,), ("views",), axis_types=(jax.sharding.AxisType.Auto,))

    def of_views(eyes):
        return jax.vmap(lambda eye: jax.grad(lambda e: loss(START | {"eye": e}))(eye))(eyes)

    mapped = jax.shard_map(of_views, mesh=devices, in_specs=VIEWS, out_specs=VIEWS)
    got = jax.jit(mapped)(jnp.stack([START["eye"]] * 2))
    wanted = whole[2]["eye"]
    np.testing.assert_allclose(got, [wanted] * 2, rtol=1e-4, atol=1e-4 * np.abs(wanted).max())


@pytest.mark.parametrize("without_derivative", ["in batches", "in one go"])
def test_images_under_shard_map(whole, small_batches, monkeypatch, without_derivative):
    if without_derivative == "in batches":
        monkeypatch.setattr(deferred, "VERY_LARGE", 0)
    devices = jax.make_mesh((1,), ("views",), axis_types=(jax.sharding.AxisType.Auto,))

    def of_views(eyes):
        return jax.lax.map(lambda eye: colors(START | {"eye": eye}), eyes)

    mapped = jax.shard_map(of_views, mesh=devices, in_specs=VIEWS, out_specs=VIEWS)
    got = jax.jit(mapped)(jnp.stack([START["eye"]] * 2))
    np.testing.assert_allclose(got, jnp.stack([whole[0]] * 2), atol=1e-5)


def test_both_precisions_in_one_image(small_batches):
    with jax.enable_x64(True):
        mixed = START | {"color": np.ones(3, np.float64)}
        got = jax.jit(lambda params: colors(params))(mixed)
        moved, _ = jax.jit(lambda params: jax.jvp(colors, (params,), (params,)))(mixed)
        assert got.dtype == moved.dtype == jnp.float64
        np.testing.assert_allclose(got, moved, atol=1e-5)


def test_an_empty_image_is_the_background(small_batches):
    away = START | {"vertices": START["vertices"] + 100.0}
    value, gradient = jax.jit(jax.value_and_grad(lambda params: loss(params)))(away)
    behind = START["background"]
    weights = np.sum(WEIGHTS, axis=(1, 2))
    np.testing.assert_allclose(value, np.sum(weights * behind**2), rtol=1e-4)
    np.testing.assert_allclose(gradient.pop("background"), 2 * weights * behind, rtol=1e-4)
    assert all(np.all(part == 0) for part in jax.tree.leaves(gradient))
