"""Buffers that XLA stores, several in one pass: the same bits, and derivatives as of the values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrast._stored import assemble, stored, stored_rows, stored_together

NUMBERS = jnp.array([jnp.nan, jnp.inf, -jnp.inf, -0.0, 0.0, 1e-45, 3.0])
INTEGERS = jnp.array([-(2**31), 2**31 - 1, -1, 0, 1, 2, 3])
KEPT = NUMBERS, -NUMBERS, INTEGERS, jnp.array([True, False, True, True, False, False, True])


def bits(array):
    return np.asarray(array).view(np.uint8)


@pytest.mark.default_compilation
def test_stored_values_and_their_derivatives_are_unchanged():
    values = jnp.array(np.random.default_rng(0).normal(size=(50, 3)))
    special = jnp.array([0.0, -0.0, jnp.inf, -jnp.inf, jnp.nan, 1e-45, -3e38])
    for given in (special, values, jnp.array([-(2**31), 0, 2**31 - 1]), values > 0):
        np.testing.assert_array_equal(jax.jit(stored)(given), given)
    for same in (stored_rows(values), assemble(list(values.T))):
        np.testing.assert_array_equal(same, values)
    _, tangent = jax.jvp(stored_rows, (values,), (values + 1,))
    np.testing.assert_array_equal(tangent, values + 1)


def test_stored_values_are_computed_once():
    def twice(values, keep):
        large = keep(jnp.exp2(values) * values + 1)
        return jnp.sin(large), jnp.cos(large)

    def count(keep):
        text = jax.jit(lambda x: twice(x, keep)).lower(jnp.ones(999)).compile().as_text()
        return text.count(" add(")

    assert count(stored) == 1 <= count(lambda x: x)


@pytest.mark.parametrize("function", [stored, stored_together])
@pytest.mark.parametrize("transform", [jax.jit, lambda f: jax.jit(jax.vmap(f))])
def test_not_a_bit_changes(function, transform):
    for kept, value in zip(transform(function)(KEPT), KEPT, strict=True):
        np.testing.assert_array_equal(bits(kept), bits(value))


def test_arrays_of_several_precisions_are_kept():
    half = NUMBERS.astype(jnp.float16)
    kept = jax.jit(stored_together)((NUMBERS, half, INTEGERS, INTEGERS.astype(jnp.int8)))
    for value, given in zip(kept[:3], (NUMBERS, half, INTEGERS), strict=True):
        np.testing.assert_array_equal(bits(value), bits(given))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="elsewhere XLA does so by itself")
def test_small_arrays_of_one_shape_are_computed_in_one_pass():
    def kernels(function, size):
        def values(x):
            shared = jnp.sqrt(1 + x * x)
            return function({"x": x / shared, "one": 1 / shared, "long": shared > 2})

        program = jax.jit(values).lower(jax.ShapeDtypeStruct((size,), jnp.float32)).compile()
        return program.as_text().count(" fusion(")

    assert kernels(stored_together, 512) == 1 < kernels(stored, 512)
    assert kernels(stored_together, 100_000) > 1


@pytest.mark.parametrize("function", [stored, stored_together])
def test_derivatives_are_those_of_the_values(function):
    def product(x, y):
        one, two, three, _ = function((jnp.sin(x), x * y, jnp.cos(y), jnp.arange(3)))
        return one * two + three

    def plain(x, y):
        return jnp.sin(x) * x * y + jnp.cos(y)

    at, along = (jnp.array([0.3, 0.5, 2.0]), jnp.array([1.0, -2.0, 0.1])), (jnp.ones(3),) * 2
    for ours, exact in zip(jax.jvp(product, at, along), jax.jvp(plain, at, along), strict=True):
        np.testing.assert_allclose(ours, exact, rtol=1e-6)
    for way in (jax.jacrev, jax.jacfwd, jax.hessian):
        ours, exact = (way(f, argnums=(0, 1))(*at) for f in (product, plain))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), ours, exact)


@pytest.mark.parametrize("function", [stored, stored_together])
def test_what_does_not_change_has_no_derivative(function):
    def both(x):
        return function((x * 2, jnp.ones_like(x)))

    jaxpr = jax.make_jaxpr(lambda x: jax.jvp(both, (x,), (x,)))(jnp.ones(3))
    assert sum(equation.primitive.name == "div" for equation in jaxpr.jaxpr.eqns) == 1
