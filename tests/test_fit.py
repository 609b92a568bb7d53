import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.test_util import check_grads

from diffrast import fit

TIMES = np.linspace(0, 4, 50)


def rosenbrock_residuals(params):
    return jnp.stack([10 * (params["y"] - params["x"] ** 2), 1 - params["x"]])


def rosenbrock(params):
    return 0.5 * jnp.sum(rosenbrock_residuals(params) ** 2)


def decay_residuals(params, times, data):
    amplitude, rate, offset = params
    return amplitude * jnp.exp(-rate * times) + offset - data


def line_residuals(params, x, data):
    return params[0] + params[1] * x - data


ROSENBROCK_START = {"x": -1.2, "y": 1.0}


# ------------------------------------------------------------------------- least squares


@pytest.mark.parametrize("method", ["levenberg_marquardt", "gauss_newton"])
def test_rosenbrock_least_squares(method):
    result = fit.least_squares(rosenbrock_residuals, ROSENBROCK_START, method=method)
    assert result.converged, result.reason
    np.testing.assert_allclose([result.params["x"], result.params["y"]], 1, atol=1e-5)
    assert np.all(np.diff(result.history.loss) <= 0)
    assert result.loss == result.history.loss[-1] == pytest.approx(0, abs=1e-10)
    assert len(result.history.loss) == result.steps + 1 == result.renders
    assert result.derivatives == 2 * result.renders
    assert result.steps < 40


def test_exponential_fit_agrees_with_scipy():
    optimize = pytest.importorskip("scipy.optimize")
    noise = np.random.default_rng(0).normal(0, 0.02, TIMES.size)
    data = 2.5 * np.exp(-1.3 * TIMES) + 0.5 + noise
    start = (1.0, 0.2, 0.0)
    with jax.enable_x64(True):
        result = fit.least_squares(decay_residuals, start, args=(TIMES, data), tolerance=1e-14)
    peer = optimize.least_squares(
        lambda p: p[0] * np.exp(-p[1] * TIMES) + p[2] - data, start, xtol=1e-12, ftol=1e-12
    )
    np.testing.assert_allclose(np.array(result.params), peer.x, rtol=1e-6)
    assert result.loss == pytest.approx(peer.cost, rel=1e-9)
    np.testing.assert_allclose(result.normal_matrix, peer.jac.T @ peer.jac, rtol=1e-5)
    covariance = 2 * peer.cost / (50 - 3) * np.linalg.inv(peer.jac.T @ peer.jac)
    np.testing.assert_allclose(result.covariance, covariance, rtol=1e-5)


@pytest.mark.parametrize("chunk", [None, 1, 2])
def test_linear_problem_takes_one_gauss_newton_step(chunk):
    rng = np.random.default_rng(1)
    matrix, data = rng.normal(size=(30, 5)), rng.normal(size=30)

    def residuals(params, matrix, data):
        return {"image": (matrix @ params - data).reshape(5, 6)}

    with jax.enable_x64(True):
        result = fit.least_squares(
            residuals, np.zeros(5), args=(matrix, data), method="gauss_newton", chunk=chunk
        )
    np.testing.assert_allclose(result.params, np.linalg.lstsq(matrix, data)[0], atol=1e-12)
    assert result.steps == 1
    assert result.converged


def test_no_recompilation_with_new_data():
    traces = []

    def residuals(params, x, data):
        traces.append(1)
        return line_residuals(params, x, data)

    x = np.linspace(0, 1, 9)
    fit.least_squares(residuals, [0.0, 1.0], args=(x, 3 - x), loss="huber", scale=0.1)
    first = len(traces)
    for start, scale in (([1.0, 2.0], 0.2), ((jnp.ones(()), np.float32(2)), 1.0)):
        for _ in range(2):
            result = fit.least_squares(
                residuals, list(start), args=(x, 5 + 2 * x), loss="huber", scale=scale
            )
    np.testing.assert_allclose(result.params, [5, 2], rtol=1e-5)
    assert len(traces) == first

    def loss(params, x, data):
        traces.append(1)
        return jnp.mean(line_residuals(params, x, data) ** 2)

    traces.clear()
    fit.minimize(loss, [0.0, 1.0], args=(x, 3 - x), steps=3)
    first = len(traces)
    fit.minimize(loss, [1.0, 1.0], args=(x, 2 * x), steps=3)
    assert len(traces) == first


