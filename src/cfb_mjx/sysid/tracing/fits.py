"""A hypothesis fitted to the flights of a search, and how well it predicts them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cfb_mjx.sysid.evaluation import Evaluation, evaluate
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis, Linear
from cfb_mjx.sysid.tracing.search import Search

ERRORS = tuple(
    f"{q}@{h}s"
    for h in ("0.2", "0.5")
    for q in ("position_rmse_m", "velocity_rmse_mps", "attitude_rmse_deg", "rate_rmse_radps")
)
"""Prediction errors an effect is judged by: four quantities, two horizons."""


def predicted(search: Search, hypothesis: Hypothesis) -> Evaluation:
    """The flights of the search, predicted."""
    return evaluate(hypothesis.model(search.parameters), search.logs, faults=hypothesis.faults, keep_diverged=True)


def errors_of(evaluation: Evaluation) -> np.ndarray:
    """(8,) `ERRORS` over all flights."""
    metrics = evaluation.metrics("commands_in")
    return np.array([metrics[key] for key in ERRORS])


def prediction_errors(search: Search, hypothesis: Hypothesis) -> np.ndarray:
    """(8,) `ERRORS` on the flights of the search."""
    return errors_of(predicted(search, hypothesis))


@dataclass(frozen=True)
class Fit:
    """A hypothesis fitted to the flights.

    Attributes:
        hypothesis: with the values that fit.
        linear: its derivatives by the whole catalogue; None for one among many, which may not be taken.
        errors: (8,) `ERRORS` over all flights.
        by_flight: (L, 8) `ERRORS` in each flight that has prediction windows.
        beside_hold: `beside_hold` of its predictions.
    """

    hypothesis: Hypothesis
    linear: Linear | None
    errors: np.ndarray
    by_flight: np.ndarray
    beside_hold: float = 0.0


def beside_hold(evaluation: Evaluation) -> float:
    """The larger of attitude and velocity error at the last horizon (means), over what hold errs there."""
    model, still = (evaluation.metrics(variant) for variant in ("commands_in", "hold"))
    keys = [f"{quantity}@{max(evaluation.horizons):g}s" for quantity in ("attitude_mean_deg", "velocity_mean_mps")]
    found = max(model[key] / still[key] for key in keys)
    return float(found) if np.isfinite(found) else np.inf


def fitted(search: Search, hypothesis: Hypothesis, whole: bool = True) -> Fit:
    """Fit everything a hypothesis holds; derivatives by the catalogue only if ``whole``."""
    return as_it_is(search, search.settled(hypothesis), whole)


def as_it_is(search: Search, hypothesis: Hypothesis, whole: bool = True) -> Fit:
    """A hypothesis that is fitted already, with what it leaves."""
    linear = search.whole(hypothesis) if whole else None
    evaluation = predicted(search, hypothesis)
    flights = [errors_of(one) for one in evaluation.each if len(one.logs[0].windows)]
    return Fit(hypothesis, linear, errors_of(evaluation), np.array(flights), beside_hold(evaluation))


def completed(search: Search, fit: Fit) -> Fit:
    """The fit with its derivatives by the whole catalogue."""
    return fit if fit.linear is not None else replace(fit, linear=search.whole(fit.hypothesis))
