"""sRGB transfer functions: the standard's numbers, the round trip, derivatives everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.test_util import check_grads

from diffrast.color import linear_to_srgb, srgb_to_linear


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
