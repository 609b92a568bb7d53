"""Colour: transfer functions, hue, lightness and saturation, look-up tables."""

import colorsys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import diffrast as dr
from diffrast.color import (
    gamma_to_linear,
    hls_to_rgb,
    linear_to_gamma,
    linear_to_srgb,
    rgb_to_hls,
    srgb_to_linear,
)

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def test_numbers_of_the_standard():
    encoded = np.array([0.0, 0.02, 0.5, 188 / 255, 1.0])
    linear = [0, 0.02 / 12.92, 0.21404114, 0.50288646, 1]
    np.testing.assert_allclose(srgb_to_linear(encoded), linear, rtol=1e-6)
    np.testing.assert_allclose(linear_to_srgb(np.array(linear)), encoded, rtol=1e-6)


def test_round_trip_through_both_pieces_and_beyond():
    values = np.concatenate([np.linspace(-0.5, 1.5, 401), [0.04045, 0.0031308, 0.04, 0.0031]])
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-6)
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(values)), values, atol=1e-6)


def test_every_byte_survives():
    codes = np.arange(256)
    again = linear_to_srgb(srgb_to_linear(codes / 255)) * 255
    np.testing.assert_array_equal(np.round(again), codes)


def test_derivatives():
    with jax.enable_x64(True):
        values = jnp.array([-1.0, -1e-9, 0.0, 0.001, 0.02, 0.3, 1.0, 4.0])
        check_grads(srgb_to_linear, (values,), order=1)
        check_grads(linear_to_srgb, (values,), order=1)
    for function, slope in ((srgb_to_linear, 1 / 12.92), (linear_to_srgb, 12.92)):
        for black in (0.0, -0.5, -0.055, -1.0):
            np.testing.assert_allclose(jax.grad(function)(black), slope, rtol=1e-6)


def test_gamma_is_a_power_and_its_inverse():
    values = np.linspace(0, 2, 101)
    np.testing.assert_allclose(gamma_to_linear(values, 2.2), values**2.2, rtol=1e-5)
    np.testing.assert_allclose(
        linear_to_gamma(gamma_to_linear(values, 1.8), 1.8), values, atol=1e-6
    )
    for function in (gamma_to_linear, linear_to_gamma):
        for black in (0.0, -0.5):
            np.testing.assert_array_equal(jax.value_and_grad(function)(black), (0, 0))
    with pytest.raises(ValueError, match="gamma: wanted a number between 0 and inf, got 0"):
        gamma_to_linear(1.0, 0.0)


# ------------------------------------------------------------------ hue, lightness and saturation


def test_round_trip_of_a_million_colours():
    colors = np.random.default_rng(0).uniform(size=(1_000_000, 3)).astype(np.float32)
    colors[:1000] = np.round(colors[:1000])  # the cube's corners
    colors[1000:2000] *= 1e-4
    colors[2000:3000] = 1 - 1e-4 * colors[2000:3000]
    hls = rgb_to_hls(colors)
    assert np.all((hls[..., 0] >= 0) & (hls[..., 0] <= 2 * np.pi + 1e-6))
    assert np.all((hls[..., 1:] >= 0) & (hls[..., 1:] <= 1 + 1e-6))
    np.testing.assert_allclose(hls_to_rgb(hls), colors, atol=1e-6)


def test_greys_are_exact():
    greys = np.repeat(np.random.default_rng(0).uniform(size=(10_000, 1)), 3, axis=1)
    greys = np.float32(np.vstack([greys, np.zeros(3), np.ones(3)]))
    hls = np.asarray(rgb_to_hls(greys))
    np.testing.assert_array_equal(hls[:, [0, 2]], 0)
    np.testing.assert_array_equal(hls[:, 1], greys[:, 0])
    np.testing.assert_array_equal(hls_to_rgb(hls), greys)
    hues = np.stack([np.linspace(-9, 9, 50), np.full(50, 0.3), np.zeros(50)], axis=1)
    np.testing.assert_array_equal(hls_to_rgb(hues), np.float32(np.full((50, 3), 0.3)))


def test_hls_equals_the_standard_library():
    colors = np.random.default_rng(1).uniform(size=(200, 3))
    want = np.array([colorsys.rgb_to_hls(*color) for color in colors]) * [2 * np.pi, 1, 1]
    np.testing.assert_allclose(rgb_to_hls(colors), want, atol=2e-6)
    names = {(1, 0, 0): 0, (1, 1, 0): 1, (0, 1, 0): 2, (0, 1, 1): 3, (0, 0, 1): 4, (1, 0, 1): 5}
    for color, sixth in names.items():
        np.testing.assert_allclose(rgb_to_hls(color), [sixth * np.pi / 3, 0.5, 1], rtol=1e-6)
    turns = np.array([[2 * np.pi * k + 1, 0.4, 0.7] for k in (-2, 0, 3)])
    np.testing.assert_allclose(hls_to_rgb(turns), [hls_to_rgb(turns[1])] * 3, atol=2e-6)


def test_hls_derivatives():
    with jax.enable_x64(True):
        colors = jnp.array([[0.2, 0.5, 0.9], [0.9, 0.3, 0.2], [0.6, 0.8, 0.7]])
        check_grads(rgb_to_hls, (colors,), order=1)
        check_grads(hls_to_rgb, (rgb_to_hls(colors),), order=1)
    for color in ((0.0, 0, 0), (1, 1, 1), (0.5, 0.5, 0.5), (1, 1, 0), (1, 0, 0)):
        assert np.isfinite(jax.jacrev(rgb_to_hls)(jnp.array(color, float))).all()
        assert np.isfinite(jax.jacrev(hls_to_rgb)(jnp.array(color, float))).all()


