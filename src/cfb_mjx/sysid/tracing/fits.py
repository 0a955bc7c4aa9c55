"""Fit a hypothesis to the flights of a search, predict with it, and compare hypotheses on held-out flights."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.stats import norm

from cfb_mjx.optional import not_none
from cfb_mjx.sysid.evaluation import Evaluation, evaluate
from cfb_mjx.sysid.flight import Flight, prepare_flight
from cfb_mjx.sysid.tracing.hypothesis import Fit, Hypothesis
from cfb_mjx.sysid.tracing.innovations import CHANNELS, DOMAINS, Blocks, Levels, innovations, joined, levels_from
from cfb_mjx.sysid.tracing.search import Search

ERRORS = tuple(
    f"{q}@{h}s"
    for h in ("0.2", "0.5")
    for q in ("position_rmse_m", "velocity_rmse_mps", "attitude_rmse_deg", "rate_rmse_radps")
)
"""Prediction errors by which an effect is judged: four quantities at two horizons."""


def predicted(search: Search, hypothesis: Hypothesis) -> Evaluation:
    """Predictions of the search's flights by a hypothesis."""
    return evaluate(hypothesis.model(search.parameters), search.logs, faults=hypothesis.faults, keep_diverged=True)


def errors_of(evaluation: Evaluation) -> np.ndarray:
    """Prediction errors `ERRORS` (8,) over all flights."""
    metrics = not_none(evaluation.metrics("commands_in"))
    return np.array([metrics[key] for key in ERRORS])


def prediction_errors(search: Search, hypothesis: Hypothesis) -> np.ndarray:
    """Prediction errors `ERRORS` (8,) on the flights of the search."""
    return errors_of(predicted(search, hypothesis))


def beside_hold(evaluation: Evaluation) -> float:
    """Mean attitude or velocity error at the last horizon, each divided by that of `hold`; the larger ratio of the two.

    Infinite if the predictions diverged.
    """
    model, still = (not_none(evaluation.metrics(variant)) for variant in ("commands_in", "hold"))
    keys = [f"{quantity}@{max(evaluation.horizons):g}s" for quantity in ("attitude_mean_deg", "velocity_mean_mps")]
    found = max(model[key] / still[key] for key in keys)
    return float(found) if np.isfinite(found) else np.inf


def fitted(search: Search, hypothesis: Hypothesis, whole: bool = True) -> Fit:
    """Fit the parameters of all present effects; linearise with respect to the whole catalogue only if ``whole``."""
    return as_it_is(search, search.settled(hypothesis), whole)


def as_it_is(search: Search, hypothesis: Hypothesis, whole: bool = True) -> Fit:
    """The `Fit` of a hypothesis that is already fitted: its errors and, if ``whole``, its linearisation."""
    linear = search.whole(hypothesis) if whole else None
    evaluation = predicted(search, hypothesis)
    flights = [errors_of(one) for one in evaluation.each if len(one.logs[0].windows)]
    return Fit(hypothesis, linear, errors_of(evaluation), np.array(flights), beside_hold(evaluation))


def completed(search: Search, fit: Fit) -> Fit:
    """The fit with its linearisation with respect to the whole catalogue, computed if it is missing."""
    return fit if fit.linear is not None else replace(fit, linear=search.whole(fit.hypothesis))


TOGETHER = 64
"""Number of blocks compared at once. It is fixed, so that one compiled program serves any number of blocks."""


@dataclass(frozen=True)
class Verdict:
    """Comparison of a richer hypothesis with a poorer one on held-out flights.

    Attributes:
        gain: decrease of half the sum of squared innovations, nats; None if predictions were compared instead.
        t: statistic that is standard normal if the richer hypothesis explains nothing more.
        p_value: one-sided p-value of ``t``.
        domains: the gain in each of `DOMAINS`.
    """

    gain: float | None
    t: float
    p_value: float
    domains: dict[str, float] | None = None


def confirm(search: Search, poorer: Hypothesis, richer: Hypothesis) -> Verdict:
    """Compare the whitened innovations of two fitted hypotheses on the flights of ``search``.

    Args:
        search: flights on which to compare.
        poorer: hypothesis without the effect to be tested; its noise levels are used for both.
        richer: hypothesis with the effect.
    """
    levels = levels_from(jnp.asarray(poorer.levels), search.noise)
    score, power, noise = np.zeros(CHANNELS + 3), np.zeros(CHANNELS + 3), 0.0
    alike = poorer.shift == richer.shift
    own, other = (None, None) if alike else zip(*_matched(search, poorer, richer), strict=True)
    # Compute the richer one first: its residuals stay cached while several poorer ones are compared with it.
    more = joined(blocks for blocks, _ in search.residuals(richer, other))
    less = joined(blocks for blocks, _ in search.residuals(poorer, own))
    signals = jax.tree.map(lambda a, b: np.stack([a, b], axis=-1), less.signals, more.signals)
    for first in range(0, len(less.interval), TOGETHER):
        # The last group repeats its last block.
        rows = np.arange(first, min(first + TOGETHER, len(less.interval)))
        filled = np.pad(rows, (0, TOGETHER - len(rows)), mode="edge")
        both = jax.tree.map(lambda x, r=filled: x[r], Blocks(signals, less.interval, less.valid))
        rz, zz = (np.asarray(x)[: len(rows)] for x in _products(both, levels))
        score, power = score + rz.sum(axis=0), power + zz.sum(axis=0)
        noise += np.sum(np.sum(rz - zz, axis=1) ** 2)
    t = score.sum() / np.sqrt(max(noise, power.sum(), 1e-30))
    gain = score - 0.5 * power
    domains = {name: float(gain[list(channels)].sum()) for name, channels in DOMAINS.items()}
    return Verdict(float(gain.sum()), float(t), float(norm.sf(t)), domains)


@eqx.filter_jit
def _products(both: Blocks, levels: Levels) -> tuple[Array, Array]:
    """Sums per block and channel (b, 13): poorer residual times its difference to the richer one, and the square."""
    e, _, _ = innovations(both, levels)
    said = e[..., 0] - e[..., 1]
    return jnp.sum(e[..., 0] * said, axis=1), jnp.sum(said**2, axis=1)


def _matched(search: Search, poorer: Hypothesis, richer: Hypothesis) -> Iterator[tuple[Flight, Flight]]:
    """Every flight as prepared for both hypotheses, cut to their common rows.

    A time shift of the motor columns removes rows at the ends and at gaps.
    """
    for log in search.logs:
        logs = [hypothesis.faults.repaired(log) for hypothesis in (poorer, richer)]
        both = np.intersect1d(logs[0].time, logs[1].time)
        one, other = (prepare_flight(log.rows(np.isin(log.time, both)), *search.delays) for log in logs)
        yield one, other