def test_rank_deficient_jacobian():
    def residuals(params):
        # Only the sum of a and b matters, and c not at all.
        sums = params["a"] + params["b"] - jnp.array([3.0, 3.2])
        return jnp.append(sums, params["d"] - 1)

    start = {"a": 0.25, "b": 0.75, "c": 0.123, "d": 0.0}
    for method in ("levenberg_marquardt", "gauss_newton"):
        result = fit.least_squares(residuals, start, method=method)
        assert result.converged
        values = [float(result.params[k]) for k in "abcd"]
        np.testing.assert_allclose(values, [1.3, 1.8, 0.123, 1], rtol=1e-4)
        assert values[2] == np.float32(0.123)
        covariance = result.covariance
        np.testing.assert_array_equal(np.diag(covariance)[:3], np.inf)
        assert np.isfinite(covariance[3, 3])
        assert np.all(np.isnan(covariance[3, :3]))


@pytest.mark.parametrize("units", [(1e-18, 1e18), (1e25, 1e-25)])
def test_steps_do_not_depend_on_units(units):
    x = np.linspace(-1, 1, 40)

    def residuals(params, units):
        a, b = params[0] / units[0], params[1] / units[1]
        return jnp.exp(a) * x + b**2 - (2 * x + 4)

    plain = fit.least_squares(residuals, [0.0, 1.0], args=((1.0, 1.0),), steps=5)
    scaled = fit.least_squares(residuals, [0.0, units[1]], args=(units,), steps=5)
    np.testing.assert_allclose(scaled.history.loss, plain.history.loss, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(np.array(scaled.params) / units, plain.params, rtol=1e-5)


def test_step_into_nan_is_rejected():
    def residuals(x):
        return jnp.stack([jnp.sqrt(x) - 0.1, 0.1 * (x - 0.01)])  # NaN for x < 0

    with np.errstate(all="raise"):
        result = fit.least_squares(residuals, 4.0)
        halved = fit.least_squares(residuals, 4.0, method="gauss_newton")
    for outcome in (result, halved):
        assert outcome.converged
        assert outcome.params == pytest.approx(0.01, rel=1e-4)
        assert np.any(np.diff(outcome.history.loss) == 0)  # a rejected step
    assert np.all(np.isfinite(result.history.damping))
    assert np.all(np.isnan(halved.history.damping))


def test_overflow_is_rejected():
    result = fit.least_squares(lambda x: 1e-30 * x + 1e10, 0.0)  # solved by -1e40
    assert result.params < -1e37
    assert np.isfinite(result.loss)
    steep = fit.least_squares(lambda x: jnp.exp(x) - 1e3, 0.0)  # the first step overflows
    assert steep.params == pytest.approx(np.log(1e3), rel=1e-5)


def test_no_descent_is_told():
    @jax.custom_jvp
    def wrong(x):
        return x

    wrong.defjvp(lambda primals, tangents: (primals[0], -tangents[0]))
    result = fit.least_squares(lambda x: wrong(x) - 2.0, 1.0)
    assert not result.converged
    assert "no step" in result.reason
    assert result.params == 1


@pytest.mark.parametrize("loss", ["huber", "cauchy", "geman_mcclure"])
def test_robust_losses_discount_outliers(loss):
    x = np.linspace(0, 1, 40)
    data = 1 + 2 * x + 0.01 * np.sin(40 * x)
    data[::8] += 30.0
    plain = fit.least_squares(line_residuals, [1.0, 1.0], args=(x, data))
    robust = fit.least_squares(line_residuals, [1.0, 1.0], args=(x, data), loss=loss, scale=0.03)
    error = np.abs(np.array(robust.params) - [1, 2])
    assert np.all(error < 0.02)
    assert np.all(np.abs(np.array(plain.params) - [1, 2]) > 0.1)


@pytest.mark.parametrize("loss", ["squared", "huber", "cauchy", "geman_mcclure"])
def test_robust_loss_values_and_gradients(loss):
    residuals = np.array([-3.0, -0.4, 0.0, 0.2, 5.0])
    u = residuals / 0.5
    expected = {
        "squared": residuals**2 / 2,
        "huber": 0.25 * np.where(abs(u) <= 1, u**2 / 2, abs(u) - 0.5),
        "cauchy": 0.25 * np.log1p(u**2) / 2,
        "geman_mcclure": 0.25 * u**2 / (1 + u**2) / 2,
    }[loss]
    slope = {
        "squared": residuals,
        "huber": 0.5 * np.clip(u, -1, 1),
        "cauchy": residuals / (1 + u**2),
        "geman_mcclure": residuals / (1 + u**2) ** 2,
    }[loss]
    start = fit.least_squares(
        lambda p, r: p + r, np.zeros(5), args=(residuals,), loss=loss, scale=0.5, steps=1
    ).history
    assert start.loss[0] == pytest.approx(expected.sum(), rel=1e-5)
    assert start.gradient_norm[0] == pytest.approx(np.linalg.norm(slope), rel=1e-5)


def test_start_at_the_solution():
    result = fit.least_squares(rosenbrock_residuals, {"x": 1.0, "y": 1.0})
    assert (result.steps, result.converged, result.renders) == (0, True, 1)
    assert result.loss == 0


# ------------------------------------------------------------------------------ minimize


def test_minimize_with_adam_and_lbfgs():
    def loss(params, target):
        return jnp.sum((params["a"] - target) ** 2) + (params["b"] + 1) ** 2

    start = {"a": jnp.zeros(3), "b": -0.5}
    target = np.array([0.1, -0.2, 0.3], np.float32)
    result = fit.minimize(loss, start, args=(target,), steps=500)
    np.testing.assert_allclose(result.params["a"], target, atol=1e-3)
    np.testing.assert_allclose(result.params["b"], -1, atol=1e-3)
    assert (result.steps, result.renders, result.derivatives) == (500, 501, 501)
    assert not result.converged
    assert result.loss == result.history.loss.min()

    newton = fit.minimize(rosenbrock, ROSENBROCK_START, optimizer=optax.lbfgs(), steps=60)
    np.testing.assert_allclose(newton.params["x"], 1, atol=1e-3)


def test_a_line_search_is_compiled_once():
    traced, after_steps = [], []

    def loss(params):
        traced.append(params)
        return jnp.sum((params - 1) ** 4)

    def count(*_):
        after_steps.append(len(traced))
        return False

    fit.minimize(loss, jnp.zeros(3), optimizer=optax.lbfgs(), steps=3, callback=count)
    assert len(after_steps) == 4
    assert after_steps[0] == after_steps[-1]


def test_minimize_stops():
    quadratic = functools.partial(lambda centre, x: (x - centre) ** 2 + 1.0, 0.3)
    sgd = optax.sgd(0.4)
    result = fit.minimize(quadratic, 1.0, optimizer=sgd, tolerance=1e-6, patience=5)
    assert result.converged
    assert result.steps < 30
    assert result.params == pytest.approx(0.3, abs=1e-3)
    exact = fit.minimize(quadratic, 1.0, optimizer=optax.sgd(0.5))
    assert exact.converged
    assert "gradient is zero" in exact.reason

    diverging = fit.minimize(quadratic, 1.0, optimizer=optax.sgd(1e15), steps=10)
    assert not diverging.converged
    assert "inf" in diverging.reason
    assert diverging.params == 1.0  # the best met
    assert diverging.loss == pytest.approx(1.49)
    assert diverging.renders == diverging.steps + 1


# -------------------------------------------------------------------------------- common


def test_callback_history_and_progress(capsys):
    calls = []

    def callback(step, params, loss):
        calls.append((step, loss))
        return step == 3

    for run in (
        functools.partial(fit.least_squares, rosenbrock_residuals),
        functools.partial(fit.minimize, rosenbrock),
    ):
        calls.clear()
        result = run(ROSENBROCK_START, callback=callback, record_params=True)
        assert result.reason == "stopped by the callback"
        assert [step for step, _ in calls] == [0, 1, 2, 3]
        np.testing.assert_array_equal([loss for _, loss in calls], result.history.loss)
        assert len(result.history.params) == 4
        assert result.history.params[0]["x"] == np.float32(-1.2)
        last = jax.jit(rosenbrock)(result.history.params[-1])
        np.testing.assert_allclose(last, result.history.loss[-1], rtol=1e-5)
    assert not capsys.readouterr().err
    pytest.importorskip("tqdm")
    fit.minimize(rosenbrock, ROSENBROCK_START, steps=3, progress=True)
    assert "3/3" in capsys.readouterr().err


def test_pytrees_keep_their_structure_and_type():
    @functools.partial(jax.tree_util.register_dataclass)
    @dataclasses.dataclass(frozen=True)
    class Model:
        slope: jax.Array
        offset: jax.Array

    start = Model(slope=np.float32([1, 2]), offset=3)
    result = fit.least_squares(lambda m, x: m.slope * x + m.offset, start, args=(np.ones(2),))
    assert isinstance(result.params, Model)
    assert result.params.slope.dtype == result.params.offset.dtype == jnp.float32
    with jax.enable_x64(True):
        double = fit.least_squares(lambda m: m.slope * m.offset, dataclasses.replace(start))
        assert double.params.slope.dtype == jnp.float32
        assert double.params.offset.dtype == jnp.float64


@pytest.mark.parametrize("run", [fit.minimize, fit.least_squares])
def test_bad_input(run):
    identity = jnp.asarray
    for bad, message in (
        ({"a": np.nan}, r"params\['a'\]: wanted finite numbers"),
        ({"a": True}, r"params\['a'\]: wanted real numbers"),
        ({}, "params: wanted a pytree with at least one array"),
        ({"a": np.zeros((0, 3))}, "params: wanted a pytree with at least one array of numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            run(identity, bad)
    with pytest.raises(ValueError, match="finite loss and gradient at the start"):
        run(lambda x: jnp.log(x), -1.0)
    with pytest.raises(ValueError, match="steps: wanted an integer"):
        run(identity, 1.0, steps=0)
    with pytest.raises(ValueError, match="tolerance: wanted a number"):
        run(identity, 1.0, tolerance=-1.0)


def test_more_bad_input():
    with pytest.raises(ValueError, match="loss: wanted a function to a scalar, got shape"):
        fit.minimize(lambda x: jnp.stack([x, x]), 1.0)
    with pytest.raises(ValueError, match="residuals: wanted floating-point numbers, got dtype int"):
        fit.least_squares(lambda p: jnp.round(p).astype(int), jnp.ones(2))
    with pytest.raises(ValueError, match="loss: wanted a function to a scalar, got one that ret"):
        fit.minimize(lambda x: None, 1.0)
    with pytest.raises(ValueError, match="residuals: wanted a function to arrays, got None from"):
        fit.least_squares(lambda p: None, jnp.ones(2))
    with pytest.raises(ValueError, match="method: wanted one of"):
        fit.least_squares(jnp.asarray, 1.0, method="newton")
    with pytest.raises(ValueError, match="loss: wanted one of squared, huber"):
        fit.least_squares(jnp.asarray, 1.0, loss="l1")
    with pytest.raises(ValueError, match="scale: wanted a number"):
        fit.least_squares(jnp.asarray, 1.0, scale=0.0)


# ------------------------------------------------------------------------- images, charts


def test_gaussian_blur():
    image = np.zeros((31, 41, 2), np.float32)
    image[15, 20] = (1, 2)
    blurred = np.array(fit.gaussian_blur(image, 2.0))
    y, x = np.mgrid[:31, :41]
    expected = np.exp(-((x - 20) ** 2 + (y - 15) ** 2) / 8) / (8 * np.pi)
    np.testing.assert_allclose(blurred, expected[..., None] * [1, 2], atol=1e-5)
    np.testing.assert_allclose(fit.gaussian_blur(np.ones((5, 7)), 3.0), 1, rtol=1e-6)
    np.testing.assert_array_equal(fit.gaussian_blur(image, 0.0), image)
    grey = fit.gaussian_blur(image[..., 1], 2.0)
    np.testing.assert_allclose(grey, blurred[..., 1], atol=1e-7)


def test_known_numbers_stay_known_inside_of_a_fit():
    image = np.ones((9, 9, 3))
    blur = fit.gaussian_blur  # with a radius that follows from sigma
    result = fit.least_squares(lambda p: blur(p[0] * image - 0.5, 2.0), jnp.zeros(1))
    np.testing.assert_allclose(result.params, 0.5, rtol=1e-6)


def test_gaussian_blur_is_differentiable():
    with jax.enable_x64(True):
        image = np.random.default_rng(0).normal(size=(6, 5))
        blur = functools.partial(fit.gaussian_blur, radius=4)
        check_grads(jax.jit(blur), (image, 1.3), order=1)
    slope = jax.jit(jax.grad(lambda s: jnp.sum(fit.gaussian_blur(np.eye(4), s, radius=2) ** 2)))
    assert np.isfinite(slope(0.0))


def test_downsample():
    image = np.arange(48.0).reshape(4, 6, 2)
    halved = fit.downsample(image, 2)
    np.testing.assert_allclose(halved[1, 2], image[2:, 4:].mean(axis=(0, 1)))
    assert halved.shape == (2, 3, 2)
    with pytest.raises(ValueError, match="factor: wanted a divisor of height 4 and width 6, got 4"):
        fit.downsample(image, 4)
    with pytest.raises(ValueError, match="image: wanted at least one pixel"):
        fit.gaussian_blur(np.zeros((0, 5)), 1.0)
    with pytest.raises(ValueError, match="image: wanted shape"):
        fit.downsample(image[0, 0], 1)
    with pytest.raises(ValueError, match="radius: wanted an integer"):
        jax.jit(lambda s: fit.gaussian_blur(image, s))(1.0)


def test_direction_update_is_the_exponential_map():
    rng = np.random.default_rng(2)
    directions = np.concatenate([rng.normal(size=(20, 3)), [[0, 0, 1], [0, 0, -1], [1e-30, 0, 0]]])
    tangents = np.concatenate([rng.normal(size=(20, 2)), [[0, 0], [3, 0], [0, 1e-4]]])
    with jax.enable_x64(True):
        update = jax.jit(jax.vmap(fit.direction_update))
        moved = np.array(update(directions, tangents))
        unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        np.testing.assert_allclose(np.linalg.norm(moved, axis=-1), 1)
        angle = np.linalg.norm(tangents, axis=-1)
        np.testing.assert_allclose(np.sum(moved * unit, axis=-1), np.cos(angle), atol=1e-14)
        # At the origin an isometry, curved towards the centre of the sphere.
        first = jax.jacfwd(fit.direction_update, argnums=1)
        second = jax.jacfwd(first, argnums=1)
        jacobian, curvature = jax.jit(jax.vmap(lambda *x: (first(*x), second(*x))))(
            directions, 0 * tangents
        )
        identity = np.tile(np.eye(2), (len(unit), 1, 1))
        metric = np.einsum("nij,nik->njk", jacobian, jacobian)
        np.testing.assert_allclose(metric, identity, atol=1e-14)
        np.testing.assert_allclose(np.einsum("nij,ni->nj", jacobian, unit), 0, atol=1e-14)
        expected = -unit[:, :, None, None] * identity[:, None]
        np.testing.assert_allclose(curvature, expected, atol=1e-12)
        check_grads(jax.jit(fit.direction_update), (directions[1], tangents[1]), order=1)
    with pytest.raises(ValueError, match="direction: wanted a vector that is not zero"):
        fit.direction_update(np.zeros(3), np.zeros(2))


def test_light_direction_is_recovered():
    normals = np.random.default_rng(3).normal(size=(200, 3))
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    truth = np.array([0.6, -0.64, -0.48], np.float32)

    def shade(params):
        direction = fit.direction_update(np.array([-0.5, -0.5, 0.7]), params["tangent"])
        return params["diffuse"] * jnp.maximum(-normals @ direction, 0)

    data = 0.8 * np.maximum(-normals @ truth, 0)
    start = {"tangent": np.zeros(2), "diffuse": 0.3}
    result = fit.least_squares(lambda params, data: shade(params) - data, start, args=(data,))
    found = fit.direction_update(np.array([-0.5, -0.5, 0.7]), result.params["tangent"])
    assert np.linalg.norm(found - truth) < 1e-5
    assert result.params["diffuse"] == pytest.approx(0.8, rel=1e-5)
    assert result.steps < 20