# ------------------------------------------------------------------------------- look-up tables


def test_profiles_are_linear_between_their_vertices():
    """The thesis's profile, black to green, and one with a highlight and other ambient light."""
    simple = dr.LookUpTable(positions=[0, 1], colors=[(0, 0.1, 0), (0, 1, 0)])
    np.testing.assert_allclose(
        dr.look_up(simple, [0, 0.5, 1]), [(0, 0.1, 0), (0, 0.55, 0), (0, 1, 0)]
    )
    positions = [0.0, 0.2, 0.8, 1.0]
    colors = np.array([(0.1, 0, 0.2), (0.3, 0.1, 0), (0.8, 0.5, 0.1), (1, 1, 1)])
    table = dr.LookUpTable(positions=positions, colors=colors)
    values = np.random.default_rng(0).uniform(-0.2, 1.2, size=(40, 30))
    want = np.stack([np.interp(values, positions, colors[:, c]) for c in range(3)], axis=-1)
    np.testing.assert_allclose(dr.look_up(table, values), want, atol=1e-6)
    np.testing.assert_array_equal(dr.look_up(table, np.array(positions)), np.float32(colors))


def test_known_profiles_are_checked_inside_of_jit():
    def middle(positions):
        table = dr.LookUpTable(positions=positions, colors=[[0.0], [1]])
        return dr.look_up(table, 0.5)

    np.testing.assert_array_equal(jax.jit(lambda: middle([0.0, 1]))(), [0.5])
    with pytest.raises(ValueError, match="positions: wanted them in ascending order"):
        jax.jit(lambda: middle([1.0, 0]))()


def test_look_up_derivatives():
    def colors(values, positions, colors):
        return dr.look_up(dr.LookUpTable(positions=positions, colors=colors), values)

    with jax.enable_x64(True):
        values = jnp.array([-0.1, 0.1, 0.5, 0.95, 1.3])
        arguments = values, jnp.array([0.0, 0.2, 0.8, 1.0]), jnp.arange(12.0).reshape(4, 3) ** 2
        check_grads(colors, arguments, order=1)
    step = jax.grad(lambda x: jnp.sum(colors(jnp.array([0.5]), x, jnp.ones((3, 1)))))
    assert np.isfinite(step(jnp.array([0.5, 0.5, 0.5]))).all()


def test_a_profile_has_the_derivative_of_a_whole_piece_at_its_vertices():
    table = dr.LookUpTable(positions=[0.0, 0.25, 0.5, 1], colors=[[0.0], [0.25], [0.5], [0]])
    slopes = jax.vmap(jax.grad(lambda x: dr.look_up(table, x)[0]))
    values = jnp.array([-0.1, 0, 0.1, 0.25, 0.5, 0.7, 1, 1.1])
    np.testing.assert_array_equal(slopes(values), [0, 1, 1, 1, -1, -1, -1, 0])


def test_recolouring_needs_no_second_picture():
    item = dr.Object(dr.shapes.uv_sphere(segments=12, rings=8))
    light = dr.PointLight(position=(2, 3, 4), attenuation=dr.Attenuation((0, 1, 0), legs="both"))
    camera = dr.Camera.perspective(eye=(0, 0, 3), target=(0, 0, 0), fov_y=0.9, near=0.5, far=9)
    settings = dr.RenderSettings(height=16, width=16, antialias=False)
    buffers = dr.render_buffers(dr.Scene(objects=[item]), camera, settings)
    cosines = dr.light_cosines(buffers, light)
    to_light = np.array([2, 3, 4]) - np.asarray(buffers.position)
    to_light /= np.linalg.norm(to_light, axis=-1, keepdims=True)
    want = np.maximum(np.sum(to_light * np.asarray(buffers.normal), axis=-1), 0)
    np.testing.assert_allclose(cosines, want, atol=1e-6)
    table = dr.LookUpTable(positions=[0, 1], colors=[(0, 0.1, 0), (0, 1, 0)])
    image = dr.recolor(cosines, buffers.face, table, background=(1, 1, 1))
    empty = np.asarray(buffers.face) < 0
    np.testing.assert_array_equal(np.asarray(image)[empty], 1)
    np.testing.assert_allclose(np.asarray(image)[~empty][:, 1], 0.1 + 0.9 * want[~empty], atol=1e-6)
    depth = np.asarray(dr.depths(buffers))
    np.testing.assert_allclose(
        depth[~empty], 3 - np.asarray(buffers.position)[~empty, 2], atol=1e-5
    )
    np.testing.assert_array_equal(depth[empty], 0)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rgb_to_hls((0.1, 0.2)), r"rgb: wanted shape \(3,\), got \(2,\)"),
        (lambda: hls_to_rgb(0.5), r"hls: wanted shape \(..., 3\), got \(\)"),
        (
            lambda: dr.LookUpTable(positions=[0.0], colors=[(0, 0, 0)]),
            "positions: wanted at least two vertices, got 1",
        ),
        (
            lambda: dr.LookUpTable(positions=[0.0, 0.5, 0.5], colors=np.eye(3)),
            "positions: wanted them in ascending order",
        ),
        (
            lambda: dr.LookUpTable(positions=[0.0, 1.0], colors=np.eye(3)),
            r"colors: wanted shape \(2, channels\), got \(3, 3\)",
        ),
    ],
)
def test_errors_name_the_argument(make, message):
    with pytest.raises(ValueError, match=message):
        make()
