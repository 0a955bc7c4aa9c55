"""Figure of open-loop predictions of a model over the measurement, with the error against the horizon."""

from __future__ import annotations

import os

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.evaluation import VARIANTS, Evaluation, LogEvaluation
from cfb_mjx.sysid.metrics import QUANTITIES
from cfb_mjx.view import style

_TITLES = {
    "position": ("position", "m"),
    "velocity": ("velocity", "m/s"),
    "attitude": ("attitude", "deg"),
    "rate": ("body rate", "rad/s"),
}
_COMPONENTS = {
    "position": ("x", "y", "z"),
    "velocity": ("x", "y", "z"),
    "attitude": ("roll", "pitch", "yaw"),
    "rate": ("x", "y", "z"),
}
SHOWN = 6.0
"""Seconds of flight in the figure; with more, the predictions would be too narrow to see."""


def prediction_figure(
    evaluation: Evaluation,
    path: str | os.PathLike,
    log_name: str | None = None,
    title: str | None = None,
) -> None:
    """Draw one log's measurement with open-loop predictions over it, and error against horizon.

    Left, for `SHOWN` seconds in the middle of the flight: position [m], velocity [m/s], roll, pitch and yaw [deg]
    and body rate [rad/s]. Each prediction starts at an open circle on the measurement, and its markers are the
    evaluation's horizons; only windows that do not overlap are drawn. Pose and velocity are drawn without their delay.
    Right: RMS errors of that log with 95 % intervals.

    Args:
        evaluation: result of `cfb_mjx.sysid.evaluate`.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``.
        log_name: name of the log; by default the first that has windows.
        title: title of the figure; by default the log's name.

    Raises:
        CfbError: no such log, a log without windows, the ending of ``path`` is not supported, or the file cannot be
            written.
    """
    path = style.check_path(path)
    chosen = _choose(evaluation, log_name)
    alone = Evaluation((chosen,), evaluation.horizons)
    results = {v: (m, not_none(alone.intervals(v))) for v in VARIANTS if (m := alone.metrics(v)) is not None}
    with style.context():
        figure = style.new_figure(15.0, 9.6)
        grid = figure.add_gridspec(4, 4, left=0.046, right=0.99, top=0.95, bottom=0.095, wspace=0.27, hspace=0.15)
        first = None
        for row, quantity in enumerate(QUANTITIES):
            for column in range(3):
                axes = figure.add_subplot(grid[row, column], sharex=first)
                first = first or axes
                _draw_component(axes, chosen, evaluation.horizons, quantity, column)
                axes.tick_params(labelbottom=row == 3)
                if row == 3:
                    axes.set_xlabel("time, s")
            axes = figure.add_subplot(grid[row, 3])
            _draw_error(axes, results, evaluation.horizons, quantity)
            axes.tick_params(labelbottom=row == 3)
            if row == 3:
                axes.set_xlabel("horizon, s")
        _legend(figure, list(results))
        figure.align_ylabels()
        name = title or chosen.log.name
        figure.suptitle(
            f"{name}: measurement and {max(evaluation.horizons):g} s open-loop predictions "
            f"({len(chosen.windows)} windows; right: RMS error over all of them, 95 % interval)",
            fontsize=11,
            y=0.985,
        )
        style.save(figure, path)


def _choose(evaluation: Evaluation, name: str | None) -> LogEvaluation:
    for log in evaluation.logs:
        if log.log.name == name or (name is None and len(log.windows)):
            if not len(log.windows):
                raise CfbError(f"{name}: no prediction window fits in this log, so there is nothing to draw.")
            return log
    known = ", ".join(log.log.name for log in evaluation.logs)
    raise CfbError(f"{name}: no such log in this evaluation; choose one of {known}.")


