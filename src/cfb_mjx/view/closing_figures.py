"""Figures of the report of a model correction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cfb_mjx.model.effects.fields import HOVER_SPEED
from cfb_mjx.model.effects.formula import PLACES, TERMS
from cfb_mjx.sysid.metrics import QUANTITIES
from cfb_mjx.sysid.tracing.diagnosis import Diagnosis, HeldOut, Reported
from cfb_mjx.sysid.tracing.formula import Term
from cfb_mjx.sysid.tracing.residuals import UNITS, sensor_spectra, spectra
from cfb_mjx.sysid.tracing.structure import BINS, PREDICTION_BINS, Pooled, Structure, binned, where_it_shows
from cfb_mjx.view import style

BEFORE, AFTER = style.COLOURS["rotor_speed_in"], style.COLOURS["commands_in"]
RANDOM = "#009E73"
FEW = 2000
"""Number of values below which bins are wider, as for residuals with one value per window instead of one per row."""
_TITLES = {"position": "position, m", "velocity": "velocity, m/s", "attitude": "attitude, deg", "rate": "rate, rad/s"}


def errors_figure(before, after, floor: dict[str, float], random: dict[str, float], path: Path) -> None:
    """Held-out RMS error against horizon, one panel per quantity.

    Args:
        before: `Evaluation` of the declared model.
        after: `Evaluation` of the corrected model.
        floor: `noise_floor` of the sensors alone.
        random: `noise_floor` of the sensors and random disturbances.
        path: file to write.
    """
    series = (
        ("before", before, "commands_in", BEFORE, "s"),
        ("after", after, "commands_in", AFTER, "o"),
        ("hold", before, "hold", style.COLOURS["hold"], "^"),
    )
    horizons = 1e3 * np.array(before.horizons)
    with style.context():
        figure = style.new_figure(13.6, 3.9)
        panels = figure.subplots(1, 4)
        for panel, (quantity, unit) in zip(panels, QUANTITIES.items(), strict=True):
            keys = [f"{quantity}_rmse_{unit}@{h:g}s" for h in before.horizons]
            bottom = np.array([floor[key] for key in keys])
            for order, (label, evaluation, variant, colour, marker) in enumerate(series):
                values, spans = evaluation.metrics(variant), evaluation.intervals(variant)
                middle, ends = np.array([values[k] for k in keys]), np.array([spans[k] for k in keys]).T
                # Offset in x, because equal errors would cover each other.
                panel.errorbar(
                    horizons * (1 + 0.035 * (order - 1)),
                    middle,
                    np.abs(ends - middle),
                    color=colour,
                    marker=marker,
                    markersize=4.5,
                    capsize=2.5,
                    linewidth=1.4,
                    label=label,
                )
            panel.plot(horizons, [random[k] for k in keys], ":", color=RANDOM, lw=1.6, label="noise and disturbances")
            panel.plot(horizons, bottom, "--", color=style.MEASURED, lw=1.2, label="noise floor")
            panel.set_xscale("log")
            panel.set_yscale("log")
            low = 0.6 * bottom.min()
            panel.set_ylim(bottom=low)
            panel.fill_between(horizons, low, bottom, color="#dddddd", zorder=0)
            panel.set_xticks(horizons, [f"{h:.0f}" for h in horizons])
            panel.xaxis.minorticks_off()
            panel.set_xlabel("prediction, ms")
            panel.set_title(_TITLES[quantity])
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="lower center", ncols=len(labels), fontsize=9.5)
        figure.subplots_adjust(left=0.045, right=0.995, top=0.92, bottom=0.24, wspace=0.24)
        style.save(figure, path)


def squared(unit: str) -> str:
    """Format a unit with superscript exponents."""
    return unit.replace("^2", "²")


@dataclass(frozen=True)
class Panel:
    """One residual axis against one signal, for two models on the same flights."""

    axis: str
    signal: str
    before: Pooled
    after: Pooled


def binned_figure(panels: Sequence[Panel], labels: tuple[str, str], path: Path) -> None:
    """Draw means of residuals in bins of a signal, with 95 % intervals, before and after.

    Args:
        panels: the panels, from left to right.
        labels: labels of the two models; a model without a label is not drawn.
        path: file to write.
    """
    with style.context():
        # At least three columns, because a single panel would be enlarged to the width of the page.
        width = 4.5 * max(len(panels), 3)
        figure = style.new_figure(width, 3.6)
        axes = figure.subplots(1, max(len(panels), 3), squeeze=False)[0]
        for panel, drawn in zip(panels, axes, strict=False):
            _binned(drawn, panel, labels)
        for empty in axes[len(panels) :]:
            empty.set_visible(False)
        handles, names = axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="upper left", bbox_to_anchor=(0.045, 1.0), ncols=2)
        figure.subplots_adjust(left=0.06, right=0.99, top=0.88, bottom=0.15, wspace=0.27)
        style.save(figure, path)


def _binned(drawn, panel: Panel, labels: tuple[str, str]) -> None:
    signal = panel.before.drivers[panel.signal]
    # Evenly spaced, because with equal counts a flight that mostly hovers would have all bins near zero.
    count = 6 if len(signal) < FEW else 12
    low, high = np.nanquantile(signal, [0.005, 0.995])
    edges = np.linspace(low, high, count + 1)
    for pooled, colour, marker, label in (
        (panel.before, BEFORE, "s", labels[0]),
        (panel.after, AFTER, "o", labels[1]),
    ):
        if not label:
            continue
        found = binned(pooled.axes[panel.axis], pooled.drivers[panel.signal], pooled.block, edges)
        drawn.errorbar(
            found.center,
            found.mean,
            1.96 * found.error,
            color=colour,
            marker=marker,
            markersize=4.5,
            capsize=2.5,
            linewidth=1.2,
            label=label,
        )
    drawn.axhline(0, color=style.MEASURED, linewidth=0.8)
    drawn.locator_params(axis="x", nbins=6)
    unit = (UNITS | TERMS | PLACES)[panel.signal]
    drawn.set_xlabel(panel.signal if unit == "1" else f"{panel.signal}, {squared(unit)}")
    drawn.set_ylabel(f"{panel.axis}, {squared(panel.before.units[panel.axis])}")


def matrix_figure(before: Structure, after: Structure, path: Path) -> None:
    """Draw the share of each residual's mean square that each signal explains, before and after.

    Both are relative to the mean square before.

    Args:
        before: structure of the declared model's residuals; residuals that were not measured are left out.
        after: structure of the corrected model's residuals.
        path: file to write.
    """
    shown = [i for i, size in enumerate(before.rms) if np.isfinite(size)]
    columns = [j for j in range(len(before.signals)) if np.isfinite(before.share[shown, j]).any()]
    scale = (after.rms / before.rms)[:, None] ** 2
    with style.context():
        height = 0.27 * len(shown) + 1.75
        figure = style.new_figure(13.6, height)
        panels = figure.subplots(1, 2, sharey=True)
        for panel, share, title in (
            (panels[0], before.share, "before"),
            (panels[1], after.share * scale, "after"),
        ):
            values = 100 * np.clip(share[np.ix_(shown, columns)], 0, 1)
            image = panel.imshow(values, vmin=0, vmax=100, cmap="Oranges", aspect="auto")
            panel.grid(False)
            panel.set_xticks(range(len(columns)), [before.signals[j] for j in columns], rotation=55, ha="right")
            panel.set_yticks(range(len(shown)), [before.axes[i] for i in shown])
            for y, x in zip(*np.nonzero(np.nan_to_num(values) >= 3), strict=True):
                colour = "white" if values[y, x] > 60 else style.MEASURED
                panel.text(x, y, f"{values[y, x]:.0f}", ha="center", va="center", fontsize=7, color=colour)
            panel.set_title(title)
        figure.subplots_adjust(left=0.085, right=0.92, top=1 - 0.3 / height, bottom=1.3 / height, wspace=0.03)
        bar = figure.add_axes((0.935, 1.3 / height, 0.012, 1 - 1.6 / height))
        figure.colorbar(image, cax=bar, label="% of the mean square before")
        style.save(figure, path)


def spectra_figure(
    before: dict[str, tuple], after: dict[str, tuple], noise: dict[str, np.ndarray], units: dict[str, str], path: Path
) -> None:
    """Draw the power spectral density of every residual axis.

    Args:
        before: axis to frequency (Hz) and density, for the declared model.
        after: the same for the corrected model.
        noise: axis to the density of the sensors' white noise, at the same frequencies.
        units: axis to its unit.
        path: file to write.
    """
    from matplotlib.ticker import NullFormatter

    axes, ticks = list(before), [0.25, 0.5, 1, 2, 5, 10]
    rows = -(-len(axes) // 3)
    with style.context():
        figure = style.new_figure(13.6, 2.75 * rows + 0.45)
        panels = figure.subplots(rows, 3, squeeze=False, sharex=True).ravel()
        for panel, axis in zip(panels, axes, strict=False):
            for (frequency, density), colour, label in (
                (before[axis], BEFORE, "before"),
                (after[axis], AFTER, "after"),
            ):
                panel.plot(frequency, density, color=colour, linewidth=1.4, label=label)
            if axis in noise:
                panel.plot(frequency, noise[axis], "--", color=style.MEASURED, lw=1.1, label="sensor noise")
            panel.set_xscale("log")
            panel.set_yscale("log")
            # Limit the range, because far below the other values only the filter's response is visible.
            low = min(before[axis][1].min(), after[axis][1].min())
            high = max(before[axis][1].max(), after[axis][1].max())
            panel.set_ylim(0.3 * low, 3 * max(high, 30 * low))
            panel.set_title(f"{axis}, ({squared(units[axis])})²/Hz")
            panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
            panel.xaxis.minorticks_off()
            panel.yaxis.set_minor_formatter(NullFormatter())
        for panel in panels[len(axes) :]:
            panel.set_visible(False)
        for panel in panels[max(0, len(axes) - 3) : len(axes)]:
            panel.set_xlabel("frequency, Hz")
            panel.tick_params(labelbottom=True)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="upper right", ncols=3)
        height = 2.75 * rows + 0.45
        figure.subplots_adjust(
            left=0.05, right=0.99, top=1 - 0.55 / height, bottom=0.5 / height, hspace=0.25, wspace=0.17
        )
        style.save(figure, path)


def panels_of(terms: list[Term], before: Pooled, after: Pooled, most: int) -> list[Panel]:
    """One panel for each of the first terms of a formula: its axis against its signal.

    Args:
        terms: terms of the formula; constants have no signal and therefore no panel.
        before: residuals without the terms.
        after: residuals with the terms.
        most: largest number of panels.
    """
    found = []
    for term in [term for term in terms if term.signal != "1"][:most]:
        name = term.signal
        pair = [replace(p, drivers=p.drivers | {name: signal_of(name, p.drivers)}) for p in (before, after)]
        found.append(Panel(_axis(term, before), name, *pair))
    return found


def signal_of(name: str, drivers: dict[str, np.ndarray]) -> np.ndarray:
    """A signal of the formulas' terms (`cfb_mjx.model.effects.formula`), from the drivers of residuals (N,)."""
    known = {f"v_{a}": drivers[f"velocity {a}"] for a in "xyz"} | {f"w_{a}": drivers[f"rate {a}"] for a in "xyz"}
    known |= {f"n_{key}": drivers[f"rotor {key}"] / HOVER_SPEED for key in ("roll", "pitch", "yaw")}
    known |= {"n": drivers["rotor mean"] / HOVER_SPEED - 1, "1": np.ones_like(drivers["time"])}
    known |= {"x": drivers["position x"], "y": drivers["position y"], "z": drivers["height"]}
    known["|v|"] = np.linalg.norm([known[f"v_{a}"] for a in "xyz"], axis=0)
    factors = [known[part.removesuffix("^2")] ** (1 + part.endswith("^2")) for part in name.split()]
    return np.prod(factors, axis=0)


