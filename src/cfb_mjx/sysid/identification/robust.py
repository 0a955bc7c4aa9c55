"""Robust treatment of outliers, such as bad radio packets: Huber's loss and a mixture density."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

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
