"""The fits' one solver: Gauss-Newton and Fisher's scoring, damped only where a step fails.

Residuals come by the hundred thousand and unknowns by the ten, so that one linearisation costs as much as all else
together: a library's Levenberg-Marquardt, which starts damped and stops on the size of a step, spends twice as many.
Its BFGS, which knows nothing of how errors and variances make the likelihood, took 150 to 270 steps to noise levels.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from cfb_mjx.sysid.identification.robust import surprise

RIDGE = 0.1
"""Every unknown has a prior of 1 / RIDGE = 10 units about the preset (a factor of e^10): far too wide to matter where
data say anything, and enough to keep the normal equations regular where they say nothing."""
SETTLED = 1e-6
"""Squared length of the last step in standard deviations of the estimate: a thousandth of one."""
FIRST_DAMPING = 1e-3
MAX_STEPS = 60


def least_squares(
    residual: Callable[[Array], PyTree], start: Float[Array, " k"], ridge: Float[Array, " k"] | float = RIDGE
) -> Float[Array, " k"]:
    """The minimum of the sum of squares, from ``start``; forward-mode Jacobian.

    ``ridge`` is one over the standard deviation of each unknown's prior about zero; a large one holds it.

    A full Gauss-Newton step is tried first; where it raises the cost (or makes it NaN) the diagonal is raised as in
    Marquardt (1963) until a step lowers it. Normal equations, not QR: they are what costs, and the uncertainty, which
    condition numbers would spoil, is computed elsewhere by QR (`uncertainty`).
    """

    def linearised(x):
        values, slopes = _slopes(residual, x)
        cost, slope, curvature = _prior(ridge, x)
        for value, part in zip(jax.tree.leaves(values), jax.tree.leaves(slopes), strict=True):
            value, part = value.ravel(), part.reshape(len(x), -1)
            cost, slope, curvature = cost + value @ value, slope + part @ value, curvature + part @ part.T
        return cost, slope, curvature

    return _descended(linearised, start)


def most_likely(
    predicted: Callable[[Array], tuple[Array, Array]], start: Float[Array, " k"], robust: bool, ridge: float = RIDGE
) -> Float[Array, " k"]:
    """The maximum of a Gaussian likelihood whose variances move too, from ``start``: Fisher's scoring.

    ``predicted`` gives errors and the logarithms of their variances. A level that hardly counts has next to no slope;
    the expected curvature, which vanishes faster, still leads back from there, where a line search would stay.
    """

    def surprising(whitened):
        return jnp.sum(surprise(whitened, robust))

    def linearised(x):
        (error, log_variance), (moved, spread) = _slopes(predicted, x)
        weight = jnp.exp(-0.5 * log_variance)
        whitened = (error * weight).ravel()
        moved, spread = (moved * weight).reshape(len(x), -1), spread.reshape(len(x), -1)
        surprised, pull = jax.value_and_grad(surprising)(whitened)
        cost, slope, curvature = _prior(ridge, x)
        return (
            cost + jnp.sum(log_variance) + surprised,
            slope + 0.5 * (jnp.sum(spread, axis=1) + (moved - 0.5 * whitened * spread) @ pull),
            curvature + moved @ moved.T + 0.5 * spread @ spread.T,
        )

    return _descended(linearised, start)


def _slopes(function, x):
    """Values at ``x`` and, in front, the derivatives by each unknown."""

    def both(direction):
        return jax.jvp(function, (x,), (direction,))

    return jax.vmap(both, out_axes=(None, 0))(jnp.eye(len(x), dtype=x.dtype))


def _prior(ridge, x):
    prior = jnp.broadcast_to(jnp.asarray(ridge) ** 2, x.shape)
    return x @ (prior * x), prior * x, jnp.diag(prior)


def _descended(linearised: Callable, start: Float[Array, " k"]) -> Float[Array, " k"]:
    """Where ``linearised`` (cost, half its slope, half its curvature) is least, from ``start``."""

    def proposed(slope, curvature, damping):
        raised = curvature + damping * jnp.diag(jnp.diag(curvature))
        step = -jnp.linalg.solve(raised, slope)
        return step, -slope @ step

    def unsettled(carry):
        _, _, _, (_, gain), done = carry
        # Not `gain > SETTLED`: a NaN gain must not pass for a step worth trying.
        return (done < MAX_STEPS) & (gain > SETTLED)

    def advance(carry):
        x, here, damping, (step, _), done = carry
        there = linearised(x + step)
        better = there[0] <= here[0]
        here = jax.tree.map(lambda new, old: jnp.where(better, new, old), there, here)
        eased = jnp.where(damping > FIRST_DAMPING, 0.1 * damping, 0.0)
        damping = jnp.where(better, eased, jnp.maximum(10 * damping, FIRST_DAMPING))
        return jnp.where(better, x + step, x), here, damping, proposed(here[1], here[2], damping), done + 1

    # Nothing is known at first and the first step leads nowhere, so that the linearisation is compiled once only.
    zero = jnp.zeros_like(start)
    unknown = jnp.full_like(zero[0], jnp.inf)
    nothing = unknown, zero, jnp.eye(len(start), dtype=start.dtype)
    carry = (start, nothing, jnp.zeros_like(unknown), (zero, unknown), 0)
    x, _, _, (step, gain), _ = jax.lax.while_loop(unsettled, advance, carry)
    # The last step is too short to be worth another linearisation, and is taken on trust.
    return jnp.where(gain <= SETTLED, x + step, x)
