"""Every transformation of JAX on the whole renderer: the same numbers, whichever way."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrast as dr

EYES = jnp.array([[0.0, 0.0, 3.0], [0.0, 1.0, 3.0], [1.0, 1.0, 3.0], [2.0, 0.0, 3.0]])
TANGENT = jnp.array([1.0, 2.0, 3.0])


@pytest.fixture(scope="module")
def image():
    return renderer(antialias=False)


def renderer(antialias):
    mesh = dr.shapes.icosphere(1)
    settings = dr.RenderSettings(height=24, width=32, antialias=antialias)
    scene = dr.Scene(
        objects=[dr.Object(mesh)],
        lights=[dr.PointLight(position=(2, 2, 3))],
    )

    def image(eye):
        camera = dr.Camera.perspective(
            eye=eye, target=(0, 0, 0), up=(0, 1, 0), fov_y=0.7, near=0.1, far=10
        )
        return dr.render(scene, camera, settings)

    return image


@pytest.fixture(scope="module")
def loss(image):
    return lambda eye: jnp.mean(image(eye) ** 2)


@pytest.fixture(scope="module")
def gradients(loss):
    gradient = jax.jit(jax.grad(loss))
    return np.stack([gradient(eye) for eye in EYES])


@pytest.fixture(scope="module")
def images(image):
    return np.stack([image(eye) for eye in EYES])


def test_vmap_and_map_give_single_images(image, images):
    np.testing.assert_array_equal(jax.jit(jax.vmap(image))(EYES), images)
    np.testing.assert_array_equal(jax.lax.map(image, EYES), images)


def test_grad_of_vmap(loss, gradients):
    of_all = jax.jit(jax.grad(lambda eyes: jax.vmap(loss)(eyes).sum()))(EYES)
    np.testing.assert_allclose(of_all, gradients, rtol=1e-5, atol=1e-7)


def test_forward_mode_equals_reverse_mode(loss, gradients):
    @jax.jit
    def forward(eye):
        return jax.linearize(loss, eye)[1](TANGENT)

    np.testing.assert_allclose(forward(EYES[0]), gradients[0] @ TANGENT, rtol=1e-4)


def test_grad_of_scan_with_checkpoints(loss, gradients):
    def total(eyes):
        step = jax.checkpoint(lambda sum_, eye: (sum_ + loss(eye), None))
        return jax.lax.scan(step, 0.0, eyes)[0]

    np.testing.assert_allclose(jax.jit(jax.grad(total))(EYES), gradients, rtol=1e-5, atol=1e-7)


def test_hessian_vector_product(loss):
    with jax.enable_x64(True):
        eye, tangent = jnp.asarray(EYES[1], jnp.float64), jnp.asarray(TANGENT, jnp.float64)
        gradient = jax.jit(jax.grad(loss))
        product = jax.jit(lambda e, t: jax.jvp(gradient, (e,), (t,))[1])(eye, tangent)
        step = 1e-5 * tangent
        difference = (gradient(eye + step) - gradient(eye - step)) / 2e-5
        assert product.dtype == jnp.float64
    # Pixels whose face changes within the step are the difference's, not the derivative's.
    np.testing.assert_allclose(product, difference, rtol=2e-2, atol=1e-4)


def test_shard_map(loss, gradients):
    devices = jax.make_mesh((1,), ("views",), axis_types=(jax.sharding.AxisType.Auto,))
    views = jax.sharding.PartitionSpec("views")
    gradient = jax.vmap(jax.grad(loss))
    sharded = jax.jit(jax.shard_map(gradient, mesh=devices, in_specs=views, out_specs=views))
    np.testing.assert_allclose(sharded(EYES), gradients, rtol=1e-5, atol=1e-7)


def test_edges_under_shard_map_of_scan_of_grad_and_of_hessian_vector_product():
    image = renderer(antialias=True)

    def loss(eye):
        return jnp.mean(image(eye) ** 2)

    def derivatives(eye):  # the second one without that of what is visible
        return jax.jvp(jax.grad(loss), (eye,), (TANGENT,))

    devices = jax.make_mesh((1,), ("views",), axis_types=(jax.sharding.AxisType.Auto,))
    views = jax.sharding.PartitionSpec("views")

    def of_all(eyes):
        return jax.lax.scan(lambda none, eye: (none, derivatives(eye)), None, eyes)[1]

    sharded = jax.shard_map(of_all, mesh=devices, in_specs=views, out_specs=views)
    gradients, products = jax.jit(sharded)(EYES[:2])
    mapped = jax.jit(jax.vmap(jax.grad(loss)))(EYES[:2])
    np.testing.assert_allclose(gradients, mapped, rtol=1e-4, atol=1e-6)
    assert np.all(np.isfinite(products))
    assert np.all(np.any(products != 0, axis=1))
