"""Noise levels and parameters of largest likelihood: sums over parts of the flights, and their descents in turns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from cfb_mjx.devices import over_cores
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification.flight_data import Segments
from cfb_mjx.sysid.identification.innovation import Drive, Weights, as_held, drive, innovations, weights, whitened
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.solver import (
    SOLVED,
    UNBOUNDED,
    Bounds,
    Quadratic,
    descended,
    least_squares,
    likelihood,
    linearised,
    surprise,
    tempered,
)
from cfb_mjx.sysid.identification.uncertainty import Scores
from cfb_mjx.sysid.identification.unknowns import OFFSETS, Unknowns

ROUNDS = 8
"""Noise levels and parameters are found in turns, at most so often."""
ACCURACY = (1e-2, 1e-4, SOLVED)
"""Squared error of a round's parameters, in standard deviations of the estimate; the last also of later rounds."""
LEVELS = 1e-3
"""Least squared error of noise levels: a few per cent of a standard deviation do not move the parameters."""
SETTLED = 5e-4
"""A round that changes no parameter by more than this share is the last."""
BLOCK = 128
"""Rows the bootstrap keeps together: half a second at 250 Hz, longer than the disturbance stays correlated."""


class Prior(NamedTuple):
    """What is known of the unknowns beside the flights: see `solver.descended`."""

    ridge: Float[Array, " k"]
    bounds: Bounds = UNBOUNDED


def settled(
    unknowns: Unknowns,
    vector,
    noise: Noise,
    segments: list[Segments],
    use_measured,
    robust,
    prior: Prior,
    solver: optx.AbstractLeastSquaresSolver | None,
    progress: Callable[[int, int], None] | None,
) -> tuple[Array, Noise]:
    """Vector and noise levels of largest likelihood, found in turns."""
    for done in range(ROUNDS):
        before, levels = vector, noise
        accuracy = ACCURACY[min(done, len(ACCURACY) - 1)]
        noise = fit_noise(unknowns, vector, noise, segments, use_measured, robust, max(accuracy, LEVELS))
        vector = _fit_vector(unknowns, vector, noise, segments, use_measured, robust, prior, solver, accuracy)
        if progress is not None:
            progress(min(done + 1, ROUNDS - 1), ROUNDS)
        # A vector that the flights hardly tell may creep for ever; what creeps under the same noise is of no matter.
        changed = max(
            float(jnp.max(jnp.abs(a / b - 1))) for a, b in zip(*map(jax.tree.leaves, (noise, levels)), strict=True)
        )
        still = changed < SETTLED or float(jnp.max(jnp.abs(vector - before))) < SETTLED
        if still and accuracy == ACCURACY[-1]:
            break
    return vector, noise


def _at(unknowns: Unknowns, vector, segments: Segments) -> tuple[Parameters, Segments]:
    """The drone of a vector, and its commands as it says they acted."""
    parameters = unknowns.apply(vector)
    return parameters, as_held(parameters, unknowns.hold(vector), segments)


def _each(function: Callable, *pieces: Sequence) -> Iterator:
    """Results of a compiled function of the parts of the data and what belongs to them, one after the other.

    All cores compute them, unless the parts are divided over devices.
    """
    several = any(piece.over is not None for piece in pieces[0])
    along = zip(*pieces, strict=True)
    return (function(*each) for each in along) if several else over_cores(lambda each: function(*each), along)


def fit_noise(
    unknowns: Unknowns,
    vector,
    noise: Noise,
    segments: Sequence[Segments],
    use_measured: bool,
    robust: bool,
    accuracy: float = SOLVED,
) -> Noise:
    """Noise levels of largest likelihood at ``vector``, from ``noise`` on; ``segments`` in `parts`."""
    # The smoothed rotor speeds stay those of the last round's noise: the rotors' own readings say how noisy they are.
    driven = list(_each(lambda part: _driven(unknowns, vector, noise, part, use_measured, robust), segments))

    def about(levels):
        return _each(
            lambda part, own: _likelihood(levels, unknowns, vector, part, own, use_measured, robust), segments, driven
        )

    return Noise.from_vector(descended(about, noise.to_vector(), levels=True, bounds=Noise.bounds(), accuracy=accuracy))


@eqx.filter_jit
def _driven(unknowns: Unknowns, vector, noise: Noise, part: Segments, use_measured: bool, robust: bool) -> Drive:
    parameters, part = _at(unknowns, vector, part)
    return drive(parameters, noise, part, use_measured, robust)


@eqx.filter_jit
def _likelihood(
    levels, unknowns: Unknowns, vector, part: Segments, driven: Drive, use_measured: bool, robust: bool
) -> Quadratic:
    parameters, part = _at(unknowns, vector, part)

    def predicted(x):
        error, variance = innovations(parameters, Noise.from_vector(x), part, driven, use_measured, robust)
        return error, jnp.log(variance)

    return likelihood(predicted, levels, robust)


def _residual(
    vector,
    unknowns: Unknowns,
    noise: Noise,
    segments: Segments,
    use_measured: bool,
    robust: bool,
    weighed: Weights | None = None,
):
    parameters, segments = _at(unknowns, vector, segments)
    return tempered(whitened(parameters, noise, segments, use_measured, robust, weighed), robust)


