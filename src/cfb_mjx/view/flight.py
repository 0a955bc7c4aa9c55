"""Figure of the flights of a controller: position, speed and commands over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.view.style import check_path, context, new_figure, save

_SHOWN = 60
"""Largest number of flights in the figure; more lines would cover each other."""


def flight_figure(flown, dt: float, path: str | Path, title: str = "") -> None:
    """Draw flights over time.

    Args:
        flown: a `cfb_mjx.train.flying.Flight` with axes (drones, steps).
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
