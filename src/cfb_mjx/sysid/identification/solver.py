"""Gauss-Newton and Fisher's scoring, damped only where a step fails or lowers the cost far less than expected.

`GaussNewton` is an optimistix solver: `least_squares` takes any other in its place, and
``optx.least_squares(residual, GaussNewton(), start)`` works on anybody's residual. Residuals come by the hundred
thousand and unknowns by the ten, so that one linearisation costs as much as all else together. optimistix's
Levenberg-Marquardt starts damped, stops on the size of a step and factorises by QR (docs/fit-speed.md measures both).

Outliers, such as bad radio packets, are treated by Huber's loss or by a mixture density.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

OUTLIER = 3.0
"""Threshold, in standard deviations, beyond which an error counts linearly instead of squared (Huber 1964), and to
which the correction of a filter is limited."""


def limited(error: Array, variance: Array, robust: bool) -> Array:
    """The innovation by which a filter is corrected; with ``robust``, limited to `OUTLIER` standard deviations."""
    if not robust:
        return error
    bound = OUTLIER * jnp.sqrt(variance)
    return jnp.clip(error, -bound, bound)


def tempered(whitened: Array, robust: bool) -> Array:
    """Residuals in standard deviations; with ``robust``, transformed so that half their square is Huber's loss."""
    if not robust:
        return whitened
    size = jnp.abs(whitened)
    # The inner maximum keeps the gradient of the unused branch finite.
    outside = jnp.sqrt(2 * OUTLIER * jnp.maximum(size, OUTLIER) - OUTLIER**2)
    return jnp.where(size <= OUTLIER, whitened, jnp.sign(whitened) * outside)


SHARE, SPREAD = 0.01, 50.0
"""Assumed share of outliers when noise levels are fitted, and their noise as a multiple of that of the others."""


def surprise(whitened: Array, robust: bool) -> Array:
    """Minus twice the log-density of residuals in standard deviations, up to a constant.

    With ``robust``, the density is a mixture of good readings and outliers, because a scale estimated with Huber's loss
    would still grow with the size of the outliers.
    """
    if not robust:
        return whitened**2
    good = jnp.log(1 - SHARE) - 0.5 * whitened**2
    bad = jnp.log(SHARE / SPREAD) - 0.5 * (whitened / SPREAD) ** 2
    return -2 * jnp.logaddexp(good, bad)


RIDGE = 0.1
"""Every unknown has a prior of 1 / RIDGE = 10 units about the preset (a factor of e^10): far too wide to matter where
data say anything, and enough to keep the normal equations regular where they say nothing."""
SOLVED = 1e-6
"""Squared length of the last step in standard deviations of the estimate: a thousandth of one."""
FIRST_DAMPING = 1e-3
MAX_STEPS = 60
POOR = 0.25
"""A step that lowers the cost by less than this share of what was expected was much too long."""
EDGE = 1e-9
"""An unknown that is nearer to a bound than this is at the bound."""
UNBOUNDED = (-jnp.inf, jnp.inf)


class Quadratic(NamedTuple):
    """A cost about a point: its value, half its gradient, and half its (expected) Hessian."""

    cost: Float[Array, ""]
    slope: Float[Array, " k"]
    curvature: Float[Array, "k k"]


Bounds = tuple[Float[Array, " k"] | float, Float[Array, " k"] | float]
"""Smallest and largest value of the unknowns."""


def bounded_one(count: int, which: int, low: float, high: float) -> Bounds:
    """Bounds of ``count`` unknowns, of which only one has any."""
    bottom, top = (jnp.full(count, free, jnp.result_type(float)) for free in UNBOUNDED)
    return bottom.at[which].set(low), top.at[which].set(high)


