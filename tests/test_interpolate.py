"""Perspective-correct attributes: closed forms, linearity, derivatives, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check_derivatives
from drawing import HEIGHT, WIDTH, arrays, draw, perspective, soup

from diffrast import shapes
from diffrast.camera import pixel_rays, world_to_clip
from diffrast.interpolate import interpolate
from diffrast.raster import Fragments

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def drawn():
    """World positions, faces, camera, clip positions and fragments of triangles round the eye."""
    positions, faces = soup(200, 0.2)
    camera = perspective((0, 0, 0.1), fov_y=1.2, near=0.01)
    positions_clip = np.asarray(world_to_clip(camera, positions))
    return positions, faces, camera, positions_clip, draw(positions_clip, faces)


def test_clip_positions_lie_on_the_pixel_they_are_seen_at(drawn):
    _, faces, _, positions_clip, fragments = drawn
    x, y, _, w = np.moveaxis(np.asarray(interpolate(positions_clip, faces, fragments)), -1, 0)
    seen = np.asarray(fragments.face) >= 0
    assert 0.3 < np.mean(seen) < 1
    x_ndc = (2 * np.arange(WIDTH) + 1) / WIDTH - 1
    y_ndc = 1 - (2 * np.arange(HEIGHT) + 1) / HEIGHT
    np.testing.assert_allclose(x[seen], (x_ndc * w)[seen], atol=2e-6)
    np.testing.assert_allclose(y[seen], (y_ndc[:, None] * w)[seen], atol=2e-6)
    np.testing.assert_allclose(w[seen] * fragments.inverse_depth[seen], 1, rtol=1e-5)


def test_world_positions_lie_on_the_ray_of_sight(drawn):
    positions, faces, camera, _, fragments = drawn
    points = np.asarray(interpolate(positions, faces, fragments))
    rays = np.asarray(pixel_rays(camera, height=HEIGHT, width=WIDTH))
    from_eye = points - [0, 0, 0.1]
    along = np.sum(from_eye * rays, axis=-1, keepdims=True)
    seen = np.asarray(fragments.face) >= 0
    assert np.all(along[seen] > 0)
    np.testing.assert_allclose(from_eye[seen], (along * rays)[seen], atol=2e-6)


def test_sphere_in_closed_form():
    positions, faces = arrays(shapes.icosphere(3))
    camera = perspective((0, 0, 3))
    fragments = draw(world_to_clip(camera, positions), faces)
    radius = np.linalg.norm(interpolate(positions, faces, fragments), axis=-1)
    seen = np.asarray(fragments.face) >= 0
    edge = np.max(np.linalg.norm(positions[faces] - positions[faces[:, [1, 2, 0]]], axis=-1))
    # A chord's triangle is at most its circumradius, edge / √3 for equal sides, off the sphere.
    assert np.all(radius[seen] <= 1 + 1e-6)
    assert np.min(radius[seen]) > np.sqrt(1 - edge**2 / 2.9)


def test_background_is_zero_and_constants_stay(drawn):
    _, faces, _, positions_clip, fragments = drawn
    ones = np.ones((len(positions_clip), 2)) * [1, -7]
    image = interpolate(ones, faces, fragments)
    covered = np.asarray(fragments.face) >= 0
    np.testing.assert_allclose(image, covered[..., None] * [1, -7], rtol=1e-6)
    assert not np.any(np.asarray(image)[~covered])


def test_single_and_no_channels(drawn):
    _, faces, _, positions_clip, fragments = drawn
    one = interpolate(positions_clip[:, :1], faces, fragments)
    np.testing.assert_array_equal(one, interpolate(positions_clip, faces, fragments)[..., :1])
    assert interpolate(positions_clip[:, :0], faces, fragments).shape == (HEIGHT, WIDTH, 0)


def test_derivatives_in_attributes_and_barycentrics():
    face = RNG.integers(-1, 5, (4, 6)).astype(np.int32)
    faces = RNG.integers(0, 7, (5, 3))

    def image(attributes, barycentrics):
        fragments = Fragments(
            face=jnp.asarray(face), barycentrics=barycentrics, inverse_depth=barycentrics[..., 0]
        )
        return interpolate(attributes, faces, fragments)

    with jax.enable_x64(True):
        attributes, barycentrics = RNG.normal(size=(7, 2)), RNG.normal(size=(4, 6, 3))
        check_derivatives(image, attributes, barycentrics)
        assert jax.eval_shape(image, attributes, barycentrics).dtype == jnp.float64


def test_vmap_over_attributes(drawn):
    _, faces, _, positions_clip, fragments = drawn
    stack = RNG.normal(size=(3, len(positions_clip), 2)).astype(np.float32)
    batch = jax.jit(jax.vmap(lambda a: interpolate(a, faces, fragments)))(stack)
    single = np.stack([interpolate(a, faces, fragments) for a in stack])
    np.testing.assert_allclose(batch, single, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"attributes": np.zeros(3)}, r"attributes: wanted shape \(V, C\), got \(3,\)"),
        ({"attributes": "red"}, "attributes: wanted an array of numbers"),
        ({"faces": [[0, 1]]}, r"faces: wanted shape \(F, 3\), got \(1, 2\)"),
        ({"faces": [[0, 1, 3]]}, r"faces: wanted indices in \[0, 3\), got 3"),
        ({"faces": [[0.0, 1.0, 2.0]]}, "faces: wanted integers"),
        ({"faces": np.zeros((0, 3), int)}, r"fragments.face: wanted indices in \[-1, 0\), got 0"),
    ],
)
def test_bad_input(change, message):
    fragments = Fragments(
        face=jnp.zeros((2, 2), int),
        barycentrics=jnp.zeros((2, 2, 3)),
        inverse_depth=jnp.zeros((2, 2)),
    )
    arguments = {"attributes": np.zeros((3, 1)), "faces": [[0, 1, 2]], "fragments": fragments}
    with pytest.raises(ValueError, match=message):
        interpolate(**(arguments | change))
