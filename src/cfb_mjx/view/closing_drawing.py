"""Which figures the report of a closed loop has, and what each of them shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.sysid.tracing.hypothesis import Hypothesis
from cfb_mjx.sysid.tracing.outcome import Outcome, Reported
from cfb_mjx.sysid.tracing.residuals import aligned, residual_rows
from cfb_mjx.sysid.tracing.spectra import sensor_spectra, spectra
from cfb_mjx.sysid.tracing.structure import BINS, Pooled, explained, pool
from cfb_mjx.view.closing_figures import Panel, binned_figure, errors_figure, matrix_figure, spectra_figure
from cfb_mjx.view.closing_look import PREDICTION_BINS, Looked
from cfb_mjx.view.closing_terms import panels_of

PANELS = 3
"""Of one figure at most."""
Figures = dict[str, list[tuple[Path, str]]]


def draw(outcome: Outcome, looked: Looked, folder: Path) -> Figures:
    """Figures as files with alternative texts.

    Under ``errors``, ``residuals``, ``left``, ``unexplained`` (the last two if there is anything) and `key_of` effects.

    Args:
        outcome: of the closed loop.
        looked: `look`.
        folder: to write into.
    """
    figures: Figures = {"errors": [(folder / "errors.svg", "held-out error against horizon, before and after")]}
    errors_figure(outcome.before, outcome.after, looked.floor, looked.random, figures["errors"][0][0])
    for item in outcome.reported:
        panels, labels = _effect(outcome, looked, item)
        if panels:
            path = folder / f"{key_of(item.name)}.svg"
            binned_figure(panels, labels, path)
            what = ", ".join(f"{p.axis} against {p.signal}" for p in panels)
            figures[key_of(item.name)] = [(path, f"{item.name}: {what}, {labels[0]} and {labels[1]}")]
    panels, labels = _terms(outcome, looked)
    if panels:
        binned_figure(panels, labels, folder / "unexplained.svg")
        what = ", ".join(f"{p.axis} against {p.signal}" for p in panels)
        figures["unexplained"] = [(folder / "unexplained.svg", f"{what}: {' and '.join(filter(None, labels))}")]
    matrix_figure(*looked.structure, folder / "matrix.svg")
    figures["residuals"] = [
        (folder / "matrix.svg", "share of each residual that follows each signal, before and after")
    ]
    figures["residuals"] += _spectra(looked, folder / "spectra.svg")
    after = looked.structure[1]
    left = [(after.axes[i], after.signals[j]) for i, j in after.strongest(PANELS)]
    # A mean has no signal to be drawn against; over time it shows as well as over any other.
    panels = [
        Panel(axis, name if name in looked.pair(axis)[0].drivers else "time", *looked.pair(axis)) for axis, name in left
    ]
    if panels:
        # Beside what was there before, little of it would be seen.
        binned_figure(panels, ("", "after"), folder / "left.svg")
        figures["left"] = [(folder / "left.svg", "the strongest structure left in the residuals")]
    return figures


def key_of(name: str) -> str:
    """Under which an effect's figures stand, whatever it is called."""
    return f"effect {name}"


def _spectra(looked: Looked, path: Path) -> list[tuple[Path, str]]:
    before, after = spectra(looked.rows[0]), spectra(looked.rows[1])
    if not before:
        return []
    frequency = next(iter(before.values()))[0]
    interval = float(np.median([log.nominal_interval for log in looked.judge.logs]))
    noise = sensor_spectra(frequency, looked.judge.noise, interval)
    units = {axis: looked.pooled[0].units.get(axis, "rad/s") for axis in before}
    spectra_figure(before, after, noise, units, path)
    return [(path, "spectra of the residuals before and after")]


def _effect(outcome: Outcome, looked: Looked, item: Reported) -> tuple[list[Panel], tuple[str, str]]:
    """Where an effect shows: residuals of all flights without and with it, against the signal it follows."""
    if item.found is None or item.found.without is None:
        # A fault of pose or gyro hardly touches forces and torques; it spoils predictions.
        less, more = looked.predictions
        return _panels(less, more, PREDICTION_BINS), ("before", "after")
    without = item.found.without
    if outcome.unexplained is not None and outcome.unexplained.proposal is not None:
        # That was fitted before the formula; beside it only this effect may go.
        without = outcome.hypothesis.without(item.name)
    return _compared(outcome, looked, without), (f"best model without {item.name}", "corrected model")


def _terms(outcome: Outcome, looked: Looked) -> tuple[list[Panel], tuple[str, str]]:
    """Panels of the terms of a formula: on all flights, or on those that alone show them."""
    left = outcome.unexplained
    if left is not None and left.proposal is not None:
        both = _both(outcome, looked, left.proposal.without)
        return panels_of(left.proposal.terms, *both, PANELS), ("without the terms", "with them")
    if left is not None and left.held_out_only:
        after = looked.pooled[1]
        return panels_of(left.held_out_only, after, after, PANELS), ("left on the held-out flights", "")
    return [], ("", "")


def _compared(outcome: Outcome, looked: Looked, without: Hypothesis) -> list[Panel]:
    """Panels of a poorer hypothesis beside the corrected model, on all flights."""
    return _panels(*_both(outcome, looked, without))


def _both(outcome: Outcome, looked: Looked, without: Hypothesis) -> tuple[Pooled, Pooled]:
    """Residuals of a poorer hypothesis and of the corrected model, on all flights."""
    searches = outcome.trace.search, looked.judge
    less, more = (
        [row for search in searches for row in residual_rows(search, hypothesis)]
        for hypothesis in (without, outcome.hypothesis)
    )
    less, more = aligned(less, more)
    return pool(less), pool(more)


def _panels(less: Pooled, more: Pooled, bins: int = BINS) -> list[Panel]:
    return [Panel(axis, signal, less, more) for axis, signal in where_it_shows(less, more, bins)]


def where_it_shows(less: Pooled, more: Pooled, bins: int = BINS, count: int = PANELS) -> list[tuple[str, str]]:
    """Residual axes in which two models differ most, with the signal the difference follows best."""
    sizes = {}
    for axis, after in more.axes.items():
        difference = less.axes[axis] - after
        good = np.isfinite(difference)
        if good.any() and np.any(difference[good]):
            sizes[axis] = float(np.mean(difference[good] ** 2) / np.mean(after[good] ** 2))
    ranked = sorted(sizes, key=lambda axis: -sizes[axis])[:count]
    found = []
    for axis in ranked:
        if sizes[axis] < 0.1 * sizes[ranked[0]]:
            continue
        difference = less.axes[axis] - more.axes[axis]
        shares = {name: explained(difference, signal, less.block, bins)[0] for name, signal in less.drivers.items()}
        best = max(shares, key=shares.get)
        # A constant follows nothing; over time it shows as well as over any other signal.
        found.append((axis, best if shares[best] > 0.1 else "time"))
    return found
