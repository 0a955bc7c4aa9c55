"""What the report of a closed loop looks at: residuals and predictions of held-out flights, before and after."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.sysid.sensor_faults import HEALTHY
from cfb_mjx.sysid.tracing.floor import noise_floor
from cfb_mjx.sysid.tracing.outcome import Outcome
from cfb_mjx.sysid.tracing.residuals import Residuals, aligned, residual_rows
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors
from cfb_mjx.sysid.tracing.structure import Pooled, Structure, pool, pool_predictions, structure
from cfb_mjx.sysid.tracing.whitening import FIRST, levels_from

PREDICTION_BINS = 4
"""Bins of a signal where there is one value per window only."""


@dataclass(frozen=True)
class Looked:
    """Beyond the outcome itself, all of held-out flights; pairs are before and after.

    Attributes:
        judge: the search on these flights, with the recording's faults taken out.
        rows: residuals of each flight.
        pooled: the same in one piece.
        predictions: errors of predictions, in one piece.
        structure: which of all these follow which signal.
        floor: noise floor of the sensors.
        random: the same with random forces and torques of the size these flights show.
    """

    judge: Search
    rows: tuple[list[Residuals], list[Residuals]]
    pooled: tuple[Pooled, Pooled]
    predictions: tuple[Pooled, Pooled]
    structure: tuple[Structure, Structure]
    floor: dict[str, float]
    random: dict[str, float]

    def pair(self, axis: str) -> tuple[Pooled, Pooled]:
        """Where a residual axis is found, before and after."""
        return self.predictions if axis in self.predictions[0].axes else self.pooled


def _beside(outcome: Outcome, logs: list[FlightLog], repaired: bool) -> Search:
    """The search on other flights, with the faults the fit flights showed taken out or left in."""
    search = outcome.trace.search
    check = check_sensors(logs, *search.delays)
    return search.beside(logs, replace(check, faults=outcome.trace.sensors.faults if repaired else HEALTHY))


def look(outcome: Outcome, logs: list[FlightLog]) -> Looked:
    """Residuals and predictions of the held-out ``logs``."""
    judge = _beside(outcome, logs, True)
    # Motors fitted anew are part of what changed.
    raw = replace(_beside(outcome, logs, False), parameters=outcome.base.parameters())
    hypothesis = outcome.hypothesis
    # Commands missing between rows are no effect: both models get the same share of them.
    declared = replace(judge.nothing(), lead=hypothesis.lead)
    rows = aligned(residual_rows(raw, declared), residual_rows(judge, hypothesis))
    pooled = pool(rows[0]), pool(rows[1])
    predictions = pool_predictions(outcome.before, rows[0]), pool_predictions(outcome.after, rows[1])
    found = [_stacked(structure(p), structure(q, PREDICTION_BINS)) for p, q in zip(pooled, predictions, strict=True)]
    # Predictions have commands in; measured rotor speeds would bring noise of their own.
    blind = replace(judge, logs=[log.replace(rotor_speed=None) for log in judge.logs], _flights={})
    levels = blind.learned(replace(hypothesis, levels=FIRST)).levels
    random = noise_floor(outcome.after, levels_from(jnp.asarray(levels), blind.noise))
    return Looked(judge, rows, pooled, predictions, (found[0], found[1]), noise_floor(outcome.after), random)


def _stacked(a: Structure, b: Structure) -> Structure:
    rows = {key: np.concatenate([getattr(a, key), getattr(b, key)]) for key in ("share", "sigma", "rms")}
    return Structure(a.axes + b.axes, a.signals, **rows)
