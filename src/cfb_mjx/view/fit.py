"""Figure of a fit: estimates with intervals, their correlation, and the held-out error before and after."""

from __future__ import annotations

import os

import numpy as np

from cfb_mjx.sysid.identification.result import Fit
from cfb_mjx.view import style

_STAGES = (
    ("before", style.COLOURS["rotor_speed_in"], "s", "before"),
    ("after", style.COLOURS["commands_in"], "o", "after"),
    ("hold", style.COLOURS["hold"], "^", "hold"),
)
_PANELS = (("velocity_rmse_mps", "velocity, m/s"), ("attitude_rmse_deg", "attitude, deg"))
_ESTIMATORS = {"innovation": "one-step innovations", "shooting": "multiple shooting"}


def fit_figure(result: Fit, other: Fit | None, before, after, path: str | os.PathLike) -> None:
    """Draw the results of `cfb fit`.

    Args:
        result: the fit.
        other: the fit of the other estimator, drawn next to it; or None.
        before: `cfb_mjx.sysid.evaluate` of the initial model on held-out data.
        after: the same for the fitted model.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``.

    Raises:
        CfbError: an unknown ending, or the file cannot be written.
    """
    path = style.check_path(path)
    with style.context():
        height = max(3.6, 0.3 * len(result.names) + 1.9)
        figure = style.new_figure(13.6, height)
        grid = figure.add_gridspec(1, 4, width_ratios=(1.5, 1.25, 1.05, 1.05), wspace=0.62)
        left, middle, *right = (figure.add_subplot(grid[0, i]) for i in range(4))
        _draw_estimates(left, result, other)
        _draw_correlation(middle, result)
        for panel, (key, label) in zip(right, _PANELS, strict=True):
            _draw_errors(panel, key, label, before, after)
        figure.subplots_adjust(left=0.115, right=0.99, top=1 - 0.4 / height, bottom=1.35 / height)
        style.save(figure, path)


def _draw_estimates(panel, result: Fit, other: Fit | None) -> None:
    names = list(result.estimates)
    rows = np.arange(len(names))[::-1]
    fits = [(result, style.COLOURS["commands_in"], "o", 0.0)]
    if other is not None:
        fits.append((other, style.COLOURS["rotor_speed_in"], "s", -0.22))
    for fitted, colour, marker, shift in fits:
        shown = [
            (row, fitted.estimates[name]) for row, name in zip(rows, names, strict=True) if name in fitted.estimates
        ]
        if not shown:
            panel.plot([], [], marker, color=colour, label=f"{_ESTIMATORS[fitted.estimator]}: estimates none of these")
            continue
        # An offset has no ratio to a preset of zero, so its change is shown in units of its standard deviation.
        panel.errorbar(
            [_change(e) for _, e in shown],
            [row + shift for row, _ in shown],
            xerr=[196 * e.std / abs(e.preset) if e.preset else 1.96 for _, e in shown],
            fmt=marker,
            color=colour,
            markersize=4.5,
            capsize=2.5,
            linewidth=1.2,
            label=_ESTIMATORS[fitted.estimator],
        )
    panel.axvline(0, color=style.MEASURED, linewidth=0.8)
    panel.set_yticks(rows, [name if result.estimates[name].preset else f"{name} (std)" for name in names])
    panel.set_ylim(-0.7, len(names) - 0.3)
    panel.set_xscale("symlog", linthresh=10)
    panel.set_xticks([-100, -10, 0, 10, 100, *([1000] if _reaches(fits, 300) else [])])
    panel.xaxis.set_major_formatter(lambda x, _: f"{x:+.0f}" if x else "preset")
    panel.set_xlabel("change from the preset, % (95 % interval)")
    panel.set_title("estimates")
    if other is not None:
        # Below the axis label, level with the tick labels of the correlation.
        panel.legend(loc="upper left", bbox_to_anchor=(-0.35, -0.22), fontsize=8)


def _change(estimate) -> float:
    difference = estimate.value - estimate.preset
    return 100 * difference / abs(estimate.preset) if estimate.preset else difference / max(estimate.std, 1e-300)


def _reaches(fits, limit: float) -> bool:
    return any(abs(_change(e)) > limit for fitted, *_ in fits for e in fitted.estimates.values())


def _draw_correlation(panel, result: Fit) -> None:
    correlation = np.asarray(result.uncertainty.correlation)
    panel.imshow(correlation, vmin=-1, vmax=1, cmap="RdBu_r")
    panel.grid(False)
    names = result.uncertainty.order
    ticks = np.arange(len(names))
    panel.set_xticks(ticks, names, rotation=60, ha="right", fontsize=7)
    panel.set_yticks(ticks, names, fontsize=7)
    for i in ticks:
        for j in ticks:
            strong = abs(correlation[i, j]) > 0.6
            colour = "white" if strong else style.MEASURED
            panel.text(j, i, f"{correlation[i, j]:.1f}", ha="center", va="center", fontsize=6.5, color=colour)
    panel.set_title("correlation")


def _draw_errors(panel, key: str, label: str, before, after) -> None:
    metrics = {"before": before.metrics("commands_in"), "after": after.metrics("commands_in")}
    metrics["hold"] = before.metrics("hold")
    names = [name for name in metrics["hold"] if name.startswith(key)]
    horizons = [1e3 * float(name.partition("@")[2][:-1]) for name in names]
    for stage, colour, marker, text in _STAGES:
        values = [metrics[stage][name] for name in names]
        panel.plot(horizons, values, color=colour, marker=marker, markersize=4, linewidth=1.3, label=text)
    panel.set_yscale("log")
    panel.set_xlabel("prediction, ms")
    panel.set_title(f"held-out error of\n{label} rms")
    panel.legend(loc="lower right", fontsize=7.5)
