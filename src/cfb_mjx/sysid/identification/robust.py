"""Outliers: readings that no Gaussian noise of the level found explains, such as a bad radio packet."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

OUTLIER = 3.0
"""Beyond so many standard deviations an error counts linearly instead of squared (Huber 1964), and moves no filter."""


def limited(error: Array, variance: Array, robust: bool) -> Array:
    """The part of an innovation a filter believes."""
    if not robust:
        return error
    bound = OUTLIER * jnp.sqrt(variance)
    return jnp.clip(error, -bound, bound)


def tempered(whitened: Array, robust: bool) -> Array:
    """Residuals in standard deviations; with ``robust``, half their square is Huber's loss."""
    if not robust:
        return whitened
    size = jnp.abs(whitened)
    # The inner maximum keeps the gradient of the branch not taken finite.
    outside = jnp.sqrt(2 * OUTLIER * jnp.maximum(size, OUTLIER) - OUTLIER**2)
    return jnp.where(size <= OUTLIER, whitened, jnp.sign(whitened) * outside)


SHARE, SPREAD = 0.01, 50.0
"""Outliers as noise levels are found: this share of the readings, with so many times the noise of the others."""


def surprise(whitened: Array, robust: bool) -> Array:
    """Minus twice the log-density of residuals in standard deviations, without the constant.

    With ``robust``, of a mixture of good readings and outliers: a scale found with Huber's loss would still grow with
    the size of the outliers.
    """
    if not robust:
        return whitened**2
    good = jnp.log(1 - SHARE) - 0.5 * whitened**2
    bad = jnp.log(SHARE / SPREAD) - 0.5 * (whitened / SPREAD) ** 2
    return -2 * jnp.logaddexp(good, bad)
