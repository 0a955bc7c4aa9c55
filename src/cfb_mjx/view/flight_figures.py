"""Figures of the flights of a controller: position, speed and commands over time.

Flips have a figure of their own, as in the paper: path in the YZ plane, roll angle, roll rate and vertical speed; so do
flights along a path, and landings.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cfb_mjx.control.manoeuvre import TURN, roll_angle, unwrapped
from cfb_mjx.view.style import MEASURED, check_path, context, new_figure, save

_SHOWN = 60
"""Largest number of flights in the figure; more lines would cover each other."""


def flight_figure(flown, dt: float, path: str | Path, title: str = "") -> None:
    """Draw flights over time.

    Args:
        flown: a `cfb_mjx.train.flight.Flight` with axes (drones, steps).
        dt: time between two commands, s.
        path: figure to write.
        title: title of the figure.
    """
    path = check_path(path)
    rows = [
        ("position - target, m", np.asarray(flown.position), "xyz"),
        ("speed, m/s", np.linalg.norm(flown.velocity, axis=-1)[..., None], ("",)),
        ("command", np.asarray(flown.command), ("M1", "M2", "M3", "M4")),
    ]
    count, steps = rows[0][1].shape[:2]
    time = dt * (1 + np.arange(steps))
    colours = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
    with context():
        figure = new_figure(6.4, 6.0)
        panels = figure.subplots(3, 1, sharex=True)
        for axis, (label, values, names) in zip(panels, rows, strict=True):
            for i, name in enumerate(names):
                lines = axis.plot(
                    time, values[:_SHOWN, :, i].T, color=colours[i], linewidth=0.9, alpha=1.0 if count == 1 else 0.35
                )
                lines[0].set_label(name or None)
            axis.set_ylabel(label)
            if names[0]:
                axis.legend(loc="upper right", ncols=len(names))
        panels[-1].set_xlabel("time, s")
        shown = "" if count <= _SHOWN else f" ({_SHOWN} of {count} flights)"
        figure.suptitle(title + shown, fontsize=10)
        figure.subplots_adjust(left=0.11, right=0.98, bottom=0.08, top=0.94, hspace=0.12)
        save(figure, path)


def track_figure(flown, dt: float, path: str | Path, title: str = "") -> None:
    """Draw the tracking of a path: from above, and its errors and commands over time.

    Args:
        flown: a `cfb_mjx.train.flight.Flight` from `cfb_mjx.train.tracking.track`, axes (drones, steps).
        dt: time between two commands, s.
        path: figure to write.
        title: title of the figure.
    """

    def above(axes, position, target, fade) -> None:
        for i, way in enumerate(position):
            axes.plot(way[:, 0], way[:, 1], color=_BLUE, linewidth=0.8, alpha=fade, label=None if i else "flown")
        axes.plot(target[0, :, 0], target[0, :, 1], color=_RED, linewidth=0.9, linestyle="--", label="path")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="x, m", ylabel="y, m")

    def rows(position, target, velocity):
        return (
            ("error, mm", 1e3 * np.linalg.norm(position - target, axis=-1)),
            ("speed, m/s", np.linalg.norm(velocity, axis=-1)),
        )

    _beside_target(flown, dt, path, title, above, rows)


def land_figure(flown, dt: float, path: str | Path, title: str = "") -> None:
    """Draw landings: from the side, and height, vertical speed and command over time.

    Args:
        flown: a `cfb_mjx.train.flight.Flight` from `cfb_mjx.train.landing.land`, axes (drones, steps).
        dt: time between two commands, s.
        path: figure to write.
        title: title of the figure.
    """

    def side(axes, position, target, fade) -> None:
        for ways, label, colour, style in ((position, "flown", _BLUE, "-"), (target, "target", _RED, "--")):
            away = np.linalg.norm(ways[..., :2], axis=-1)
            axes.plot(away.T, ways[..., 2].T, colour, linestyle=style, linewidth=0.8, alpha=fade)[0].set_label(label)
        axes.axhline(0.0, color=MEASURED, linewidth=0.8)
        axes.set(xlabel="horizontal distance from the pad, m", ylabel="height, m")

    def rows(position, target, velocity):
        return ("height, m", position[..., 2]), ("vertical speed, m/s", velocity[..., 2])

    _beside_target(flown, dt, path, title, side, rows)


def _beside_target(flown, dt: float, path: str | Path, title: str, draw: Callable, rows: Callable) -> None:
    """Draw flights and their targets in a plane, and values over time beside it, the first motor's command last.

    Args:
        flown: flights, axes (drones, steps), with ``watched`` the target.
        dt: time between two commands, s.
        path: figure to write.
        title: title of the figure.
        draw: function of axes, positions, targets and opacity that draws the plane.
        rows: function of positions, targets and velocities that returns labels and values (flights, steps).
    """
    path = check_path(path)
    numbers = (flown.position, flown.watched, flown.velocity, flown.command)
    position, target, velocity, command = (np.asarray(x)[:_SHOWN] for x in numbers)
    time, count = dt * (1 + np.arange(position.shape[1])), len(flown.position)
    fade = 1.0 if count == 1 else 0.3
    with context():
        figure = new_figure(8.4, 4.2)
        grid = figure.add_gridspec(3, 2, width_ratios=(1.15, 1))
        plane = figure.add_subplot(grid[:, 0])
        draw(plane, position, target, fade)
        plane.legend(loc="best")
        panels = (*rows(position, target, velocity), ("command, M1", command[..., 0]))
        _over_time(figure, grid, time, panels, time[-1], fade)
        _finish(figure, title, count)
        save(figure, path)


def _over_time(figure, grid, time: np.ndarray, rows, until: float, fade: float) -> list:
    """Draw values over time below each other, to the right of what a figure shows in a plane; return the axes.

    Args:
        figure: the figure.
        grid: its grid of two columns.
        time: times, s.
        rows: label and values (flights, steps) of each panel.
        until: end of the time that is shown, s.
        fade: opacity of the lines.
    """
    axes = []
    for i, (label, values) in enumerate(rows):
        axis = figure.add_subplot(grid[i, 1], sharex=axes[0] if axes else None)
        axis.plot(time, values.T, color=_BLUE, linewidth=0.9, alpha=fade)
        axis.set_ylabel(label)
        axis.set_xlim(0, until)
        inside = values[:, time <= until]
        if np.isfinite(inside).any():
            axis.set_ylim(*_padded(np.nanmin(inside), np.nanmax(inside)))
        axis.tick_params(labelbottom=i + 1 == len(rows))
        axes.append(axis)
    axes[-1].set_xlabel("time, s")
    return axes


def _finish(figure, title: str, count: int) -> None:
    more = "" if count <= _SHOWN else f" ({_SHOWN} of {count} flights)"
    figure.suptitle(title + more, fontsize=10)
    figure.subplots_adjust(left=0.08, right=0.98, bottom=0.11, top=0.92, hspace=0.15, wspace=0.25)


_BLUE, _RED, _GREEN, _GREY = "#0072B2", "#D55E00", "#009E73", "#e8e8e8"


def flip_figure(flown, dt: float, path: str | Path, title: str = "") -> None:
    """Draw flips.

    Args:
        flown: a `cfb_mjx.train.flight.Flight` from `cfb_mjx.train.flips.flips`, axes (drones, steps).
        dt: time between two commands, s.
        path: figure to write.
        title: title of the figure.
    """
    path = check_path(path)
    position, velocity, rate = (np.asarray(x)[:_SHOWN] for x in (flown.position, flown.velocity, flown.body_rate))
    roll = np.degrees(np.asarray(unwrapped(roll_angle(flown.quaternion[:_SHOWN]))))
    time, count = dt * (1 + np.arange(position.shape[1])), len(flown.position)
    shown, fade = _watched(flown, dt), 1.0 if count == 1 else 0.3
    with context():
        figure = new_figure(8.4, 4.6)
        grid = figure.add_gridspec(3, 2, width_ratios=(1, 1.25))
        plane = figure.add_subplot(grid[:, 0])
        draw_path(plane, flown, dt, fade)
        plane.set_aspect("equal", adjustable="datalim")
        plane.set_ylabel("z, m")
        if count == 1:
            plane.legend(loc="best")
        rows = (
            ("roll, deg", roll),
            ("roll rate, deg/s", np.degrees(rate[..., 0])),
            ("vertical speed, m/s", velocity[..., 2]),
        )
        panels = _over_time(figure, grid, time, rows, shown, fade)
        if count == 1:
            turning = time[np.asarray(flown.watched)[0] == TURN]
            for axis in panels:
                axis.axvspan(turning[0] - dt, turning[-1], color=_GREY, linewidth=0)
        _finish(figure, title, count)
        save(figure, path)


def draw_path(axis, flown, dt: float, alpha: float = 1.0) -> None:
    """Draw the paths of flips in the YZ plane; for a single flight also the drone, as a bar."""
    position, until = np.asarray(flown.position)[:_SHOWN], round(_watched(flown, dt) / dt)
    way = position[:, :until]
    if len(way) == 1:
        phase = np.asarray(flown.watched)[0, :until]
        for which, colour in enumerate((_GREEN, _RED, _BLUE)):
            there = np.flatnonzero(phase == which)
            if len(there):
                piece = way[0, max(0, there[0] - 1) : there[-1] + 1]
                axis.plot(piece[:, 1], piece[:, 2], color=colour, label=("climb", "turn", "catch")[which])
        angle = np.asarray(unwrapped(roll_angle(flown.quaternion[:1, :until])))[0]
        for i in _apart(way[0, :, 1:], angle):
            y, z = way[0, i, 1:]
            across = 0.05 * np.array([np.cos(angle[i]), np.sin(angle[i])])
            up = 0.04 * np.array([-np.sin(angle[i]), np.cos(angle[i])])
            axis.plot([y - across[0], y + across[0]], [z - across[1], z + across[1]], color=MEASURED, linewidth=0.8)
            axis.plot([y, y + up[0]], [z, z + up[1]], color=MEASURED, linewidth=0.5)
    else:
        for one in way:
            axis.plot(one[:, 1], one[:, 2], color=_BLUE, linewidth=0.8, alpha=alpha)
    axis.set_xlabel("y, m")


def _apart(way: np.ndarray, angle: np.ndarray) -> list[int]:
    """Rows at which the drone is drawn: 8 cm or an eighth of a turn from the last one."""
    kept = [0]
    for i in range(1, len(way)):
        moved, turned = np.linalg.norm(way[i] - way[kept[-1]]), abs(angle[i] - angle[kept[-1]])
        if moved > 0.08 or turned > np.pi / 4:
            kept.append(i)
    return kept


def _watched(flown, dt: float) -> float:
    """End of the shown time, s: 1.5 s after the last flight has ended its turn."""
    before = (np.asarray(flown.watched) <= TURN).sum(axis=-1).max() * dt
    return min(before + 1.5, dt * flown.position.shape[-2])


def _padded(low: float, high: float) -> tuple[float, float]:
    margin = 0.06 * max(high - low, 1e-3)
    return low - margin, high + margin
