"""The linear algebra of nonlinear least squares, used by `diffrast.fit.least_squares`.

On the device: residuals, the columns of their Jacobian, and the products of these. On the host, in
float64: the small systems of normal equations. Each column is divided by its largest entry before
the products are made, so parameters of any unit neither overflow nor underflow in float32; each
system is solved in units in which its diagonal is one, and leaves alone the directions which the
data do not tell from rounding.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

ENTRIES_AT_ONCE = 2**22


def _squared(r: Array, scale: Array) -> tuple[Array, Array]:
    return 0.5 * r**2, jnp.ones_like(r)


def _huber(r: Array, scale: Array) -> tuple[Array, Array]:
    u = jnp.abs(r) / scale
    return scale**2 * jnp.where(u <= 1, 0.5 * u**2, u - 0.5), 1 / jnp.sqrt(jnp.maximum(u, 1))


def _cauchy(r: Array, scale: Array) -> tuple[Array, Array]:
    u = r / scale
    return 0.5 * scale**2 * jnp.log1p(u**2), 1 / jnp.hypot(1.0, u)


def _geman_mcclure(r: Array, scale: Array) -> tuple[Array, Array]:
    hypotenuse = jnp.hypot(1.0, r / scale)
    return 0.5 * (r / hypotenuse) ** 2, 1 / hypotenuse**2


# Name → residuals, scale → their losses ρ and the square roots of their weights ρ'(r) / r.
ROBUST_LOSSES: dict[str, Callable[[Array, Array], tuple[Array, Array]]] = {
    "squared": _squared,
    "huber": _huber,
    "cauchy": _cauchy,
    "geman_mcclure": _geman_mcclure,
}


class Point(NamedTuple):
    """Parameters and all that is known about the loss there; n parameters, flattened."""

    params: Any
    flat: Float[np.ndarray, " n"]
    loss: float
    gradient: Float[np.ndarray, " n"]
    normal_matrix: Float[np.ndarray, "n n"]
    residual_count: int
    epsilon: float

    @property
    def finite(self) -> bool:
        """Whether loss, gradient and normal matrix are free of NaN and infinity."""
        numbers = (self.loss, self.gradient, self.normal_matrix)
        return all(bool(np.all(np.isfinite(number))) for number in numbers)

    def verdict(self, tolerance: float) -> str | None:
        """Say why there is nothing left to gain here, if so. See `fit.least_squares`."""
        tolerance = max(tolerance, self.epsilon)
        if not self.gradient.any():
            return "the gradient is zero"
        step = -solve(self.normal_matrix, self.gradient, self.epsilon)
        if -0.5 * self.gradient @ step <= tolerance * self.loss:
            return "the loss can fall by less than the tolerance"
        influence = np.sqrt(np.diag(self.normal_matrix))
        if np.linalg.norm(influence * step) <= tolerance * np.linalg.norm(influence * self.flat):
            return "the step left is below the tolerance"
        return None

    def covariance(self) -> Float[np.ndarray, "n n"]:
        """Estimate the covariance of the parameters. See `fit.FitResult`."""
        scale, values, vectors = _eigen(self.normal_matrix)
        known = values > len(values) * self.epsilon
        inverse = vectors[:, known] / values[known] @ vectors[:, known].T
        variance = 2 * self.loss / max(self.residual_count - len(values), 1)
        covariance = variance * inverse / np.outer(scale, scale)
        undetermined = np.sum(vectors[:, ~known] ** 2, axis=1) > math.sqrt(self.epsilon)
        covariance[undetermined, :] = covariance[:, undetermined] = np.nan
        covariance[undetermined, undetermined] = np.inf
        return covariance


def evaluate(
    residuals: Callable[..., Any],
    params: Any,
    step: Float[np.ndarray, " n"],
    args: tuple[Any, ...],
    *,
    loss: str,
    scale: float,
    chunk: int | None,
) -> Point:
    """Evaluate residuals and normal equations at `params` moved by the flat `step`."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite will be rejected
        step = step.astype(jnp.result_type(float))
        params, *values = _normal_equations(
            residuals, params, step, args, np.asarray(scale), loss=loss, chunk=chunk
        )
        flat, cost, gradient, matrix, peaks, count = jax.device_get(values)
        peaks = peaks.astype(np.float64)
        gradient, matrix = gradient * peaks, matrix * np.outer(peaks, peaks)
    return Point(
        params=params,
        flat=flat.astype(np.float64),
        loss=float(cost),
        gradient=gradient,
        normal_matrix=matrix,
        residual_count=int(count),
        epsilon=float(jnp.finfo(flat.dtype).eps),
    )