@eqx.filter_jit
def _weights(unknowns: Unknowns, vector, noise: Noise, segments: Segments, use_measured: bool, robust: bool) -> Weights:
    parameters, segments = _at(unknowns, vector, segments)
    return weights(parameters, noise, segments, use_measured, robust)


def surprise_of(
    unknowns: Unknowns, vector, noise: Noise, segments: Sequence[Segments], use_measured: bool, robust: bool
) -> float:
    """Negative logarithm of the likelihood per row, of commands that are what `as_held` makes of them and no other."""
    found = list(_each(lambda part: _surprises(unknowns, vector, noise, part, use_measured, robust), segments))
    return float(sum(nats for nats, _ in found)) / float(sum(rows for _, rows in found))


@eqx.filter_jit
def _surprises(unknowns: Unknowns, vector, noise: Noise, part: Segments, use_measured: bool, robust: bool):
    parameters, part = _at(unknowns, vector, part)
    part = eqx.tree_at(lambda s: s.doubt, part, jnp.zeros_like(part.doubt))
    driven = drive(parameters, noise, part, use_measured, robust)
    error, variance = innovations(parameters, noise, part, driven, use_measured, robust)
    return 0.5 * jnp.sum(jnp.log(variance) + surprise(error / jnp.sqrt(variance), robust)), jnp.sum(part.valid)


def _fit_vector(
    unknowns: Unknowns,
    vector,
    noise: Noise,
    segments: Sequence[Segments],
    use_measured: bool,
    robust: bool,
    prior: Prior,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    accuracy: float = SOLVED,
):
    weighed = list(_each(lambda part: _weights(unknowns, vector, noise, part, use_measured, robust), segments))
    if solver is not None:
        return _solved(unknowns, vector, noise, list(segments), weighed, use_measured, robust, prior.ridge, solver)

    def about(x):
        return _each(lambda part, own: _squares(x, unknowns, noise, part, own, use_measured, robust), segments, weighed)

    factors = jnp.asarray([name not in OFFSETS for name in unknowns.names])
    return descended(about, vector, prior.ridge, factors, prior.bounds, accuracy)


@eqx.filter_jit
def _squares(
    x, unknowns: Unknowns, noise: Noise, part: Segments, weighed: Weights, use_measured: bool, robust: bool
) -> Quadratic:
    return linearised(lambda x: _residual(x, unknowns, noise, part, use_measured, robust, weighed), x)


@eqx.filter_jit
def _solved(unknowns: Unknowns, vector, noise: Noise, segments, weighed, use_measured, robust, ridge, solver):
    """The vector by a solver of optimistix, which needs all residuals at once."""
    (_, doubt, variance), whole = zip(*weighed, strict=True), joined(segments)
    own = Weights(weighed[0].parameters, jnp.concatenate(doubt), jnp.concatenate(variance))
    return least_squares(
        lambda x: _residual(x, unknowns, noise, whole, use_measured, robust, own), vector, ridge, solver
    )


def joined(segments: Sequence[Segments]) -> Segments:
    """All parts in one, with what was added to divide them evenly."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *segments)


def scores_of(
    unknowns: Unknowns, vector, noise: Noise, segments: Sequence[Segments], use_measured: bool, robust: bool
) -> tuple[np.ndarray, Scores]:
    """Residuals (s, n, 8) of a fit, and its scores with respect to relative changes of the parameters."""
    found = slopes_in_blocks(unknowns, vector, noise, segments, use_measured, robust)
    residuals, scores = zip(*((residual, Scores.of(*blocks)) for residual, *blocks in found), strict=True)
    return np.concatenate(residuals), Scores.joined(scores)


def slopes_in_blocks(
    unknowns: Unknowns, vector, noise: Noise, segments: Sequence[Segments], use_measured: bool, robust: bool
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each part of the data its residuals (s, n, 8), and `in_blocks` residuals and their derivatives with respect
    to relative changes of the parameters."""
    relative = np.linalg.inv(unknowns.slope(vector))

    def one(part: Segments) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        residual, jacobian = map(np.asarray, fit_slopes(unknowns, vector, noise, part, use_measured, robust))
        return residual, *in_blocks(part, residual, jacobian @ relative)

    return _each(one, segments)


@eqx.filter_jit
def fit_slopes(unknowns: Unknowns, vector, noise: Noise, segments: Segments, use_measured: bool, robust: bool):
    """Residuals (s, n, 8) of a part of the data at ``vector``, and their derivatives (s, n, 8, k) by it."""

    def residual(x):
        return _residual(x, unknowns, noise, segments, use_measured, robust)

    return residual(vector), jax.jacfwd(residual)(vector)


def in_blocks(segments: Segments, residual: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and Jacobians cut into blocks of `BLOCK` rows, without those in which nothing counts."""
    counts = np.asarray(segments.valid * (1 - segments.warm_up))[:, 1:].reshape(-1, BLOCK).any(axis=1)
    channels, k = jacobian.shape[-2:]
    return residual.reshape(-1, BLOCK, channels)[counts], jacobian.reshape(-1, BLOCK, channels, k)[counts]