class Descent(NamedTuple):
    """The state of a damped descent beside the point that it has reached."""

    here: Quadratic
    damping: Float[Array, ""]
    step: Float[Array, " k"]
    """To be tried next."""
    gain: Float[Array, ""]
    """What the step lowers the quadratic by: its squared length in standard deviations of the estimate, if neither
    damped nor bounded."""

    @classmethod
    def first(cls, start: Float[Array, " k"]) -> Descent:
        """Nothing is known at first and the first step leads nowhere, so that the linearisation is compiled once."""
        zero = jnp.zeros_like(start)
        unknown = jnp.full_like(zero[0], jnp.inf)
        nothing = Quadratic(unknown, zero, jnp.eye(len(start), dtype=start.dtype))
        return cls(nothing, jnp.zeros_like(unknown), zero, unknown)

    def advanced(
        self, there: Quadratic, x: Float[Array, " k"], bounds: Bounds = UNBOUNDED
    ) -> tuple[Float[Array, " k"], Descent]:
        """Take the step from ``x`` to ``there``: if that raises the cost (or makes it NaN) stay, and damp the next.

        An unknown stays at a bound that it would pass.
        """
        low, high = bounds
        better = there.cost <= self.here.cost
        x = jnp.where(better, x + self.step, x)
        expected = self.step @ self.here.curvature @ self.step
        linear = 2 * self.here.slope @ self.step
        gained = (self.here.cost - there.cost) / -(linear + expected)
        # The cost curves so much more along the step than was expected; a step shorter by this factor would be right.
        curved = (there.cost - self.here.cost - linear) / expected
        short = jnp.where(jnp.isfinite(curved), curved - 1, 0.0)
        here = jax.tree.map(lambda new, old: jnp.where(better, new, old), there, self.here)
        damping = jnp.where(better, 0.1 * self.damping, jnp.maximum(10 * self.damping, FIRST_DAMPING))
        # From none to 1 at most, which halves the step: the curvature farther away says little about that nearby.
        most = jnp.maximum(10 * self.damping, 1.0)
        damping = jnp.where(gained < POOR, jnp.maximum(damping, jnp.minimum(short, most)), damping)
        damping = jnp.where(damping < FIRST_DAMPING, 0.0, damping)
        raised = here.curvature + damping * jnp.diag(jnp.diag(here.curvature))
        step = _bounded(raised, here.slope, low - x, high - x)
        return x, Descent(here, damping, step, -step @ (2 * here.slope + here.curvature @ step))

    def going_on(self, accuracy: float = SOLVED) -> Bool[Array, ""]:
        """Whether the step is worth trying; False where its gain is NaN."""
        return self.gain > accuracy

    def ended(self, x: Float[Array, " k"], accuracy: float = SOLVED) -> Float[Array, " k"]:
        """The last step is too short to be worth another linearisation, and is taken on trust."""
        return jnp.where((self.gain >= 0) & (self.gain <= accuracy), x + self.step, x)


def _bounded(
    curvature: Float[Array, "k k"], slope: Float[Array, " k"], low: Float[Array, " k"], high: Float[Array, " k"]
) -> Float[Array, " k"]:
    """The step to the minimum of a quadratic; what would leave its bounds stays at them, and the others follow.

    Exact if one unknown would leave; of several, the one that leaves first is stopped first.
    """

    def others(step, stopped):
        # Those that are stopped have their steps; the equations of the others hold, given these.
        held = jnp.where(stopped, jnp.clip(step, low, high), 0.0)
        matrix = jnp.where(stopped[:, None] | stopped, jnp.eye(len(slope), dtype=slope.dtype), curvature)
        return jnp.where(stopped, held, -jnp.linalg.solve(matrix, jnp.where(stopped, 0.0, slope + curvature @ held)))

    stopped = ((low > -EDGE) & (slope > 0)) | ((high < EDGE) & (slope < 0))
    step = others(jnp.zeros_like(slope), stopped)
    for _ in range(2):
        leaves = ~stopped & ((step < low) | (step > high))
        part = jnp.where(leaves, jnp.where(step < low, low, high) / jnp.where(leaves, step, 1.0), jnp.inf)
        stopped = stopped | (leaves & (part == jnp.min(part)))
        step = others(step, stopped)
    return jnp.clip(step, low, high)


class _State(eqx.Module):
    descent: Descent
    aux: Any
    """In the shape that optimistix asks for; what it holds at the end is computed there."""


