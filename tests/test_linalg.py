"""Vectors, transforms, exponentials: closed forms, inverses, derivatives, degenerate input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check_derivatives
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from diffrast import linalg
from diffrast._compensated import affine, affine_parts

RNG = np.random.default_rng(0)


def random_matrix():
    matrix = RNG.normal(size=(4, 4))
    matrix[3] = 0, 0, 0, 1
    return matrix


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_norm_and_normalize_have_no_favourite_unit(scale):
    vectors = np.array([[3, 0, 4], [1, -2, 2], [0, 0, -1]], np.float32)
    np.testing.assert_allclose(linalg.norm(vectors * scale) / scale, [5, 3, 1], rtol=1e-6)
    wanted = vectors / np.array([[5], [3], [1]])
    np.testing.assert_allclose(linalg.normalize(vectors * scale), wanted, rtol=1e-6)
    gradient = jax.grad(lambda v: linalg.norm(v).sum())(jnp.asarray(vectors * scale))
    np.testing.assert_allclose(gradient, wanted, atol=1e-6)


def test_zero_vectors_stay_zero_with_zero_derivatives():
    zero = jnp.zeros((2, 3))
    tangent = jnp.ones((2, 3))
    for function in (linalg.norm, linalg.normalize):
        value, derivative = jax.jvp(function, (zero,), (tangent,))
        assert not np.any(value)
        assert not np.any(derivative)
        assert not np.any(jax.grad(lambda v, f=function: f(v).sum())(zero))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9])
def test_vectors_of_few_and_of_many_components(count):
    a, b = RNG.normal(size=(2, 4, 5, count)).astype(np.float32)
    length = np.linalg.norm(a, axis=-1)
    np.testing.assert_allclose(linalg.norm(a), length, rtol=1e-5)
    np.testing.assert_allclose(linalg.normalize(a), a / length[..., None], rtol=1e-5)
    for other in (b, b[0, 0], b[:, :1], b[..., :1]):
        np.testing.assert_allclose(linalg.dot(a, other), np.sum(a * other, axis=-1), atol=1e-5)
        np.testing.assert_allclose(linalg.dot(other, a), np.sum(a * other, axis=-1), atol=1e-5)


def test_vectors_of_three_components_are_no_reductions():
    """Which take a CPU ten times as long, as does what transposes a broadcast."""
    vectors = jnp.ones((7, 3))
    for function in (linalg.norm, linalg.normalize, lambda v: linalg.dot(v, v)):
        _, pull = jax.vjp(function, vectors)
        for program in (jax.jit(function).lower(vectors), jax.jit(pull).lower(function(vectors))):
            assert "reduce" not in program.as_text()


def test_vector_derivatives_to_second_order():
    with jax.enable_x64(True):
        vectors, tangents = RNG.normal(size=(2, 4, 3))
        check_derivatives(
            lambda v: jax.jvp(lambda u: (linalg.norm(u), linalg.normalize(u)), (v,), (tangents,)),
            vectors,
        )


def test_elementary_matrices_are_those_of_the_thesis():
    point = np.array([2.0, 3.0, 5.0])
    apply = linalg.transform_points
    np.testing.assert_allclose(apply(linalg.translation((1, -1, 4)), point), [3, 2, 9])
    np.testing.assert_allclose(apply(linalg.scaling((1, 2, 3)), point), [2, 6, 15])
    np.testing.assert_allclose(apply(linalg.scaling(2), point), [4, 6, 10])
    np.testing.assert_allclose(apply(linalg.shear(xz=0.5, yz=2), point), [4.5, 13, 5])
    np.testing.assert_allclose(apply(linalg.shear(xy=1, yx=2, zx=3, zy=4), point), [5, 7, 23])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rotations_are_right_handed(axis):
    angle = 0.7
    wanted = Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    about = (linalg.rotation_x, linalg.rotation_y, linalg.rotation_z)[axis]
    np.testing.assert_allclose(about(angle)[:3, :3], wanted, atol=1e-7)
    np.testing.assert_allclose(linalg.rotation(3 * np.eye(3)[axis], angle), about(angle), atol=1e-7)
    quarter = linalg.transform_points(about(np.pi / 2), np.eye(3)[(axis + 1) % 3])
    np.testing.assert_allclose(quarter, np.eye(3)[(axis + 2) % 3], atol=1e-7)


def test_conventions_of_the_course_notes():
    # A 5.4 multiplies rows by M_z(theta) M_x(phi), which turns the axes.
    theta, phi = 0.4, 1.1
    row = np.array([1.0, 2.0, 3.0])
    product = np.asarray(linalg.rotation_z(theta) @ linalg.rotation_x(phi))[:3, :3]
    assert product[0, 1] == pytest.approx(-np.sin(theta) * np.cos(phi))  # as printed in A 5.4
    ours = linalg.compose(linalg.rotation_x(-phi), linalg.rotation_z(-theta))
    np.testing.assert_allclose(linalg.transform_points(ours, row), row @ product, rtol=1e-6)
    # D 5.4: T_y turns x towards z.
    turned = linalg.transform_points(linalg.rotation_y(-np.pi / 2), (1.0, 0.0, 0.0))
    np.testing.assert_allclose(turned, [0, 0, 1], atol=1e-7)


def test_compose_applies_right_to_left_and_invert_undoes_it():
    a, b, c = (random_matrix() for _ in range(3))
    np.testing.assert_allclose(linalg.compose(a, b, c), a @ b @ c, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(linalg.compose(), np.eye(4))
    with jax.enable_x64(True):
        general = RNG.normal(size=(4, 4))
        np.testing.assert_allclose(linalg.invert(general) @ general, np.eye(4), atol=1e-12)
        check_derivatives(linalg.invert, general)


def test_a_singular_matrix_is_refused_or_gives_zeros():
    singular = np.diag([1.0, 1.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="matrix: wanted a regular matrix"):
        linalg.invert(singular)
    assert not np.any(jax.jit(linalg.invert)(singular))
    gradient = jax.grad(lambda m: linalg.invert(m).sum())(jnp.asarray(singular))
    assert not np.any(gradient)


def test_applying_a_matrix():
    matrix = random_matrix().astype(np.float32)
    projection = RNG.normal(size=(4, 4)).astype(np.float32)
    vectors = RNG.normal(size=(2, 5, 3)).astype(np.float32)
    homogeneous = np.concatenate([vectors, np.ones((2, 5, 1))], axis=-1)
    close = {"rtol": 1e-5, "atol": 1e-6}
    np.testing.assert_allclose(
        linalg.transform_points(matrix, vectors), (homogeneous @ matrix.T)[..., :3], **close
    )
    np.testing.assert_allclose(
        linalg.project_points(projection, vectors), homogeneous @ projection.T, **close
    )
    np.testing.assert_allclose(
        linalg.transform_directions(matrix, vectors), vectors @ matrix[:3, :3].T, **close
    )


def test_copies_of_a_vertex_stay_bit_equal():
    matrix = random_matrix()
    copies = np.repeat(RNG.normal(size=(17, 3)), 7, axis=0).astype(np.float32)
    moved = np.asarray(jax.jit(linalg.project_points)(matrix, copies)).reshape(17, 7, 4)
    assert (moved == moved[:, :1]).all()


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.parametrize("scale", [1e-10, 1.0, 1e10])
def test_normals_follow_the_inverse_transpose(mirror, scale):
    matrix = random_matrix()
    matrix[:3, :3] *= mirror * scale * np.sign(np.linalg.det(matrix[:3, :3]))
    normals = RNG.normal(size=(6, 3))
    wanted = normals @ np.linalg.inv(matrix[:3, :3])
    wanted /= np.linalg.norm(wanted, axis=-1, keepdims=True)
    np.testing.assert_allclose(linalg.transform_normals(matrix, normals), wanted, atol=2e-5)


def test_normal_matrices_have_the_derivative_of_their_value():
    with jax.enable_x64(True):
        check_derivatives(linalg.normal_matrix, np.random.default_rng(1).normal(size=(4, 4)))


def test_normals_of_singular_transforms_are_finite():
    normals = jnp.asarray([[0.0, 0.0, 1.0], [1.0, 2.0, 3.0], [1.0, 0.0, 0.0]])
    flat = linalg.scaling((2, 3, 0))
    wanted = [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    np.testing.assert_array_equal(linalg.transform_normals(flat, normals), wanted)
    for matrix in (flat, linalg.scaling((1, 0, 0)), linalg.scaling(0)):
        gradient = jax.grad(lambda m: linalg.transform_normals(m, normals).sum())(matrix)
        assert np.isfinite(gradient).all()


def test_vectors_that_are_not_finite_spoil_no_derivative():
    vectors = jnp.array([[1.0, 2.0, 3.0], [np.nan, 1.0, 1.0], [1.0, -np.inf, 1.0]])

    def used(matrix, vectors):
        moved = linalg.where_finite(lambda v: linalg.transform_points(matrix, v), vectors)
        return jnp.sum(moved[:1]), moved

    with_all = jax.grad(used, argnums=(0, 1), has_aux=True)
    by_matrix, by_vectors = with_all(jnp.eye(4), vectors)[0]
    np.testing.assert_array_equal(by_matrix[:3], [[1, 2, 3, 1]] * 3)
    np.testing.assert_array_equal(by_vectors, [[1, 1, 1], [0, 0, 0], [0, 0, 0]])
    moved = used(jnp.eye(4), vectors)[1]
    np.testing.assert_array_equal(np.isnan(moved), [[False] * 3, [True] * 3, [True] * 3])


@pytest.mark.parametrize("angle", [0, 1e-20, 1e-4, 0.01, 0.99, 1.01, 2.0, 3.1, np.pi - 1e-5, np.pi])
def test_so3_exp_and_log(angle):
    axis = np.array([2.0, -3.0, 6.0]) / 7
    with jax.enable_x64(True):
        vector = axis * angle
        matrix = linalg.so3_exp(vector)
        np.testing.assert_allclose(matrix, Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
        np.testing.assert_allclose(linalg.so3_log(matrix), vector, rtol=1e-12, atol=1e-30)
    single = linalg.so3_log(linalg.so3_exp(vector.astype(np.float32)))
    if angle < 3.141:
        np.testing.assert_allclose(single, vector, rtol=1e-6)
    else:  # at pi both axes are right
        np.testing.assert_allclose(np.abs(single), np.abs(vector), rtol=1e-5)


def test_se3_exp_is_the_matrix_exponential_and_log_its_inverse():
    with jax.enable_x64(True):
        exp, log = jax.jit(linalg.se3_exp), jax.jit(linalg.se3_log)
        for scale in (0, 1e-6, 0.1, 1.0, 1.8):
            twist = scale * np.array([0.3, -2.0, 1.0, 0.9, 0.8, -1.0])
            generator = np.zeros((4, 4))
            generator[:3, :3] = np.cross(np.eye(3), twist[3:])
            generator[:3, 3] = twist[:3]
            np.testing.assert_allclose(exp(twist), expm(generator), atol=1e-14)
            np.testing.assert_allclose(log(exp(twist)), twist, rtol=1e-11, atol=1e-14)
    assert exp(np.zeros(6, np.float32)).dtype == np.float32


def test_derivatives_of_so3_exp_at_zero_are_the_generators_and_their_products():
    generators = np.stack([np.cross(np.eye(3), axis) for axis in np.eye(3)])
    symmetric = np.einsum("aij,bjk->abik", generators, generators)
    symmetric = (symmetric + symmetric.transpose(1, 0, 2, 3)) / 2
    first, second = (jax.jit(jax.jacfwd(linalg.so3_exp)), jax.jit(jax.hessian(linalg.so3_exp)))
    np.testing.assert_allclose(first(jnp.zeros(3)), generators.transpose(1, 2, 0), atol=1e-7)
    np.testing.assert_allclose(second(jnp.zeros(3)), symmetric.transpose(2, 3, 0, 1), atol=1e-6)


def test_derivatives_of_exponentials_and_logarithms():
    def there_and_back(twist):  # the logarithm through exp, so that differences stay on the group
        motion = linalg.se3_exp(twist)
        return jnp.concatenate([motion.ravel(), linalg.se3_log(motion)])

    def derivatives(twist):  # forward, reverse, and second, along one direction
        def slope(t):
            return jax.jvp(there_and_back, (t,), (direction,))[1]

        forward, second = jax.jvp(slope, (twist,), (direction,))
        reverse = jax.vjp(there_and_back, twist)[1](weights)[0]
        return forward, second, reverse @ direction

    with jax.enable_x64(True):
        direction, weights, h = RNG.normal(size=6) / 3, RNG.normal(size=22), 1e-4
        twists = np.outer([0.0, 1e-5, 0.3, 0.999, 1.001, 2.9], [0.3, -2, 1, 2 / 7, -3 / 7, 6 / 7])
        forward, second, reverse = jax.jit(jax.vmap(derivatives))(twists)
        value = jax.jit(jax.vmap(there_and_back))
        plus, middle, minus = (value(twists + k * h * direction) for k in (1, 0, -1))
        np.testing.assert_allclose(forward, (plus - minus) / (2 * h), atol=1e-6)
        np.testing.assert_allclose(second, (plus - 2 * middle + minus) / h**2, atol=1e-5)
        np.testing.assert_allclose(reverse, forward @ weights, atol=1e-12)


def test_affine_maps_far_from_the_origin():
    rotation = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix().astype(np.float32)
    eye = np.array([1e6, -2e6, 3e5], np.float32)
    points = eye + RNG.integers(-200, 200, (100, 3)).astype(np.float32) / 8
    matrix = np.concatenate([rotation, np.zeros((3, 1), np.float32)], axis=1)
    high, low = jax.jit(affine_parts)(matrix, np.zeros(3, np.float32), eye)
    matrix[:, 3] = -high
    wanted = (points.astype(float) - eye) @ rotation.astype(float).T
    np.testing.assert_allclose(jax.jit(affine)(matrix, -low, points), wanted, atol=1e-4)
    plain = points @ matrix[:, :3].T + matrix[:, 3]
    assert np.abs(plain - wanted).max() > 0.05  # what it is for


def test_derivatives_of_the_accurate_affine_map():
    with jax.enable_x64(True):
        arguments = RNG.normal(size=(4, 4)), RNG.normal(size=4), RNG.normal(size=(5, 3))
        tangents = tuple(RNG.normal(size=a.shape) for a in arguments)
        check_derivatives(lambda *a: jax.jvp(affine, a, tangents), *arguments)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: linalg.translation((1, 2)), r"offset: wanted shape \(3,\), got \(2,\)"),
        (lambda: linalg.translation((1, 2, np.nan)), "offset: wanted finite numbers"),
        (lambda: linalg.scaling((1, 2)), "factors: wanted one number or three"),
        (lambda: linalg.rotation((0, 0, 0), 1.0), "axis: wanted a vector that is not zero"),
        (lambda: linalg.shear(xz=np.ones(2)), "xz: wanted shape"),
        (lambda: linalg.compose(np.eye(4), np.eye(3)), r"matrices\[1\]: wanted shape"),
        (lambda: linalg.transform_points(np.eye(3), np.ones(3)), "matrix: wanted shape"),
        (lambda: linalg.transform_points(np.eye(4), np.ones((5, 2))), "points: wanted shape"),
        (lambda: linalg.so3_exp(np.ones(4)), "rotation_vector: wanted shape"),
        (lambda: linalg.se3_exp(np.ones(3)), "twist: wanted shape"),
    ],
)
def test_errors_name_the_argument(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_zero_axis_of_unknown_value_turns_nothing():
    matrix, derivative = jax.jvp(
        lambda axis: linalg.rotation(axis, 1.0), (jnp.zeros(3),), (jnp.ones(3),)
    )
    np.testing.assert_array_equal(matrix, np.eye(4))
    assert np.isfinite(derivative).all()


def test_known_matrices_are_inverted_inside_of_jit():
    inverse = jax.jit(lambda: linalg.invert(2 * np.eye(4)))()
    np.testing.assert_array_equal(inverse, np.eye(4) / 2)
    with pytest.raises(ValueError, match="matrix: wanted a regular matrix"):
        jax.jit(lambda: linalg.invert(np.ones((4, 4))))()