def euler_deg(quaternion: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw, deg (z-y-x), from [w, x, y, z] quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(np.stack([roll, pitch, yaw], axis=-1))


def _measured(chosen: LogEvaluation, quantity: str) -> tuple[np.ndarray, np.ndarray]:
    """Times without delay (n,) and values (n, 3); NaN in gaps, so that no line crosses them."""
    log = chosen.log
    values = {
        "position": log.position,
        "velocity": log.velocity,
        "attitude": euler_deg(log.quaternion),
        "rate": log.body_rate,
    }[quantity]
    if quantity == "attitude":
        values = np.unwrap(values, period=360.0, axis=0)
    time = log.time - (0.0 if quantity == "rate" else chosen.delay)
    after = log.gaps() + 1
    return np.insert(time, after, time[after]), np.insert(values, after, np.nan, axis=0)


def _shown(chosen: LogEvaluation, reach: float) -> tuple[float, float, list[int]]:
    """Start and end of the drawn time, and the indices of non-overlapping windows in it."""
    starts = chosen.windows.start
    begin = max(starts[0], starts[len(starts) // 2] - SHOWN / 2)
    chain, free = [], begin - 1e-9
    for index, start in enumerate(starts):
        if start >= free and start + reach <= begin + SHOWN + 1e-9:
            chain.append(index)
            free = start + reach - 1e-9
    if not chain:
        chain = [len(starts) // 2]
    return starts[chain[0]] - 0.1, starts[chain[-1]] + reach + 0.1, chain


def _predicted(chosen: LogEvaluation, variant: str, quantity: str, chain: list[int]) -> np.ndarray | None:
    """Values at the window starts and horizons, (windows, 1 + H, 3); NaN where the variant is not available."""
    states = chosen.predictions[variant]
    if states is None:
        return None
    fields = {"position": "position", "velocity": "velocity", "attitude": "quaternion", "rate": "body_rate"}
    field = fields[quantity]
    start, later = getattr(chosen.windows, field), np.asarray(getattr(states, field))
    if variant == "rotor_speed_in":
        # These predictions exist only for windows with measured rotor speed.
        everywhere = np.full((len(chosen.windows), *later.shape[1:]), np.nan)
        everywhere[chosen.measured] = later
        later = everywhere
    values = np.concatenate([start[chain][:, None], later[chain]], axis=1)
    return euler_deg(values) if quantity == "attitude" else values


def _draw_component(axes, chosen: LogEvaluation, horizons: tuple[float, ...], quantity: str, column: int) -> None:
    name, unit = _TITLES[quantity]
    begin, end, chain = _shown(chosen, max(horizons))
    time, values = _measured(chosen, quantity)
    inside = (time >= begin) & (time <= end)
    time, values = time[inside], values[inside, column]
    axes.plot(time, values, color=style.MEASURED, linewidth=1.1, zorder=2)
    # hold is shown only in the error panels, because its straight lines would cover the rest.
    for variant in ("rotor_speed_in", "commands_in"):
        predicted = _predicted(chosen, variant, quantity, chain)
        if predicted is None:
            continue
        predicted = predicted[..., column]
        at = chosen.windows.start[chain][:, None] + np.concatenate([[0.0], horizons])
        known = np.isfinite(values)
        if quantity == "attitude":
            # Unwrap to the branch of the measurement; otherwise a yaw past 180 degrees looks like an error of 360.
            predicted = np.unwrap(predicted, period=360.0, axis=1)
            near = np.interp(at[:, 0], time[known], values[known])
            predicted = predicted + 360.0 * np.round((near - predicted[:, 0]) / 360.0)[:, None]
        colour = style.COLOURS[variant]
        # One line with breaks is drawn faster than one line per window.
        broken = np.full((len(chain), 1), np.nan)
        x, y = np.hstack([at, broken]), np.hstack([predicted, broken])
        axes.plot(x.ravel(), y.ravel(), color=colour, linewidth=1.3, alpha=0.9, zorder=3)
        axes.plot(
            at[:, 1:].ravel(), predicted[:, 1:].ravel(), style.MARKERS[variant], color=colour, markersize=2.8, zorder=4
        )
        axes.plot(
            at[:, 0], predicted[:, 0], "o", markersize=4.2, markerfacecolor="white", markeredgecolor="black", zorder=5
        )
    low, high = np.nanmin(values), np.nanmax(values)
    # A diverging prediction leaves the panel instead of flattening the measurement.
    margin = max(0.35 * (high - low), {"position": 0.05, "velocity": 0.2, "attitude": 3.0, "rate": 0.2}[quantity])
    axes.set_ylim(low - margin, high + margin)
    axes.set_xlim(begin, end)
    component = _COMPONENTS[quantity][column]
    axes.set_ylabel(f"{component}, {unit}" if quantity == "attitude" else f"{name} {component}, {unit}")


def _draw_error(axes, results: dict[str, tuple[dict, dict]], horizons: tuple[float, ...], quantity: str) -> None:
    unit = QUANTITIES[quantity]
    for order, (variant, (values, intervals)) in enumerate(results.items()):
        keys = [f"{quantity}_rmse_{unit}@{horizon:g}s" for horizon in horizons]
        rmse = np.array([values[key] for key in keys])
        low, high = np.array([intervals[key] for key in keys]).T
        # Offset in x, because equal errors would cover each other.
        x = np.asarray(horizons) * (1 + 0.03 * (order - 1))
        axes.errorbar(
            x,
            rmse,
            [np.maximum(rmse - low, 0), np.maximum(high - rmse, 0)],
            color=style.COLOURS[variant],
            marker=style.MARKERS[variant],
            markersize=4,
            linewidth=1.3,
            capsize=2,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(horizons, [f"{horizon:g}" for horizon in horizons])
    axes.xaxis.minorticks_off()
    name, label = _TITLES[quantity]
    axes.set_ylabel(f"{name} error, {label}")


def _legend(figure, variants: list[str]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=style.MEASURED, label="measured"),
        Line2D([], [], linestyle="", marker="o", markerfacecolor="white", color="black", label="prediction starts"),
    ]
    handles += [
        Line2D([], [], color=style.COLOURS[v], marker=style.MARKERS[v], markersize=4, label=style.LABELS[v])
        for v in variants
    ]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=9.5)
