"""The report of a closed loop: one page a stranger reads in two minutes, and a recording to look closer."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from cfb_mjx.files import write_text
from cfb_mjx.logs import FlightLog
from cfb_mjx.sysid.sensor_faults import HEALTHY
from cfb_mjx.sysid.tracing.floor import noise_floor
from cfb_mjx.sysid.tracing.outcome import Outcome, Reported
from cfb_mjx.sysid.tracing.residuals import Residuals, aligned, residual_rows
from cfb_mjx.sysid.tracing.search import Hypothesis, Search
from cfb_mjx.sysid.tracing.sensors import check_sensors
from cfb_mjx.sysid.tracing.spectra import sensor_spectra, spectra
from cfb_mjx.sysid.tracing.structure import (
    Pooled,
    Structure,
    edges_of,
    explained,
    pool,
    pool_predictions,
    structure,
)
from cfb_mjx.sysid.tracing.whitening import levels_from
from cfb_mjx.view import closing_sections as sections
from cfb_mjx.view.closing_figures import binned_figure, errors_figure, matrix_figure, spectra_figure
from cfb_mjx.view.closing_recording import write_recording
from cfb_mjx.view.closing_words import is_fault, verdict
from cfb_mjx.view.page import html_page

PREDICTION_BINS = 4
"""Bins of a signal where there is one value per window only."""


@dataclass(frozen=True)
class Looked:
    """What the page shows beyond the outcome itself.

    Attributes:
        rows: residuals of the held-out flights before and after.
        pooled: the same in one piece.
        predictions: errors of the predictions before and after, in one piece.
        structure: which of them follow which signal, before and after.
        floor: noise floor of the sensors.
        random: the same with random forces and torques of the size seen on the held-out flights.
    """

    rows: tuple[list[Residuals], list[Residuals]]
    pooled: tuple[Pooled, Pooled]
    predictions: tuple[Pooled, Pooled]
    structure: tuple[Structure, Structure]
    floor: dict[str, float]
    random: dict[str, float]


def write_report(
    outcome: Outcome,
    folder: Path,
    facts: Mapping[str, object],
    logs_fit: list[FlightLog],
    logs_held_out: list[FlightLog],
) -> None:
    """Write ``report.html``, which needs nothing beside it, and ``residual.rrd`` into a folder.

    Args:
        outcome: of `cfb_mjx.sysid.tracing.outcome.close_loop`.
        folder: an existing folder; what it holds is replaced whole or not at all.
        facts: date, machine and versions, printed at the end.
        logs_fit: flights that were learned from, as read.
        logs_held_out: flights that were not, as read.

    Raises:
        CfbError: a file cannot be written, or rerun is missing.
    """
    folder = Path(folder)
    judge = _beside(outcome, logs_held_out)
    looked = look(outcome, judge)
    write_recording(folder / "residual.rrd", looked.rows, outcome.before, outcome.after)
    with tempfile.TemporaryDirectory() as scratch:
        figures = _draw(outcome, judge, looked, logs_held_out, Path(scratch))
        found = sections.all_sections(outcome, looked, figures, logs_fit, logs_held_out)
        page = html_page(f"Closing the loop: {outcome.base.name}", verdict(outcome), found, facts)
    write_text(folder / "report.html", page)


def _beside(outcome: Outcome, logs: list[FlightLog], repaired: bool = True) -> Search:
    """The search on other flights, with the faults the fit flights showed taken out or left in."""
    search = outcome.trace.search
    check = check_sensors(logs, search.delay)
    return search.beside(logs, replace(check, faults=outcome.trace.sensors.faults if repaired else HEALTHY))


def look(outcome: Outcome, judge: Search) -> Looked:
    """Residuals before and after on held-out flights, and what can be said of them."""
    hypothesis = outcome.hypothesis
    raw = _beside(outcome, [log.log for log in outcome.before.logs], repaired=False)
    # Commands missing between rows are no effect: both models get the same share of them.
    declared = replace(judge.nothing(), lead=hypothesis.lead)
    rows = aligned(residual_rows(raw, declared), residual_rows(judge, hypothesis))
    pooled = pool(rows[0]), pool(rows[1])
    predictions = tuple(
        pool_predictions(evaluation, row) for evaluation, row in zip((outcome.before, outcome.after), rows, strict=True)
    )
    found = [
        _stacked(structure(p), structure(q, PREDICTION_BINS)) for p, q in zip(pooled, predictions, strict=True)
    ]
    judge.learn_levels(hypothesis)
    levels = levels_from(jnp.asarray(judge.levels), judge.noise)
    floor, random = noise_floor(outcome.after), noise_floor(outcome.after, levels)
    return Looked(rows, pooled, predictions, tuple(found), floor, random)


def _stacked(a: Structure, b: Structure) -> Structure:
    return Structure(
        a.axes + b.axes,
        a.signals,
        np.concatenate([a.share, b.share]),
        np.concatenate([a.sigma, b.sigma]),
        np.concatenate([a.rms, b.rms]),
    )


def _draw(
    outcome: Outcome, judge: Search, looked: Looked, logs: list[FlightLog], scratch: Path
) -> dict[str, list[tuple[Path, str]]]:
    """Figures as files, with what they show, by the section they belong to."""
    found = {"errors": [(scratch / "errors.svg", "held-out error against horizon before and after")]}
    errors_figure(outcome.before, outcome.after, looked.floor, looked.random, found["errors"][0][0])
    for item in outcome.reported:
        drawn = _effect(outcome, judge, looked, item, scratch / f"effect_{item.name}.svg")
        found[item.name] = [drawn] if drawn else []
    matrix = scratch / "matrix.svg"
    matrix_figure(*looked.structure, matrix)
    found["residuals"] = [(matrix, "share of each residual that follows each signal, before and after")]
    worst = looked.structure[1].strongest(3)
    if worst:
        pairs = [(looked.structure[1].axes[i], looked.structure[1].signals[j]) for i, j in worst]
        pairs = [(axis, signal if signal in looked.pooled[1].drivers else "time") for axis, signal in pairs]
        found["left"] = [(scratch / "left.svg", "the strongest structure left in the residuals")]
        both = [_both(p, q) for p, q in zip(looked.pooled, looked.predictions, strict=True)]
        for index, (axis, signal) in enumerate(pairs):
            path = scratch / f"left_{index}.svg"
            source = looked.predictions if axis in looked.predictions[0].axes else looked.pooled
            binned_figure(*source, [(axis, signal)], ("before", "after"), path)
        del both
    before, after = spectra(looked.rows[0]), spectra(looked.rows[1])
    if before:
        frequency = next(iter(before.values()))[0]
        noise = sensor_spectra(frequency, judge.noise, logs[0].nominal_interval)
        units = {axis: looked.pooled[0].units.get(axis, "rad/s") for axis in before}
        spectra_figure(before, after, noise, units, scratch / "spectra.svg")
        found["residuals"].append((scratch / "spectra.svg", "spectra of the residuals before and after"))
    return found
