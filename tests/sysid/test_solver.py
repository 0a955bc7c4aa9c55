"""The solver against SciPy's: a curved valley, a bad start, a scale of its own, and noise levels that had vanished."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares as scipys
from scipy.optimize import lsq_linear, minimize

from cfb_mjx.sysid.identification.solver import (
    RIDGE,
    GaussNewton,
    Quadratic,
    descended,
    least_squares,
    likelihood,
    linearised,
)

TIME = np.linspace(0.0, 2.0, 200)
DATA = 3.0 * np.exp(-2.0 * TIME) + 0.5 + 0.01 * np.random.default_rng(0).normal(size=TIME.shape)


def decay(x):
    return [(x[0] * jnp.exp(-jnp.exp(x[1]) * TIME) + x[2] - DATA) / 0.01]


def valley(x):
    """Rosenbrock's."""
    return {"curve": 1e3 * (x[1:] - x[:1] ** 2), "slope": 1e2 * (1 - x[:1])}


@pytest.mark.parametrize(
    ("residual", "start"), [(decay, [1.0, 0.0, 0.0]), (decay, [-2.0, 2.5, 4.0]), (valley, [-1.2, 1.0])]
)
def test_it_finds_what_scipy_finds(residual, start):
    found = jax.jit(lambda x: least_squares(residual, x))(jnp.asarray(start, float))

    def whole(x):
        parts = jax.tree.leaves(residual(jnp.asarray(x)))
        return np.concatenate([*map(np.asarray, parts), RIDGE * x])

    theirs = scipys(whole, start, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    spread = np.sqrt(np.diag(np.linalg.inv(theirs.jac.T @ theirs.jac)))
    assert np.abs((np.asarray(found) - theirs.x) / spread).max() < 2e-3


@pytest.mark.parametrize("name", ["LevenbergMarquardt", "Dogleg"])
@pytest.mark.parametrize(("residual", "start"), [(decay, [1.0, 0.0, 0.0]), (valley, [-1.2, 1.0])])
def test_solvers_of_optimistix_take_its_place(name, residual, start):
    start = jnp.asarray(start, float)
    theirs = least_squares(residual, start, solver=getattr(optx, name)(rtol=1e-9, atol=1e-9))
    assert np.asarray(least_squares(residual, start)) == pytest.approx(np.asarray(theirs), abs=1e-4)


def test_another_solver_that_does_not_converge_says_so():
    never = optx.LevenbergMarquardt(rtol=0.0, atol=0.0)
    with pytest.raises(RuntimeError, match="maximum number of"):
        jax.block_until_ready(least_squares(decay, jnp.asarray([1.0, 0.0, 0.0]), solver=never))


def test_it_is_a_solver_for_anybody():
    """With optimistix's own arguments: auxiliary output, the number of steps, and a derivative through the solution."""

    def residual(x, truth):
        error = decay(x)[0] - decay(jnp.asarray([truth, 0.7, 0.5]))[0]
        return error, {"worst": jnp.max(jnp.abs(error))}

    def solved(truth):
        return optx.least_squares(residual, GaussNewton(), jnp.asarray([1.0, 0.0, 0.0]), truth, has_aux=True)

    solution = solved(3.0)
    assert solution.result == optx.RESULTS.successful
    assert np.asarray(solution.value) == pytest.approx([3.0, 0.7, 0.5], abs=1e-6)
    assert float(solution.aux["worst"]) < 1e-3
    assert 1 < int(solution.stats["num_steps"]) < 20
    assert np.asarray(jax.jacfwd(lambda t: solved(t).value)(3.0)) == pytest.approx([1.0, 0.0, 0.0], abs=1e-4)


def test_a_start_without_a_cost_is_left_alone():
    start = jnp.asarray([jnp.nan, 1.0])
    assert np.isnan(np.asarray(least_squares(valley, start))[0])
    assert np.asarray(least_squares(valley, start))[1] == 1.0


def test_a_direction_nobody_sees_stays_where_it_was():
    found = least_squares(lambda x: 100.0 * (x[:1] - 2.0), jnp.zeros(2))
    assert np.asarray(found) == pytest.approx([2.0, 0.0], abs=1e-4)


ERRORS = np.hypot(0.3, 2.0 * (0.1 + TIME)) * np.random.default_rng(1).normal(size=TIME.shape)


def noisy(x):
    """Errors about a mean, of a level that stays and one that grows with time."""
    return ERRORS - x[2], jnp.log(jnp.exp(2 * x[0]) + jnp.exp(2 * x[1]) * (0.1 + TIME) ** 2)


@pytest.mark.parametrize("start", [[0.0, 0.0, 0.0], [1.0, -6.0, 3.0], [-8.0, 2.0, 0.0]])
@pytest.mark.parametrize("robust", [False, True])
def test_it_finds_the_most_likely_noise(start, robust):
    def cost(x):
        error, variance = noisy(x)
        squared = (error * jnp.exp(-0.5 * variance)) ** 2
        if robust:  # one reading in a hundred is an outlier, of fifty times the noise
            squared = -2 * jnp.logaddexp(jnp.log(0.99) - 0.5 * squared, jnp.log(0.01 / 50) - 0.5 * squared / 2500)
        return jnp.sum(variance + squared) + jnp.sum((RIDGE * x) ** 2)

    theirs = minimize(jax.jit(cost), [np.log(0.3), np.log(2.0), 0.0], jac=jax.jit(jax.grad(cost)), tol=1e-10)
    found = np.asarray(descended(lambda x: [likelihood(noisy, x, robust)], jnp.asarray(start)))
    assert float(cost(found)) - theirs.fun < 1e-4
    assert found == pytest.approx(theirs.x, abs=2e-3)


def test_a_level_that_falls_to_its_bound_holds_up_no_other():
    """The readings have less noise than the bound of one level; the others were damped with it, for ever."""

    def quiet(x):
        bound, level = jnp.exp(x[0]) + 0.4, jnp.exp(x[1])
        return ERRORS, jnp.log(bound**2 + level**2 * (0.1 + TIME) ** 2)

    def cost(x):
        error, log_variance = quiet(x)
        return jnp.sum(log_variance + error**2 * jnp.exp(-log_variance)) + jnp.sum((RIDGE * x) ** 2)

    tried = []

    def about(x):
        tried.append(x)
        return [likelihood(quiet, x, False)]

    found = np.asarray(descended(about, jnp.array([3.0, 3.0]), levels=True))
    theirs = minimize(jax.jit(cost), found, jac=jax.jit(jax.grad(cost)), tol=1e-10)
    assert float(cost(found)) - theirs.fun < 1e-4
    assert found[0] < -2
    assert len(tried) < 25


@pytest.mark.parametrize("high", [0.5, 5.0])
@pytest.mark.parametrize("alike", [0.0, 0.99])
def test_within_bounds_it_finds_what_scipy_finds(high, alike):
    """With unknowns that do alike, what the others do depends on one that is stopped at its bound."""
    rng = np.random.default_rng(4)
    slopes, wanted = rng.normal(size=(30, 3)), np.array([2.0, -1.0, 0.3])
    slopes = alike * slopes[:, :1] + np.sqrt(1 - alike**2) * slopes
    values = slopes @ wanted + 0.1 * rng.normal(size=30)
    bounds = (jnp.array([-jnp.inf, -0.2, -jnp.inf]), jnp.array([high, jnp.inf, jnp.inf]))

    def about(x):
        return [linearised(lambda y: slopes @ y - values, x)]

    found = descended(about, jnp.array([9.0, 9.0, 9.0]), ridge=1e-6, bounds=bounds)
    np.testing.assert_allclose(found, lsq_linear(slopes, values, bounds).x, atol=1e-6)


@pytest.mark.parametrize("factor", [2.0, 3.9, 4.0, 10.0])
def test_a_cost_that_curves_more_than_is_thought_takes_few_steps(factor):
    """Steps of twice the length never end: real flights are not as noisy as their own noise model says."""
    tried, weight = [], jnp.array([100.0, 3.0])

    def about(x):
        tried.append(x)
        away = x - jnp.array([1.0, -2.0])
        return [Quadratic(away @ (weight * away), weight * away, jnp.diag(weight) / factor)]

    found = descended(about, jnp.zeros(2), ridge=0.0)
    np.testing.assert_allclose(found, [1.0, -2.0], atol=1e-3)
    assert len(tried) < 30