@functools.partial(jax.jit, static_argnames=("residuals", "loss", "chunk"))
def _normal_equations(
    residuals: Callable[..., Any],
    params: Any,
    step: Array,
    args: tuple[Any, ...],
    scale: Array,
    *,
    loss: str,
    chunk: int | None,
) -> tuple[Any, Array, Array, Array, Array, Array, int]:
    """Return the parameters moved by `step`, as a tree and flat, the loss, and JᵀWr, JᵀWJ.

    Both products are of columns divided by their largest entries, which come next; last comes
    the number of residuals.
    """
    flat, unravel = ravel_pytree(params)
    flat = flat + step.astype(flat.dtype)

    def flat_residuals(x: Array) -> Array:
        result = residuals(unravel(x), *args)
        if not jax.tree.leaves(result):
            raise ValueError(f"residuals: wanted a function to arrays, got {result!r} from it")
        r = ravel_pytree(result)[0]
        if not jnp.issubdtype(r.dtype, jnp.floating):
            raise ValueError(f"residuals: wanted floating-point numbers, got dtype {r.dtype}")
        return r

    r, derivative = jax.linearize(flat_residuals, flat)
    costs, root_weights = ROBUST_LOSSES[loss](r, scale.astype(r.dtype))

    def scaled_column(tangent: Array) -> tuple[Array, Array]:
        column = root_weights * derivative(tangent)
        peak = jnp.max(jnp.abs(column), initial=0.0)
        return column / jnp.where(peak == 0, 1.0, peak), peak

    basis = jnp.eye(flat.size, dtype=flat.dtype)
    chunk = chunk or max(ENTRIES_AT_ONCE // max(r.size, 1), 1)
    if chunk < flat.size:
        columns, peaks = jax.lax.map(scaled_column, basis, batch_size=chunk)
    else:
        columns, peaks = jax.vmap(scaled_column)(basis)
    product = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
    gradient, matrix = product(columns, root_weights * r), product(columns, columns.T)
    return unravel(flat), flat, jnp.sum(costs), gradient, matrix, peaks, r.size


class StepControl:
    """Proposes steps and learns from their success.

    Levenberg-Marquardt steps are damped, with Nielsen's update of the damping and the largest
    diagonal met so far (Moré). Gauss-Newton steps are halved as long as they fail.
    """

    def __init__(self, method: str, damping: float):
        self.damping = damping if method == "levenberg_marquardt" else math.nan  # NaN: undamped
        self._growth = 2.0
        self._diagonal: Any = 0.0
        self._length = 1.0

    @property
    def exhausted(self) -> bool:
        """Whether steps have become too short to matter without lowering the loss."""
        return self.damping > 1e16 or self._length < 1e-10

    def propose(self, point: Point) -> Float[np.ndarray, " n"]:
        """Return the step to try next."""
        if math.isnan(self.damping):
            return -self._length * solve(point.normal_matrix, point.gradient, point.epsilon)
        self._diagonal = np.maximum(self._diagonal, np.diag(point.normal_matrix))
        damped = point.normal_matrix + np.diag(self.damping * self._diagonal)
        return -solve(damped, point.gradient, point.epsilon)

    def judge(self, point: Point, trial: Point, step: Float[np.ndarray, " n"]) -> Point:
        """Return the trial if it lowers the loss, else the point; adapt the next step."""
        predicted = -(point.gradient + 0.5 * point.normal_matrix @ step) @ step
        if not (trial.finite and predicted > 0 and trial.loss < point.loss):
            self.damping *= self._growth
            self._growth *= 2
            self._length /= 2
            return point
        gain = (point.loss - trial.loss) / predicted
        shrink = max(1 / 3, 1 - (2 * gain - 1) ** 3)
        self.damping = max(self.damping * shrink, trial.epsilon)
        self._growth = 2.0
        self._length = 1.0
        return trial


def solve(
    matrix: Float[np.ndarray, "n n"], vector: Float[np.ndarray, " n"], epsilon: float
) -> Float[np.ndarray, " n"]:
    """Solve a symmetric positive semi-definite system, with zero along its null space.

    The matrix is scaled to unit diagonal; what is then below its rounding errors counts as zero.
    """
    scale, values, vectors = _eigen(matrix)
    known = values > len(values) * epsilon
    return vectors[:, known] @ (vectors[:, known].T @ (vector / scale) / values[known]) / scale


def _eigen(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the units that scale a matrix to unit diagonal, and its eigensystem in them."""
    diagonal = np.diag(matrix)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return scale, *np.linalg.eigh(matrix / np.outer(scale, scale))
