"""Derivatives of barycentrics and inverse depth: the oracle's, and under every transformation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from derivatives import check_derivatives
from drawing import draw, perspective, soup

from diffrast.camera import world_to_clip
from diffrast.raster import rasterize
from diffrast.raster.evaluate import Drawn, all_pixels, evaluate

pytestmark = pytest.mark.usefixtures("compiled_quickly")

SIZE = 16
RNG = np.random.default_rng(0)


def scene(eye=(0, 0, 0.1)):
    """Triangles before, beside and behind the eye, in double precision."""
    positions, faces = soup(60, 0.4)
    camera = perspective(eye, fov_y=1.2, near=0.01)
    return np.asarray(world_to_clip(camera, positions), np.float64), faces


def values(positions_clip, faces):
    fragments = rasterize(positions_clip, faces, height=SIZE, width=SIZE)
    return fragments.barycentrics, fragments.inverse_depth


def at_fixed_faces(positions_clip, faces, face):
    drawn = Drawn(positions_clip, jnp.asarray(faces))
    seen = evaluate(drawn, all_pixels(jnp.asarray(face), positions_clip.dtype))
    return jnp.stack(seen.barycentrics, axis=-1), seen.inverse_depth


def assert_transposed(slope, gradient, weights, direction, tolerance):
    """The product weights · J · direction is the same from either side, to rounding."""
    products = [w * np.asarray(s) for w, s in zip(weights, slope, strict=True)]
    size = sum(np.sum(np.abs(p)) for p in products)
    difference = np.sum(np.asarray(gradient) * direction) - sum(np.sum(p) for p in products)
    assert abs(difference) <= tolerance * size


def test_derivatives_are_differences_of_the_oracle():
    positions_clip, faces = scene()
    direction = RNG.normal(size=positions_clip.shape)
    weights = RNG.normal(size=(SIZE, SIZE, 3)), RNG.normal(size=(SIZE, SIZE))

    @jax.jit
    def derivatives(positions_clip, direction, weights):
        value, push = jax.linearize(lambda p: values(p, faces), positions_clip)
        (gradient,) = jax.linear_transpose(push, positions_clip)(weights)
        return value, push(direction), gradient

    with jax.enable_x64(True):
        value, slope, gradient = derivatives(positions_clip, direction, weights)
        value = jax.tree.map(np.asarray, value)
    assert_transposed(slope, gradient, weights, direction, 1e-13)

    step = 1e-7
    truth, after, before = (
        reference.rasterize(positions_clip + move * direction, faces, SIZE, SIZE)
        for move in (0, step, -step)
    )
    steady = (truth.face == after.face) & (truth.face == before.face)
    assert np.mean(steady) > 0.98
    for name, v, s in zip(("barycentrics", "inverse_depth"), value, slope, strict=True):
        np.testing.assert_allclose(v[steady], getattr(truth, name)[steady], rtol=1e-11, atol=1e-11)
        difference = (getattr(after, name) - getattr(before, name)) / (2 * step)
        s = np.asarray(s)[steady]
        np.testing.assert_allclose(s, difference[steady], rtol=1e-5, atol=1e-5)


def test_single_precision_agrees_with_double():
    positions_clip, faces = scene((0, 0, 4))
    positions_clip = positions_clip.astype(np.float32)
    face = reference.rasterize(positions_clip, faces, SIZE, SIZE).face.astype(np.int32)
    direction = RNG.normal(size=positions_clip.shape).astype(np.float32)

    @jax.jit
    def derivatives(positions_clip, direction, weights):
        value, slope = jax.jvp(
            lambda p: at_fixed_faces(p, faces, face), (positions_clip,), (direction,)
        )
        _, pull = jax.vjp(lambda p: at_fixed_faces(p, faces, face), positions_clip)
        return value, slope, pull(weights)[0]

    weights = [RNG.normal(size=(SIZE, SIZE, 3)), RNG.normal(size=(SIZE, SIZE))]
    arguments = positions_clip, direction, tuple(w.astype(np.float32) for w in weights)
    single = derivatives(*arguments)
    with jax.enable_x64(True):
        double = derivatives(*(jax.tree.map(lambda a: a.astype(np.float64), arguments)))
    for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(double), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.max(np.abs(b)))
    _, slope, gradient = single
    assert_transposed(slope, gradient, weights, direction, 1e-6)


def test_second_derivatives():
    positions_clip, faces = scene()
    face = reference.rasterize(positions_clip, faces, SIZE, SIZE).face.astype(np.int32)
    weights = RNG.normal(size=(SIZE, SIZE, 3)), RNG.normal(size=(SIZE, SIZE))

    def loss(p):
        barycentrics, inverse_depth = at_fixed_faces(p, faces, face)
        return jnp.sum(weights[0] * barycentrics**2) + jnp.sum(weights[1] * inverse_depth**2)

    with jax.enable_x64(True):
        check_derivatives(jax.grad(loss), positions_clip, step=1e-7, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("scale", [1e-10, 1.0, 1e20])
def test_finite_on_degenerate_input(scale):
    rng = np.random.default_rng(1)
    positions_clip = rng.normal(size=(90, 4)).astype(np.float32) * np.float32(scale)
    bad = positions_clip[:24].copy()
    bad[0, 0], bad[3, 3], bad[6, 2] = np.nan, np.inf, -np.inf
    bad[10] = bad[9]  # without area
    bad[14] = (bad[12] + bad[13]) / 2
    bad[15:18] = 0
    bad[18:21, 3] = 0  # in the plane of the eye
    bad[21:24] = bad[21]
    positions_clip = np.concatenate([bad, positions_clip])
    faces = np.arange(len(positions_clip)).reshape(-1, 3)
    face = draw(positions_clip, faces).face
    # Also where no face is seen, and at faces that no pixel can have.
    face = face.at[0].set(np.arange(face.shape[1]) % 12 - 1)

    @jax.jit
    def derivatives(positions_clip):
        value, pull = jax.vjp(lambda p: at_fixed_faces(p, faces, face), positions_clip)
        ones = jax.tree.map(jnp.ones_like, value)
        direction = jnp.ones_like(positions_clip) * scale
        slope = jax.jvp(lambda p: at_fixed_faces(p, faces, face), (positions_clip,), (direction,))
        return value, slope, pull(ones)

    for leaf in jax.tree.leaves(derivatives(positions_clip)):
        assert np.all(np.isfinite(leaf))
