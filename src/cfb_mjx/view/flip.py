"""Figure of flips, as in the paper: the path in the YZ plane, roll angle, roll rate and vertical speed over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.control.manoeuvre import TURN, roll_angle, unwrapped
from cfb_mjx.view.style import MEASURED, check_path, context, new_figure, save

_SHOWN = 60
_BLUE, _RED, _GREEN, _GREY = "#0072B2", "#D55E00", "#009E73", "#e8e8e8"


def flip_figure(flown, dt: float, path: str | Path, title: str = "") -> None:
    """Draw flips.

    Args:
        flown: a `cfb_mjx.train.flying.Flight` from `cfb_mjx.train.flips.flips`, axes (drones, steps).
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
        above = None
        for i, (label, values) in enumerate(rows):
            axis = above = figure.add_subplot(grid[i, 1], sharex=above)
            axis.plot(time, values.T, color=_BLUE, linewidth=0.9, alpha=fade)
            axis.set_ylabel(label)
            axis.set_xlim(0, shown)
            inside = values[:, time <= shown]
            if np.isfinite(inside).any():
                axis.set_ylim(*_padded(np.nanmin(inside), np.nanmax(inside)))
            if count == 1:
                turning = time[np.asarray(flown.watched)[0] == TURN]
                axis.axvspan(turning[0] - dt, turning[-1], color=_GREY, linewidth=0)
            if i < 2:
                axis.tick_params(labelbottom=False)
            else:
                axis.set_xlabel("time, s")
        more = "" if count <= _SHOWN else f" ({_SHOWN} of {count} flights)"
        figure.suptitle(title + more, fontsize=10)
        figure.subplots_adjust(left=0.08, right=0.98, bottom=0.11, top=0.92, hspace=0.15, wspace=0.25)
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