def _axis(term: Term, pooled: Pooled) -> str:
    """The residual axis of a term. For the world's vertical, the body's z axis, which is vertical in hover."""
    name = term.axis.replace("_", " ")
    return name if name in pooled.axes else name.removeprefix("world ")


PANELS = 3
"""Largest number of panels of one figure."""
Figures = dict[str, list[tuple[Path, str]]]


def draw(diagnosis: Diagnosis, folder: Path) -> Figures:
    """Draw all figures of a report.

    Args:
        diagnosis: result of the model correction.
        folder: folder to write into.

    Returns:
        Files with alternative texts under ``errors``, ``residuals``, ``left`` and ``unexplained`` (the last two only if
        there is something to show), and for each effect under `key_of`.
    """
    held_out = diagnosis.held_out
    figures: Figures = {"errors": [(folder / "errors.svg", "held-out error against horizon, before and after")]}
    errors_figure(diagnosis.before, diagnosis.after, held_out.noise_floor, held_out.random, figures["errors"][0][0])
    for item in diagnosis.reported:
        panels, labels = _effect(diagnosis, item)
        if panels:
            path = folder / f"{key_of(item.name)}.svg"
            binned_figure(panels, labels, path)
            what = ", ".join(f"{p.axis} against {p.signal}" for p in panels)
            figures[key_of(item.name)] = [(path, f"{item.name}: {what}, {labels[0]} and {labels[1]}")]
    panels, labels = _terms(diagnosis)
    if panels:
        binned_figure(panels, labels, folder / "unexplained.svg")
        what = ", ".join(f"{p.axis} against {p.signal}" for p in panels)
        figures["unexplained"] = [(folder / "unexplained.svg", f"{what}: {' and '.join(filter(None, labels))}")]
    matrix_figure(*held_out.structure, folder / "matrix.svg")
    figures["residuals"] = [
        (folder / "matrix.svg", "share of each residual that follows each signal, before and after")
    ]
    figures["residuals"] += _spectra(held_out, folder / "spectra.svg")
    after = held_out.structure[1]
    left = [(after.axes[i], after.signals[j]) for i, j in after.strongest(PANELS)]
    # A mean (offset) has no signal, so it is drawn over time.
    panels = [
        Panel(axis, name if name in held_out.pair(axis)[0].drivers else "time", *held_out.pair(axis))
        for axis, name in left
    ]
    if panels:
        # Without the residuals before, whose scale would hide the remaining structure.
        binned_figure(panels, ("", "after"), folder / "left.svg")
        figures["left"] = [(folder / "left.svg", "the strongest structure left in the residuals")]
    return figures


