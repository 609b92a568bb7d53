"""Fitting the parameters of a function, say of a rendered image, to data.

`minimize` follows the gradient of a scalar loss with any optax optimizer. `least_squares` takes
residuals, say rendered minus target pixels, and solves for few parameters in few steps: the
Jacobian J is made column by column in forward mode, and the step is the solution of

    (Jᵀ W J + damping D) step = -Jᵀ W r,        D = diag(Jᵀ W J), its largest value so far,

which does not depend on the units of the parameters (Marquardt 1963; Moré 1978). W holds the
weights by which a robust loss discounts outliers (iteratively reweighted least squares). The
damping follows the ratio of the achieved to the predicted decrease (Nielsen 1999).

Both compile once for each function object and set of array shapes. Pass data that changes, such
as target images, as `args`, and pass the same function each time. A function is anything
hashable that can be traced by JAX; parameters are any pytree of real arrays.

Visibility gradients reach as far as a pixel's neighbourhood. A start that is many pixels off is
therefore fitted coarse to fine: residuals of `gaussian_blur` or `downsample` of the difference,
one call after another, each from the parameters of the last.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from jaxtyping import Float

from diffrast import _least_squares, linalg
from diffrast._check import (
    array_tree,
    flag,
    float_array,
    instance_of,
    is_concrete,
    one_of,
    positive_int,
    real_number,
    strongly_typed,
)
from diffrast._fit_result import Callback as Callback
from diffrast._fit_result import FitResult as FitResult
from diffrast._fit_result import History as History
from diffrast._fit_result import Log, Params
from diffrast._scale_space import downsample as downsample
from diffrast._scale_space import gaussian_blur as gaussian_blur


def minimize(
    loss: Callable[..., Any],
    params: Params,
    *,
    args: tuple[Any, ...] = (),
    optimizer: optax.GradientTransformation | None = None,
    steps: int = 500,
    tolerance: float | None = None,
    patience: int = 50,
    record_params: bool = False,
    progress: bool = False,
    callback: Callback | None = None,
) -> FitResult:
    """Minimise a scalar function of a pytree by its gradient.

    Args:
        loss: `loss(params, *args)`, a scalar; differentiated in reverse mode.
        params: where to start.
        args: further arguments, pytrees of arrays. New values do not recompile.
        optimizer: from optax, line searches such as `optax.lbfgs()` included. By default
            `optax.adam` with a step size that falls from 0.01 to 0 along a cosine, which moves
            a parameter by at most about 0.005 × `steps`. Keep the object for the next call: each
            one is compiled for itself.
        steps: number of steps at most.
        tolerance: converged when `patience` steps lower the best loss by less than this fraction.
            With `None` all steps are taken.
        patience: see `tolerance`.
        record_params: keep the parameters of every step in the history.
        progress: show a progress bar, by tqdm.
        callback: called as `callback(step, params, loss)`; the fit stops if it returns True.

    Returns:
        The best parameters met. A loss or gradient that becomes NaN or infinite ends the fit.

    Raises:
        ValueError: for parameters that are not real and finite, or without any number, and for a
            loss that is not a scalar or has no finite value or gradient at the start.
    """
    _check_function("loss", loss)
    params = _float_tree(params)
    record_params, progress = _check_log(args, record_params, progress, callback)
    steps, patience = positive_int("steps", steps), positive_int("patience", patience)
    tolerance = None if tolerance is None else float(real_number("tolerance", tolerance, above=0))
    optimizer = _default_optimizer(steps) if optimizer is None else optimizer
    instance_of("optimizer", optimizer, optax.GradientTransformation)

    state = jax.tree.map(strongly_typed, optimizer.init(params))
    best, converged, reason = params, False, f"all {steps} steps taken"
    renders = 0
    with Log(steps, record_params, progress, callback) as log:
        for step in range(steps + 1):  # the last evaluation only measures what step `steps` gave
            following = _gradient_step(loss, optimizer, params, state, args)
            value, gradient_norm, searched = map(float, jax.device_get(following[2:]))
            renders += 1
            if not (math.isfinite(value) and math.isfinite(gradient_norm)):
                if step == 0:
                    raise _not_finite("loss", value, gradient_norm)
                reason = f"loss {value} with gradient of norm {gradient_norm} at step {step}"
                break
            if value < min(log.losses, default=math.inf):
                best = params
            if log.add(params, value, gradient_norm):
                reason = "stopped by the callback"
                break
            if gradient_norm == 0 or _stalled(log.losses, patience, tolerance):
                converged = True
                reason = "the loss no longer falls" if gradient_norm else "the gradient is zero"
                break
            params, state = following[:2]
            renders += int(searched)
    return FitResult(
        params=best,
        loss=min(log.losses),
        history=log.history(),
        steps=step,
        renders=renders,
        derivatives=renders,
        converged=converged,
        reason=reason,
        seconds=log.seconds,
    )


@functools.lru_cache(maxsize=32)
def _default_optimizer(steps: int) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(1e-2, steps))


def _stalled(losses: list[float], patience: int, tolerance: float | None) -> bool:
    if tolerance is None or len(losses) <= patience:
        return False
    before = min(losses[:-patience])
    return before - min(losses) <= tolerance * abs(before)


@functools.partial(jax.jit, static_argnames=("loss", "optimizer"))
def _gradient_step(
    loss: Callable[..., Any],
    optimizer: optax.GradientTransformation,
    params: Params,
    state: Any,
    args: tuple[Any, ...],
) -> tuple[Params, Any, Array, Array, Array]:
    """Return the next parameters and optimizer state, loss and gradient norm, and evaluations.

    These are the ones of a line search, as optax's own tell their number.
    """

    def value_of(params: Params) -> Array:
        result = loss(params, *args)
        if result is None:
            raise ValueError("loss: wanted a function to a scalar, got one that returns nothing")
        value = jnp.asarray(result)
        if value.shape != ():
            raise ValueError(f"loss: wanted a function to a scalar, got shape {value.shape}")
        return value

    value, gradient = jax.value_and_grad(value_of)(params)
    with jax.numpy_dtype_promotion("standard"):  # optax counts steps, and divides the count
        updates, state = optax.with_extra_args_support(optimizer).update(
            gradient, state, params, value=value, grad=gradient, value_fn=value_of
        )
    gradient_norm = linalg.norm(ravel_pytree(gradient)[0])
    searched = jnp.asarray(optax.tree_utils.tree_get(state, "num_linesearch_steps", 0))
    return optax.apply_updates(params, updates), state, value, gradient_norm, searched


def least_squares(
    residuals: Callable[..., Any],
    params: Params,
    *,
    args: tuple[Any, ...] = (),
    steps: int = 50,
    method: str = "levenberg_marquardt",
    damping: float = 1e-3,
    tolerance: float = 1e-8,
    loss: str = "squared",
    scale: float = 1.0,
    chunk: int | None = None,
    record_params: bool = False,
    progress: bool = False,
    callback: Callback | None = None,
) -> FitResult:
    """Minimise half the sum of squares of residuals, or a robust form of it, over few parameters.

    Args:
        residuals: `residuals(params, *args)`, an array (or pytree of arrays) of any shape;
            differentiated in forward mode.
        params: where to start.
        args: further arguments, pytrees of arrays. New values do not recompile.
        steps: number of steps at most, rejected ones included.
        method: "levenberg_marquardt", or "gauss_newton": undamped steps, halved while they fail.
        damping: of the first Levenberg-Marquardt step, relative to the diagonal of JᵀWJ.
        tolerance: converged when the undamped step would lower the loss by less than this
            fraction, or is less than this fraction of the parameters (weighted by their
            influence). Not less than the rounding of the parameters' type.
        loss: of a residual r, in terms of u = r / scale: "squared" r²/2; "huber" the same up to
            |u| = 1, then linear; "cauchy" scale² log(1 + u²)/2; "geman_mcclure"
            scale² u²/(1 + u²)/2.
        scale: the size of residual from which on the robust losses discount.
        chunk: columns of the Jacobian evaluated at once: more is faster and needs more memory.
            By default as many as have 4 million entries together. Memory for parameters ×
            residuals is needed in any case.
        record_params: keep the parameters of every step in the history.
        progress: show a progress bar, by tqdm.
        callback: called as `callback(step, params, loss)`; the fit stops if it returns True.

    Returns:
        The best parameters met, with normal matrix and covariance. Steps that do not lower the
        loss, or after which it or the Jacobian is not finite, are rejected. Parameters without
        influence stay as they are.

    Raises:
        ValueError: for parameters that are not real and finite, or without any number, for
            residuals that are no array or of whole or complex numbers, and for residuals or a
            Jacobian that are not finite at the start.

    Example:
        >>> times, places = jnp.arange(4.0), jnp.array([1.0, 3, 5, 7])
        >>> found = dr.fit.least_squares(lambda p: p[0] + p[1] * times - places, jnp.zeros(2))
        >>> found.params.round(4).tolist()
        [1.0, 2.0]
    """
    _check_function("residuals", residuals)
    params = _float_tree(params)
    record_params, progress = _check_log(args, record_params, progress, callback)
    steps = positive_int("steps", steps)
    evaluate = functools.partial(
        _least_squares.evaluate,
        residuals,
        args=args,
        loss=one_of("loss", loss, tuple(_least_squares.ROBUST_LOSSES)),
        scale=float(real_number("scale", scale, above=0)),
        chunk=None if chunk is None else positive_int("chunk", chunk),
    )
    control = _least_squares.StepControl(
        one_of("method", method, ("levenberg_marquardt", "gauss_newton")),
        float(real_number("damping", damping, above=0)),
    )
    tolerance = float(real_number("tolerance", tolerance, above=0))

    count = sum(leaf.size for leaf in jax.tree.leaves(params))
    reason = f"all {steps} steps taken"
    with Log(steps, record_params, progress, callback) as log:
        point = evaluate(params, np.zeros(count))
        if not point.finite:
            raise _not_finite("residuals", point.loss, float(np.linalg.norm(point.gradient)))
        for step in range(steps + 1):
            gradient_norm = float(np.linalg.norm(point.gradient))
            stop = log.add(point.params, point.loss, gradient_norm, control.damping)
            verdict = point.verdict(tolerance)
            if stop:
                reason = "stopped by the callback"
            elif control.exhausted:
                reason = "no step in the direction of descent lowers the loss"
            if stop or verdict or control.exhausted or step == steps:
                break
            change = control.propose(point)
            point = control.judge(point, evaluate(point.params, change), change)
    return FitResult(
        params=point.params,
        loss=point.loss,
        history=log.history(),
        steps=step,
        renders=step + 1,
        derivatives=(step + 1) * count,
        converged=verdict is not None,
        reason=verdict or reason,
        seconds=log.seconds,
        normal_matrix=point.normal_matrix,
        covariance=point.covariance(),
    )


def _check_function(name: str, function: Any) -> None:
    try:
        hash(function)
    except TypeError:
        raise ValueError(f"{name}: wanted a hashable function, got {function!r}") from None
    if not callable(function):
        raise ValueError(f"{name}: wanted a function, got {function!r}")


def _check_log(args: Any, record_params: bool, progress: bool, callback: Any) -> tuple[bool, bool]:
    instance_of("args", args, tuple, list)
    array_tree("args", args)
    if callback is not None and not callable(callback):
        raise ValueError(f"callback: wanted a function or None, got {type(callback).__name__}")
    return flag("record_params", record_params), flag("progress", progress)


def _not_finite(name: str, value: float, gradient_norm: float) -> ValueError:
    return ValueError(
        f"{name}: wanted a finite loss and gradient at the start,"
        f" got loss {value} with gradient of norm {gradient_norm}"
    )


def _float_tree(params: Params) -> Params:
    def checked(path: Any, leaf: Any) -> Array:
        array = float_array(f"params{jax.tree_util.keystr(path)}", leaf)
        return jnp.asarray(array, array.dtype)  # not weakly typed: the next step will not be

    arrays = jax.tree_util.tree_map_with_path(checked, params)
    if not any(array.size for array in jax.tree.leaves(arrays)):
        raise ValueError(
            f"params: wanted a pytree with at least one array of numbers, got {params!r}"
        )
    return arrays


def direction_update(direction: ArrayLike, tangent: ArrayLike) -> Float[Array, "3"]:
    """Move a unit vector along the sphere: two parameters for a direction.

    The great circle from `direction` towards `tangent`, by as many radians as that is long
    (exponential map of the sphere). Fit `tangent`, starting from zero, for a light or a view
    direction; differentiable in both at any value.

    Args:
        direction: (3,) of any length but zero.
        tangent: (2,) in radians, along two fixed directions perpendicular to `direction` (Duff
            et al., "Building an orthonormal basis, revisited", 2017). They jump where
            `direction` passes through z = 0, so hold it fixed during a fit.

    Raises:
        ValueError: for a direction known to be zero.
    """
    direction = float_array("direction", direction, (3,))
    tangent = float_array("tangent", tangent, (2,))
    if is_concrete(direction) and not np.any(np.asarray(direction)):
        raise ValueError("direction: wanted a vector that is not zero, got (0, 0, 0)")
    unit = linalg.normalize(direction)
    x, y, z = unit
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(unit.dtype)
    a = -1 / (sign + z)
    first = jnp.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x])
    second = jnp.stack([x * y * a, sign + y * y * a, -y])
    axis_times_angle = jnp.cross(unit, tangent[0] * first + tangent[1] * second)
    return linalg.dot(linalg.so3_exp(axis_times_angle), unit)