class GaussNewton(optx.AbstractLeastSquaresSolver):
    """Full Gauss-Newton steps on the normal equations, damped as in Marquardt (1963) where one is too long.

    A solver for `optimistix.least_squares` whose unknowns are one vector. Jacobians are forward-mode. It ends where the
    next step is shorter than a thousandth of the estimate's standard deviation, if residuals are divided by their
    noise: ``rtol`` and ``atol`` are not read. Normal equations, not QR: they are what costs. The uncertainty, which
    their condition numbers would spoil, is computed elsewhere by QR (`uncertainty`).
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Array] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first step; the arguments are optimistix's."""
        return _State(Descent.first(y), jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), aux_struct))

    def step(self, fn, y, args, options, state, tags) -> tuple[Array, _State, Any]:
        """Linearise at the proposed point, accept it or not, propose another."""
        there = linearised(lambda x: fn(x, args)[0], y + state.descent.step)
        y, descent = state.descent.advanced(there, y)
        return y, _State(descent, state.aux), state.aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Whether the next step is too short to matter."""
        return ~state.descent.going_on(), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result) -> tuple[Array, Any, dict[str, Any]]:
        """Take the last step."""
        y = state.descent.ended(y)
        return y, fn(y, args)[1], {}


def least_squares(
    residual: Callable[[Array], PyTree],
    start: Float[Array, " k"],
    ridge: Float[Array, " k"] | float = RIDGE,
    solver: optx.AbstractLeastSquaresSolver | None = None,
) -> Float[Array, " k"]:
    """The minimum of the sum of squares, from ``start``.

    Args:
        residual: of the unknowns; a pytree of arrays, each divided by its noise.
        start: where to begin.
        ridge: one over the standard deviation of each unknown's prior about zero; a large one holds it.
        solver: of optimistix, such as ``optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)``; it raises an error if it
            does not converge within optimistix's 256 steps. None takes `GaussNewton`.
    """

    def with_prior(x, _):
        return residual(x), ridge * x

    if solver is None:
        return optx.least_squares(with_prior, GaussNewton(), start, max_steps=MAX_STEPS, throw=False).value
    # `MAX_STEPS` is for our steps; a solver of the user's that does not converge must not pass for one that does.
    return optx.least_squares(with_prior, solver, start).value


def linearised(residual: Callable[[Array], PyTree], x: Float[Array, " k"]) -> Quadratic:
    """The sum of squares of a residual about ``x``, to be used within a compiled function."""
    values, slopes = _slopes(residual, x)
    cost, slope, curvature = jnp.zeros_like(x[0]), jnp.zeros_like(x), jnp.zeros((len(x), len(x)), x.dtype)
    for value, part in zip(jax.tree.leaves(values), jax.tree.leaves(slopes), strict=True):
        value, part = value.ravel(), part.reshape(len(x), -1)
        cost, slope, curvature = cost + value @ value, slope + part @ value, curvature + part @ part.T
    return Quadratic(cost, slope, curvature)


def likelihood(
    predicted: Callable[[Array], tuple[Array, Array]],
    x: Float[Array, " k"],
    robust: bool,
) -> Quadratic:
    """Minus the logarithm of a Gaussian likelihood whose variances move too, about ``x``: Fisher's scoring.

    ``predicted`` gives errors and the logarithms of their variances. A level that hardly counts has next to no slope;
    the expected curvature, which vanishes faster, still leads back from there, where a line search would stay. (BFGS,
    which knows nothing of how errors and variances make the likelihood, took 150 to 270 steps.)
    """

    def surprising(whitened):
        return jnp.sum(surprise(whitened, robust))

    (error, log_variance), (moved, spread) = _slopes(predicted, x)
    weight = jnp.exp(-0.5 * log_variance)
    whitened = (error * weight).ravel()
    moved, spread = (moved * weight).reshape(len(x), -1), spread.reshape(len(x), -1)
    surprised, pull = jax.value_and_grad(surprising)(whitened)
    return Quadratic(
        jnp.sum(log_variance) + surprised,
        0.5 * (jnp.sum(spread, axis=1) + (moved - 0.5 * whitened * spread) @ pull),
        moved @ moved.T + 0.5 * spread @ spread.T,
    )


def descended(
    about: Callable[[Array], Iterable[Quadratic]],
    start: Float[Array, " k"],
    ridge: Float[Array, " k"] | float = RIDGE,
    levels: Bool[Array, " k"] | bool = False,
    bounds: Bounds = UNBOUNDED,
    accuracy: float = SOLVED,
) -> Float[Array, " k"]:
    """The minimum of a sum of costs, from ``start``.

    The parts are compiled and the loop is not, so that neither memory nor the number of programs grows with the data.

    Args:
        about: linearises the cost of every part of the data.
        start: where to begin.
        ridge: as for `least_squares`.
        levels: which unknowns are logarithms of what may fall towards nothing (or, of noise, towards a lower bound).
        bounds: of the unknowns.
        accuracy: end where the squared length of the next step, in standard deviations of the estimate, is below.
    """
    x = jnp.clip(start, *bounds)
    descent = Descent.first(x)
    for _ in range(MAX_STEPS):
        if not descent.going_on(accuracy):
            break
        parts = jax.tree.map(lambda *terms: jnp.asarray(sum(map(np.asarray, terms))), *about(x + descent.step))
        x, descent = _tried(descent, _of_levels(parts, levels), x, ridge, bounds)
    return descent.ended(x, accuracy)


def _of_levels(about: Quadratic, levels: Bool[Array, " k"] | bool) -> Quadratic:
    """Slopes by logarithms are curvatures, too: nearly all of it where a level or a factor falls towards nothing.

    Without them the steps of such an unknown are many times too long, and the steps of all are damped.
    """
    return about._replace(curvature=about.curvature + jnp.diag(jnp.where(levels, jnp.maximum(about.slope, 0.0), 0.0)))


@eqx.filter_jit
def _tried(descent: Descent, data: Quadratic, x, ridge, bounds: Bounds):
    prior = jnp.broadcast_to(jnp.asarray(ridge) ** 2, x.shape)
    there = x + descent.step
    own = Quadratic(there @ (prior * there), prior * there, jnp.diag(prior))
    return descent.advanced(jax.tree.map(jnp.add, data, own), x, bounds)


def _slopes(function, x):
    """Values at ``x`` and, in front, the derivatives by each unknown."""

    def both(direction):
        return jax.jvp(function, (x,), (direction,))

    return jax.vmap(both, out_axes=(None, 0))(jnp.eye(len(x), dtype=x.dtype))