def key_of(name: str) -> str:
    """Key of an effect's figures; the prefix keeps it different from the other keys."""
    return f"effect {name}"


def _spectra(held_out: HeldOut, path: Path) -> list[tuple[Path, str]]:
    before, after = spectra(held_out.rows[0]), spectra(held_out.rows[1])
    if not before:
        return []
    frequency = next(iter(before.values()))[0]
    interval = float(np.median([log.nominal_interval for log in held_out.search.logs]))
    noise = sensor_spectra(frequency, held_out.search.noise, interval)
    units = {axis: held_out.pooled[0].units.get(axis, "rad/s") for axis in before}
    spectra_figure(before, after, noise, units, path)
    return [(path, "spectra of the residuals before and after")]


def _effect(diagnosis: Diagnosis, item: Reported) -> tuple[list[Panel], tuple[str, str]]:
    """Panels of an effect: residuals of all flights without and with it, against the signals on which they depend."""
    without = diagnosis.without(item)
    if without is None:
        # A fault of pose or gyro affects predictions, but hardly forces and torques.
        return _panels(*diagnosis.held_out.predictions, PREDICTION_BINS), ("before", "after")
    return _panels(*diagnosis.residuals(without)), (f"best model without {item.name}", "corrected model")


def _terms(diagnosis: Diagnosis) -> tuple[list[Panel], tuple[str, str]]:
    """Panels of the terms of a formula: on all flights, or on the held-out flights if only those show them."""
    left = diagnosis.unexplained
    if left is not None and left.proposal is not None:
        both = diagnosis.residuals(left.proposal.without)
        return panels_of(left.proposal.terms, *both, PANELS), ("without the terms", "with them")
    if left is not None and left.held_out_only:
        after = diagnosis.held_out.pooled[1]
        return panels_of(left.held_out_only, after, after, PANELS), ("left on the held-out flights", "")
    return [], ("", "")


def _panels(less: Pooled, more: Pooled, bins: int = BINS) -> list[Panel]:
    return [Panel(axis, signal, less, more) for axis, signal in where_it_shows(less, more, bins)]
