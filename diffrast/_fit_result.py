"""What `diffrast.fit` returns, and how it is gathered during a fit."""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

Params = Any
Callback = Callable[[int, Params, float], Any]


@dataclasses.dataclass(frozen=True)
class History:
    """What a fit went through: entry 0 is the start, entry k the state after step k.

    Attributes:
        loss: the losses. Those of `least_squares` never rise, as a step that fails is not taken.
        gradient_norm: Euclidean norm of the gradient, in the units of the parameters.
        damping: of the Levenberg-Marquardt step to come; NaN for other methods.
        params: the parameters themselves if `record_params` was set, else empty.
    """

    loss: np.ndarray
    gradient_norm: np.ndarray
    damping: np.ndarray
    params: tuple[Params, ...]


@dataclasses.dataclass(frozen=True)
class FitResult:
    """The outcome of a fit.

    Attributes:
        params: the parameters of the lowest loss met.
        loss: that loss. For `least_squares` it is half the sum of the (robust) squares.
        history: losses and more, step by step.
        steps: number of steps tried.
        renders: number of evaluations of the function, with those of optax's line searches.
        derivatives: number of derivative passes besides: reverse passes of `minimize`, forward
            passes (one for each parameter and render) of `least_squares`.
        converged: whether the fit ended because there was nothing left to gain.
        reason: why it ended, in words.
        seconds: wall-clock time, compilation included.
        normal_matrix: JᵀWJ at `params`, from `least_squares`. Rows are the parameters in the order
            of `jax.flatten_util.ravel_pytree`.
        covariance: of the parameters, from `least_squares`, if the errors of the residuals are
            independent with equal variance, estimated as 2 loss / (residuals - parameters).
            Infinite variance, and NaN beside it, for what the data do not determine.
    """

    params: Params
    loss: float
    history: History
    steps: int
    renders: int
    derivatives: int
    converged: bool
    reason: str
    seconds: float
    normal_matrix: np.ndarray | None = None
    covariance: np.ndarray | None = None


class Log:
    """Keeps the history, shows the progress and asks the callback."""

    def __init__(self, steps: int, record_params: bool, progress: bool, callback: Callback | None):
        self.losses: list[float] = []
        self._gradient_norms: list[float] = []
        self._dampings: list[float] = []
        self._params: list[Params] = []
        self._record_params = record_params
        self._callback = callback
        self._bar = _progress_bar(steps) if progress else None
        self._started = time.perf_counter()

    def __enter__(self) -> "Log":
        return self

    def __exit__(self, *exception: object) -> None:
        self.seconds = time.perf_counter() - self._started
        if self._bar is not None:
            self._bar.close()

    def add(
        self, params: Params, loss: float, gradient_norm: float, damping: float = math.nan
    ) -> bool:
        """Note the start or the outcome of a step; return whether the callback wants to stop."""
        step = len(self.losses)
        self.losses.append(loss)
        self._gradient_norms.append(gradient_norm)
        self._dampings.append(damping)
        if self._record_params:
            self._params.append(params)
        if self._bar is not None:
            self._bar.set_postfix(loss=f"{loss:.4g}", refresh=False)
            self._bar.update(min(step, 1))
        return self._callback is not None and bool(self._callback(step, params, loss))

    def history(self) -> History:
        """Return all that was noted."""
        return History(
            loss=np.array(self.losses),
            gradient_norm=np.array(self._gradient_norms),
            damping=np.array(self._dampings),
            params=tuple(self._params),
        )


def _progress_bar(steps: int) -> Any:
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        raise ImportError("progress=True needs tqdm: install diffrast[progress]") from error
    return tqdm(total=steps)
