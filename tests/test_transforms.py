"""Every transformation of JAX on the renderer and on its edges: the same numbers, whichever way."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrast as dr

pytestmark = pytest.mark.usefixtures("compiled_quickly")

EYES = jnp.array([[0.0, 0.0, 3.0], [0.0, 1.0, 3.0], [1.0, 1.0, 3.0], [2.0, 0.0, 3.0]])
TANGENT = jnp.array([1.0, 2.0, 3.0])
MESH = dr.shapes.icosphere(1)
SCENE = dr.Scene(objects=[dr.Object(MESH)], lights=[dr.PointLight(position=(2, 2, 3))])
SIZE = {"height": 24, "width": 32}
VIEWS = jax.sharding.PartitionSpec("views")


def camera(eye):
    return dr.Camera.perspective(
        eye=eye, target=(0, 0, 0), up=(0, 1, 0), fov_y=0.7, near=0.1, far=10
    )


def image(eye):
    return dr.render(SCENE, camera(eye), dr.RenderSettings(**SIZE, antialias=False))


def loss(eye):
    return jnp.mean(image(eye) ** 2)


def in_pairs(function, eyes):
    """The function under vmap under a loop."""
    return jax.lax.map(jax.vmap(function), eyes.reshape(2, 2, 3))


def sharded(function):
    devices = jax.make_mesh((1,), ("views",), axis_types=(jax.sharding.AxisType.Auto,))
    return jax.jit(jax.shard_map(function, mesh=devices, in_specs=VIEWS, out_specs=VIEWS))


@pytest.fixture(scope="module")
def gradients():
    gradient = jax.jit(jax.grad(loss))
    return np.stack([gradient(eye) for eye in EYES])


def test_grad_of_scan_of_vmap_with_checkpoints(gradients):
    def total(eyes):
        return in_pairs(jax.checkpoint(loss), eyes).sum()

    np.testing.assert_allclose(jax.jit(jax.grad(total))(EYES), gradients, rtol=1e-5, atol=1e-7)


def test_shard_map_of_vmap_of_grad(gradients):
    of_all = sharded(jax.vmap(jax.grad(loss)))
    np.testing.assert_allclose(of_all(EYES), gradients, rtol=1e-5, atol=1e-7)


def test_linearized_it_equals_the_gradient(gradients):
    slope = jax.jit(lambda eye: jax.linearize(loss, eye)[1](TANGENT))(EYES[0])
    np.testing.assert_allclose(slope, gradients[0] @ TANGENT, rtol=1e-4)


def test_forward_mode_equals_reverse_mode_to_second_order(gradients):
    with jax.enable_x64(True):
        eye, tangent = jnp.asarray(EYES[1], jnp.float64), jnp.asarray(TANGENT, jnp.float64)

        @jax.jit
        def derivatives(eye):
            return jax.jvp(jax.value_and_grad(loss), (eye,), (tangent,))

        (_, gradient), (slope, product) = derivatives(eye)
        step = 1e-5 * tangent
        ahead, behind = (derivatives(eye + s * step)[0][1] for s in (1, -1))
        difference = (ahead - behind) / 2e-5
        assert product.dtype == jnp.float64
        np.testing.assert_allclose(slope, gradient @ tangent, rtol=1e-10)
    np.testing.assert_allclose(slope, gradients[1] @ TANGENT, rtol=1e-4)
    # Pixels whose face changes within the step are the difference's, not the derivative's.
    np.testing.assert_allclose(product, difference, rtol=2e-2, atol=1e-4)


@pytest.mark.filterwarnings("ignore:scatter inputs have incompatible types:FutureWarning")
def test_both_precisions_in_one_process():
    """With all that has tables of its own: bodies that may pierce each other, and shadows."""

    def shape():
        cubes = [dr.Object(dr.shapes.cube()), dr.Object(dr.shapes.cube(), transform=jnp.eye(4) / 2)]
        sun = dr.DirectionalLight(direction=(1, -2, -1), shadow=dr.Shadow(resolution=16))
        scene = dr.Scene(objects=cubes, lights=[sun])
        eye = jnp.array([3.0, 2.0, 4.0])
        return jax.eval_shape(lambda: dr.render(scene, camera(eye), dr.RenderSettings(**SIZE)))

    assert shape().dtype == jnp.float32
    with jax.enable_x64(True):
        assert shape().dtype == jnp.float64
    assert shape().dtype == jnp.float32


def seen(eye):
    clip = dr.world_to_clip(camera(eye), MESH.vertices)
    return dr.rasterize(clip, MESH.faces, border=1, **SIZE).face


def with_edges(eye, face, **options):
    """The stage alone: faces of one colour each, which changes with the eye."""
    clip = dr.world_to_clip(camera(eye), MESH.vertices)
    colors = 0.1 * eye + jnp.sin(jnp.arange(3.0 * len(MESH.faces))).reshape(-1, 3)
    picture = jnp.where(face[..., None] >= 0, colors[face], 0.0)
    return dr.antialias(
        picture, clip, MESH.faces, face, topology=MESH.topology, creases="all",
        data=colors, **options,
    )  # fmt: skip


def test_edges_under_shard_map_of_scan_of_grad_and_of_hessian_vector_product():
    def loss(eye, face):
        def shader(colors, face, at):
            return colors[face]

        return jnp.mean(with_edges(eye, face, shader=shader) ** 2)

    def derivatives(none, view):  # the second one without that of what is visible
        eye, face = view
        gradient = jax.grad(loss)
        return none, jax.jvp(lambda eye: gradient(eye, face), (eye,), (TANGENT,))

    views = EYES[:2], jax.jit(lambda eyes: jax.lax.map(seen, eyes))(EYES[:2])
    of_all = sharded(lambda views: jax.lax.scan(derivatives, None, views)[1])
    gradients, products = of_all(views)
    mapped = jax.jit(jax.vmap(jax.grad(loss)))(*views)
    np.testing.assert_allclose(gradients, mapped, rtol=1e-4, atol=1e-6)
    assert np.all(np.isfinite(products))
    assert np.all(np.any(products != 0, axis=1))


def test_hessian_where_a_loss_is_least_is_the_product_of_first_derivatives_of_edges():
    eye, other = EYES[2], jnp.array([2.0, -1.0, 0.5])
    face = seen(eye)

    @jax.jit
    def products(eye):
        target, change = jax.linearize(lambda eye: with_edges(eye, face), eye)

        def loss(eye):
            return jnp.sum((with_edges(eye, face) - target) ** 2) / 2

        def forward(eye):
            return jax.jvp(loss, (eye,), (TANGENT,))[1]

        forward_of_reverse = jax.jvp(jax.grad(loss), (eye,), (TANGENT,))[1]
        changes = jax.vmap(change)(jnp.stack([TANGENT, other]))
        return (
            jnp.vdot(*changes),
            jnp.vdot(forward_of_reverse, other),
            jnp.vdot(jax.grad(forward)(eye), other),
        )

    expected, *found = products(eye)
    assert abs(expected) > 1
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_shard_map_of_scan_of_grad_by_transforms():
    """With edges, of a mesh with seams and one without, of which only one moves."""
    cube = dr.mesh.flat_shaded(dr.shapes.cube())

    def loss(offset):
        objects = [dr.Object(MESH, None, dr.linalg.translation(offset)), dr.Object(cube)]
        scene = dr.Scene(objects=objects, lights=SCENE.lights)
        return jnp.mean(dr.render(scene, camera(EYES[0]), dr.RenderSettings(**SIZE)) ** 2)

    of_all = sharded(lambda offsets: jax.lax.map(jax.grad(loss), offsets))
    gradients = of_all(EYES[:2] / 4)
    mapped = jax.jit(jax.vmap(jax.grad(loss)))(EYES[:2] / 4)
    np.testing.assert_allclose(gradients, mapped, rtol=1e-4, atol=1e-6)
    assert np.all(np.any(gradients != 0, axis=1))


def test_shard_map_of_grad_by_the_vertices_of_one_object():
    cube = dr.mesh.flat_shaded(dr.shapes.cube())
    settings = dr.RenderSettings(**SIZE, antialias=False)

    def loss(offset):
        moved = dataclasses.replace(MESH, vertices=MESH.vertices + offset)
        scene = dr.Scene(objects=[dr.Object(moved), dr.Object(cube)], lights=SCENE.lights)
        return jnp.mean(dr.render(scene, camera(EYES[0]), settings) ** 2)

    of_all = sharded(lambda offsets: jax.lax.map(jax.grad(loss), offsets))
    gradients = of_all(EYES[:2] / 4)
    mapped = jax.jit(jax.vmap(jax.grad(loss)))(EYES[:2] / 4)
    np.testing.assert_allclose(gradients, mapped, rtol=1e-4, atol=1e-6)
    assert np.all(np.any(gradients != 0, axis=1))


def of_two_cubes_with_shadows():
    """That pierce each other."""
    slab = dr.Object(dr.shapes.cube(), None, dr.linalg.scaling((2, 0.4, 2)))
    shadow = dr.Shadow(resolution=16)
    sun = dr.DirectionalLight(direction=(1, -2, -1), shadow=shadow)
    lamp = dr.PointLight(position=(2, 2, 3), shadow=shadow)
    return [dr.Object(dr.shapes.cube()), slab], [sun, lamp], {}


def of_textures():
    texture = dr.Texture(np.ones((4, 4, 3)), filter="trilinear", anisotropy=2)
    shiny = dr.Material(texture=texture, specular=(0.5, 0.5, 0.5))
    ball = dr.Object(dr.shapes.uv_sphere(segments=6, rings=4), shiny)
    spot = dr.SpotLight(position=(2, 3, 2), direction=(-2, -3, -2), cutoff=0.5)
    return [ball], [spot], {"samples": 4}


def of_lit_vertices():
    lights = [dr.AmbientLight(color=(1, 1, 1)), dr.DirectionalLight(direction=(1, -2, -1))]
    return [dr.Object(dr.shapes.cube())], lights, {"shading": "gouraud", "antialias": False}


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("scene", [of_two_cubes_with_shadows, of_textures, of_lit_vertices])
def test_gradients_without_implicit_conversions(scene, double):
    """Traced alone: that is when JAX refuses them."""
    with jax.enable_x64(double), jax.numpy_dtype_promotion("strict"):
        objects, lights, options = scene()

        def loss(eye):
            scene = dr.Scene(objects=objects, lights=lights)
            return jnp.mean(dr.render(scene, camera(eye), dr.RenderSettings(**SIZE, **options)))

        slope = jax.eval_shape(jax.grad(loss), jnp.array([3.0, 2.0, 4.0]))
    assert slope.dtype == (jnp.float64 if double else jnp.float32)


@pytest.mark.parametrize("double", [False, True])
def test_the_rest_without_implicit_conversions(double):
    def drawn(eye):
        mesh, lamp = dr.shapes.icosphere(1), dr.PointLight(position=(2, 2, 3))
        scene = dr.Scene(objects=[dr.Object(mesh)], lights=[lamp])
        drawings = (dr.wireframe(scene, camera(eye), **SIZE, antialias=k) for k in (False, True))
        buffers = dr.render_buffers(scene, camera(eye), dr.RenderSettings(**SIZE))
        table = dr.LookUpTable(positions=(0, 1), colors=((0, 0, 0), (1, 1, 1)))
        cosines = dr.recolor(dr.light_cosines(buffers, lamp), buffers.face, table)
        clipped = dr.clip.clip_triangles(dr.world_to_clip(camera(eye), mesh.vertices), mesh.faces)
        return dr.fit.gaussian_blur(sum(drawings, cosines), 1.5).sum() + clipped.corners.sum()

    with jax.enable_x64(double), jax.numpy_dtype_promotion("strict"):
        slope = jax.eval_shape(jax.grad(drawn), jnp.array([3.0, 2.0, 4.0]))
    assert slope.dtype == (jnp.float64 if double else jnp.float32)
