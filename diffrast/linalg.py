"""Vectors, homogeneous transforms, and the exponentials of rotations and rigid motions.

Points are columns: a 4x4 matrix acts as `matrix @ (x, y, z, 1)`, and `compose(A, B)` applies B
first. Rotations are right-handed: seen from the tip of the axis a positive angle turns
counter-clockwise, `rotation_z(pi / 2)` takes x to y. Angles are in radians.

How the sources write the same maps:

- A (section 5) multiplies rows, `(x, y, z, 1) V`: V is the transpose of the matrix here. Its
  M_x(a), M_y(a), M_z(a) turn the axes, not the points: as arrays they equal `rotation_x(a)`, ...,
  so on the row's right they act as `rotation_x(-a)`, ... do here.
- C 2.1 multiplies rows too, C 2.2 columns as here; the matrices of C 2.2 are ours.
- D 5 multiplies columns, but its T_y(a) turns the other way: it is `rotation_y(-a)`.

No function here has an absolute threshold: vectors of length 1e-30 or 1e+30 in float32 are as good
as others, and exactly degenerate input has a defined value with a finite gradient.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from diffrast._check import ArrayInput, float_array, is_concrete, known_of_known, staying_known
from diffrast._stored import stored

_FEW = range(2, 5)  # components of a vector

# ------------------------------------------------------------------------------------- vectors


def dot(a: ArrayLike, b: ArrayLike) -> Float[Array, "..."]:
    """Inner product over the last axis; the other axes broadcast.

    Raises:
        ValueError: for shapes that do not go together.
    """
    a = float_array("a", a, ("...", "n"), finite=False)
    b = float_array("b", b, ("...", "n"), finite=False)
    try:
        count = np.broadcast_shapes(a.shape, b.shape)[-1]
    except ValueError as error:
        raise ValueError(f"b: wanted a shape that goes with {a.shape}, got {b.shape}") from error
    if count not in _FEW or max(a.ndim, b.ndim) < 2:
        return jnp.sum(a * b, axis=-1)
    a, b = (jnp.broadcast_to(x, (*x.shape[:-1], count)) for x in (a, b))
    return _sum(a[..., i] * b[..., i] for i in range(count))


def norm(vectors: ArrayLike) -> Float[Array, "..."]:
    """Euclidean length over the last axis; the gradient of a zero vector is zero."""
    unit_box, magnitude = _scaled_to_unit_box(vectors)
    return jnp.where(magnitude > 0, magnitude * _length(unit_box), 0)


def normalize(vectors: ArrayLike) -> Float[Array, "... n"]:
    """Unit vectors over the last axis; a zero vector stays zero, with zero gradient."""
    unit_box, magnitude = _scaled_to_unit_box(vectors)
    length = _length(unit_box)
    return _joined([jnp.where(magnitude > 0, x / length, 0) for x in unit_box])


def null_vector(rows: Float[Array, "3 4"]) -> Float[Array, "4"]:
    """The generalised cross product: perpendicular to three rows, of any length.

    It is the homogeneous point in which three planes meet. Dependent rows give zeros, and where
    the planes meet at infinity the last component is exactly zero if the rows hold it exactly.
    """
    size = jnp.max(jnp.abs(rows[:, :3]), axis=1, keepdims=True)
    size = jnp.where(size > 0, size, jnp.max(jnp.abs(rows), axis=1, keepdims=True))
    a, b, c = rows / jax.lax.stop_gradient(jnp.where(size > 0, size, 1))
    bc, ca, ab = (jnp.cross(p[:3], q[:3]) for p, q in ((b, c), (c, a), (a, b)))
    return jnp.append(a[3] * bc + b[3] * ca + c[3] * ab, -dot(a[:3], bc))


def _scaled_to_unit_box(vectors: ArrayLike) -> tuple[list[Array], Array]:
    """Components divided by the largest magnitude, so that squares neither over- nor underflow.

    Zero vectors become ones, for the caller to select away. The magnitude carries no gradient:
    where it is used it cancels.
    """
    vectors = float_array("vectors", vectors, ("...", "n"), finite=False)
    if vectors.shape[-1] == 0:
        raise ValueError(f"vectors: wanted at least one component, got shape {vectors.shape}")
    parts = _components(vectors)
    magnitude = jax.lax.stop_gradient(_reduced(map(jnp.abs, parts), jnp.maximum, jnp.max))
    zero = magnitude == 0
    return [jnp.where(zero, 1, x) / jnp.where(zero, 1, magnitude) for x in parts], magnitude


def _length(parts: list[Array]) -> Array:
    return jnp.sqrt(_reduced((x * x for x in parts), operator.add, jnp.sum))


def _components(vectors: Array) -> list[Array]:
    """Along the last axis, each for itself; where they are many all in one, along a first axis.

    Reductions of few are calls of a library on a CPU, and take ten times as long as sums of
    columns; so does what transposes a column that was broadcast along them. But they have the same
    bits in every program, so they are right for a single vector.
    """
    if vectors.shape[-1] in _FEW and vectors.ndim > 1:
        return [vectors[..., i] for i in range(vectors.shape[-1])]
    return [jnp.moveaxis(vectors, -1, 0)]


def _reduced(
    parts: Iterable[Array], pair: Callable[[Array, Array], Array], whole: Callable[..., Array]
) -> Array:
    """All components in one, by `pair` of two or, where they are many, by `whole`."""
    first, *others = parts
    return functools.reduce(pair, others, first) if others else whole(first, axis=0)


def _joined(parts: list[Array]) -> Array:
    """The inverse of `_components`."""
    return jnp.stack(parts, axis=-1) if len(parts) > 1 else jnp.moveaxis(parts[0], 0, -1)


# -------------------------------------------------------------------------- building transforms


@known_of_known
def translation(offset: ArrayInput) -> Float[Array, "4 4"]:
    """Matrix that moves points by `offset` (3,). FEATURES T1."""
    offset = float_array("offset", offset, (3,))
    return _homogeneous(jnp.eye(3, dtype=offset.dtype), offset)


@known_of_known
def scaling(factors: ArrayInput) -> Float[Array, "4 4"]:
    """Matrix that scales x, y, z by `factors`: one number or three. FEATURES T1."""
    factors = float_array("factors", factors)
    if factors.shape not in ((), (3,)):
        raise ValueError(f"factors: wanted one number or three, got shape {factors.shape}")
    return _homogeneous(jnp.diag(jnp.broadcast_to(factors, (3,))))


@known_of_known
def rotation(axis: ArrayInput, angle: ArrayLike) -> Float[Array, "4 4"]:
    """Right-handed rotation by `angle` about `axis` (3,) of any length. FEATURES T1.

    Differentiable in both. A zero axis gives the identity where its value is not known.

    Raises:
        ValueError: for an axis known to be zero.
    """
    axis = float_array("axis", axis, (3,))
    if is_concrete(axis) and not np.any(np.asarray(axis)):
        raise ValueError("axis: wanted a vector that is not zero, got (0, 0, 0)")
    angle = float_array("angle", angle, ())
    turn = _cross_matrix(normalize(axis))
    versine = 2 * jnp.sin(angle / 2) ** 2
    eye = jnp.eye(3, dtype=turn.dtype)
    return _homogeneous(eye + jnp.sin(angle) * turn + versine * _matmul(turn, turn))


@known_of_known
def rotation_x(angle: ArrayLike) -> Float[Array, "4 4"]:
    """Rotation about the x axis, y towards z. FEATURES T1."""
    return _axis_rotation(0, angle)


@known_of_known
def rotation_y(angle: ArrayLike) -> Float[Array, "4 4"]:
    """Rotation about the y axis, z towards x. FEATURES T1."""
    return _axis_rotation(1, angle)


@known_of_known
def rotation_z(angle: ArrayLike) -> Float[Array, "4 4"]:
    """Rotation about the z axis, x towards y. FEATURES T1."""
    return _axis_rotation(2, angle)


def _axis_rotation(axis: int, angle: ArrayLike) -> Array:
    angle = float_array("angle", angle, ())
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = jnp.eye(4, dtype=angle.dtype)
    matrix = matrix.at[first, first].set(cosine).at[second, second].set(cosine)
    return matrix.at[second, first].set(sine).at[first, second].set(-sine)


@known_of_known
def shear(
    *,
    xy: ArrayLike = 0.0,
    xz: ArrayLike = 0.0,
    yx: ArrayLike = 0.0,
    yz: ArrayLike = 0.0,
    zx: ArrayLike = 0.0,
    zy: ArrayLike = 0.0,
) -> Float[Array, "4 4"]:
    """Shear: `xz` is how far x moves per unit of z, and so on. FEATURES T1.

    The thesis's SH_xy(shx, shy) (C 2.2.6) is `shear(xz=shx, yz=shy)`.
    """
    rows = ((1.0, xy, xz), (yx, 1.0, yz), (zx, zy, 1.0))
    entries = [float_array("xyz"[i] + "xyz"[j], rows[i][j], ()) for i in range(3) for j in range(3)]
    return _homogeneous(jnp.stack(entries).reshape(3, 3))


@known_of_known
def compose(*matrices: ArrayInput) -> Float[Array, "4 4"]:
    """Product of 4x4 matrices: the rightmost acts first. None at all is the identity.

    In full precision, which `@` lacks on a GPU or TPU unless JAX is told so.

    Example:
        >>> turn = dr.linalg.rotation((0, 0, 1), np.pi / 2)
        >>> move = dr.linalg.translation((1, 0, 0))
        >>> both = dr.linalg.compose(move, turn)
        >>> dr.linalg.transform_points(both, jnp.array([2.0, 0, 0])).round(4).tolist()
        [1.0, 2.0, 0.0]
    """
    checked = [float_array(f"matrices[{i}]", m, (4, 4)) for i, m in enumerate(matrices)]
    return functools.reduce(_matmul, checked) if checked else jnp.eye(4)


def invert(matrix: ArrayInput) -> Float[Array, "4 4"]:
    """Inverse of any regular 4x4 matrix, differentiable.

    Raises:
        ValueError: for a matrix known to be singular. A singular matrix whose value is not known
            (under `jit`) gives zeros with zero gradient.
    """
    matrix = float_array("matrix", matrix, (4, 4))
    with staying_known(matrix):
        regular = jnp.all(jnp.isfinite(jnp.linalg.inv(jax.lax.stop_gradient(matrix))))
    if is_concrete(matrix) and not regular:
        raise ValueError(f"matrix: wanted a regular matrix, got {np.asarray(matrix).tolist()}")
    safe = jnp.where(regular, matrix, jnp.eye(4, dtype=matrix.dtype))
    return jnp.where(regular, jnp.linalg.inv(safe), 0)


# -------------------------------------------------------------------------- applying transforms


def apply_matrix(
    matrix: Float[Array, "rows columns"], vectors: Float[Array, "*batch columns"]
) -> Float[Array, "*batch rows"]:
    """`matrix @ vector` in plain multiply-adds.

    Every vector goes through the same operations wherever it stands in the array, so copies of a
    vertex stay bit-equal, and no accelerator rounds the factors as it may for a matrix product.

    Raises:
        ValueError: for vectors of another length than the matrix's rows.
    """
    matrix = float_array("matrix", matrix, ("rows", "columns"), finite=False)
    vectors = float_array("vectors", vectors, ("...", matrix.shape[1]), finite=False)
    dtype = jnp.result_type(matrix, vectors)
    return _applied(matrix.astype(dtype), vectors.astype(dtype))


@jax.custom_jvp
def _applied(matrix: Array, vectors: Array) -> Array:
    return _sum(vectors[..., k, None] * matrix[:, k] for k in range(matrix.shape[1]))


@functools.partial(_applied.defjvp, symbolic_zeros=True)
def _applied_derivative(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """The same, so written that XLA's CPU transposes it in one pass over the vectors.

    By vectors each number of the matrix for itself: of whole rows the transpose holds one copy a
    vector, and adds up products by a library. By the matrix as a product of matrices.
    """
    (matrix, vectors), (d_matrix, d_vectors) = primals, tangents
    rows, columns = matrix.shape
    parts = []
    if not isinstance(d_vectors, SymbolicZero):
        d = [d_vectors[..., k] for k in range(columns)]
        moved = [_sum(matrix[r, k] * d[k] for k in range(columns)) for r in range(rows)]
        parts.append(jnp.stack(moved, axis=-1))
    if not isinstance(d_matrix, SymbolicZero):
        parts.append(_matmul(vectors, d_matrix.T))
    return _applied(matrix, vectors), _sum(parts)


def _sum(terms: Iterable[Array]) -> Array:
    return functools.reduce(operator.add, terms)


def transform_points(matrix: ArrayInput, points: ArrayInput) -> Float[Array, "*batch 3"]:
    """Apply an affine 4x4 matrix to points (..., 3). Its last row is taken as (0, 0, 0, 1)."""
    matrix, points = _matrix_and_vectors(matrix, "points", points)
    return apply_matrix(matrix[:3, :3], points) + matrix[:3, 3]


def project_points(matrix: ArrayInput, points: ArrayInput) -> Float[Array, "*batch 4"]:
    """Apply a 4x4 matrix to points (..., 3) and keep the homogeneous result (..., 4)."""
    matrix, points = _matrix_and_vectors(matrix, "points", points)
    return apply_matrix(matrix[:, :3], points) + matrix[:, 3]


def transform_directions(matrix: ArrayInput, directions: ArrayInput) -> Float[Array, "*batch 3"]:
    """Apply the linear part of an affine 4x4 matrix to directions (..., 3); lengths change."""
    matrix, directions = _matrix_and_vectors(matrix, "directions", directions)
    return apply_matrix(matrix[:3, :3], directions)


def transform_normals(matrix: ArrayInput, normals: ArrayInput) -> Float[Array, "*batch 3"]:
    """Unit normals (..., 3) of surfaces that an affine 4x4 matrix moves; a zero one stays zero."""
    matrix, normals = _matrix_and_vectors(matrix, "normals", normals)
    return normalize(apply_matrix(_normal_turn(matrix), normals))


def normal_matrix(matrix: ArrayInput) -> Float[Array, "3 3"]:
    """What an affine 4x4 matrix does to normals, but for their length. Differentiable.

    A multiple of the inverse transpose, by cofactors of the matrix divided by its largest number: a
    matrix that flattens space gives normals of the plane it flattens to.
    """
    linear = float_array("matrix", matrix, (4, 4), finite=False)[:3, :3]
    return _cofactors(linear, jnp.max(jnp.abs(linear)))


def _normal_turn(matrix: Float[Array, "4 4"]) -> Float[Array, "3 3"]:
    """The same for normals that become unit vectors: its derivative leaves out their length."""
    linear = matrix[:3, :3]
    return _cofactors(linear, jax.lax.stop_gradient(jnp.max(jnp.abs(linear))))


def _cofactors(linear: Array, largest: Array) -> Array:
    a, b, c = (linear / jnp.where(largest > 0, largest, 1)).T
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    orientation = jnp.where(dot(a, cofactors[:, 0]) < 0, -1, 1)
    return orientation * cofactors


def where_finite(function: Callable[[Array], Array], vectors: Array) -> Array:
    """`function(vectors)`, and NaN without a derivative where a vector (last axis) is not finite.

    Where the result is not used its cotangent is zero, but zero times NaN is NaN: one such vector
    would spoil the derivative by all that the vectors have in common.
    """
    # One by one: of a constant XLA folds a reduction some hundred times as slowly.
    parts = [jnp.isfinite(vectors[..., i]) for i in range(vectors.shape[-1])]
    finite = functools.reduce(operator.and_, parts)
    finite = (stored(finite.astype(jnp.int8)) > 0)[..., None]  # which the transpose holds
    return jnp.where(finite, function(jnp.where(finite, vectors, 0)), jnp.nan)


def mirrors(matrix: ArrayInput) -> Bool[Array, ""]:
    """Whether a 4x4 matrix mirrors: turns right hands into left ones, and the faces of meshes."""
    x, y, z = normalize(float_array("matrix", matrix, (4, 4), finite=False)[:3, :3])
    return dot(jnp.cross(x, y), z) < 0


def _matrix_and_vectors(matrix: ArrayInput, name: str, vectors: ArrayInput) -> tuple[Array, Array]:
    # Vectors may be many: their values are not read back to be checked.
    matrix = float_array("matrix", matrix, (4, 4), finite=False)
    return matrix, float_array(name, vectors, ("...", 3), finite=False)


_matmul = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


def _homogeneous(linear: Array, offset: Array | None = None) -> Array:
    """The 4x4 matrix of an affine map."""
    column = jnp.zeros(3, linear.dtype) if offset is None else offset
    upper = jnp.concatenate([linear, column[:, None]], axis=1)
    return jnp.concatenate([upper, jnp.array([[0, 0, 0, 1]], upper.dtype)])


def _cross_matrix(vector: Array) -> Array:
    """The matrix K with `K @ u = cross(vector, u)`."""
    return jnp.cross(jnp.eye(3, dtype=vector.dtype), vector)


# ----------------------------------------------------------------------- so(3) and se(3)
# With x = angle^2 everything is written in the Stumpff functions
#     c_k(x) = 1/k! - x/(k+2)! + x^2/(k+4)! - ... ,    c_k = 1/k! - x c_{k+2},
# which are entire: c_1 = sin(angle)/angle, c_2 = (1 - cos(angle))/angle^2, and so on.


def so3_exp(rotation_vector: ArrayInput) -> Float[Array, "3 3"]:
    """Rotation matrix of a rotation vector (3,): axis times angle in radians.

    Exact and smooth everywhere, with the right derivatives of every order at zero. FEATURES T1.
    """
    vector = float_array("rotation_vector", rotation_vector, (3,))
    x = dot(vector, vector)
    outer = vector[:, None] * vector
    eye = jnp.eye(3, dtype=vector.dtype)
    return eye + _stumpff(1, x) * _cross_matrix(vector) + _stumpff(2, x) * (outer - x * eye)


def so3_log(matrix: ArrayInput) -> Float[Array, "3"]:
    """Rotation vector, of length at most pi, of a rotation matrix (3, 3).

    The inverse of `so3_exp`, through the unit quaternion, accurate up to and at pi; there the two
    axes are equally good and one is returned.
    """
    quaternion = _quaternion(float_array("matrix", matrix, (3, 3)))
    cosine, sines = quaternion[0], quaternion[1:]
    # angle / sin(angle / 2) as a function of the squared tangent where the angle is small.
    squared_sine = dot(sines, sines)
    near = squared_sine < 0.05 * cosine**2
    tangent2 = jnp.where(near, squared_sine / jnp.where(near, cosine**2, 1), 0)
    terms = [(-1) ** n / (2 * n + 1) for n in range(14)]
    series = 2 * jnp.polyval(jnp.array(terms[::-1], tangent2.dtype), tangent2)
    sine = jnp.sqrt(jnp.where(near, 1, squared_sine))
    ratio = 2 * jnp.arctan2(sine, jnp.where(near, 1, cosine)) / sine
    return sines * jnp.where(near, series / jnp.where(near, cosine, 1), ratio)


def se3_exp(twist: ArrayInput) -> Float[Array, "4 4"]:
    """Rigid motion of a twist (6,): translational part first, then the rotation vector.

    The motion that runs for unit time with a constant twist; its translation column equals
    `twist[:3]` only where nothing turns. Smooth everywhere, so `compose(se3_exp(step), pose)` is a
    good way to fit a pose. FEATURES T1.
    """
    twist = float_array("twist", twist, (6,))
    velocity, vector = twist[:3], twist[3:]
    x = dot(vector, vector)
    across = jnp.cross(vector, velocity)
    offset = velocity + _stumpff(2, x) * across + _stumpff(3, x) * jnp.cross(vector, across)
    return _homogeneous(so3_exp(vector), offset)


def se3_log(matrix: ArrayInput) -> Float[Array, "6"]:
    """Twist (6,), translational part first, of a rigid motion (4, 4): inverse of `se3_exp`."""
    matrix = float_array("matrix", matrix, (4, 4))
    vector, offset = so3_log(matrix[:3, :3]), matrix[:3, 3]
    x = dot(vector, vector)
    across = jnp.cross(vector, offset)
    curvature = (_stumpff(3, x) - 2 * _stumpff(4, x)) / (2 * _stumpff(2, x))
    velocity = offset - across / 2 + curvature * jnp.cross(vector, across)
    return jnp.concatenate([velocity, vector])


def _quaternion(matrix: Array) -> Array:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    # 4 q q^T: every row is a multiple of q, and the one with the largest diagonal is accurate.
    products = jnp.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    row = normalize(products[jnp.argmax(jnp.diag(products))])
    return jnp.where(row[0] < 0, -row, row)


def _stumpff(order: int, x: Array) -> Array:
    """c_order(x) for x >= 0."""
    small = x < 1
    terms = [(-1) ** n / math.factorial(2 * n + order) for n in range(12)]
    series = jnp.polyval(jnp.array(terms[::-1], x.dtype), jnp.where(small, x, 0))
    return jnp.where(small, series, _stumpff_closed(order, jnp.where(small, 1, x)))


def _stumpff_closed(order: int, x: Array) -> Array:
    """c_order(x) in closed form, for x well away from zero."""
    angle = jnp.sqrt(x)
    if order == 1:
        return jnp.sin(angle) / angle
    if order == 2:
        return 2 * (jnp.sin(angle / 2) / angle) ** 2
    return (1 / math.factorial(order - 2) - _stumpff_closed(order - 2, x)) / x
