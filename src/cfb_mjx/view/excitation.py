"""Figure of a simulated excitation manoeuvre: commands, tilt, body rate and height of all its repetitions."""

from __future__ import annotations

import os

import numpy as np

from cfb_mjx.sysid.excitation.experiment import TICK, Experiment
from cfb_mjx.view import style
from cfb_mjx.view.spread import tilt_deg

MOTORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
SHOWN = (0.3, 2.0)
"""Seconds drawn before the manoeuvre and after its end."""


def excitation_figure(
    calm: Experiment, flown: Experiment, path: str | os.PathLike, limits: dict[str, float], title: str = ""
) -> None:
    """Draw the undisturbed manoeuvre (black) over the simulated repetitions (colour).

    Args:
        calm: one repetition without noise or disturbance.
        flown: the simulated flight with all repetitions.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``.
        limits: values of the dashed lines: ``tilt`` deg, ``rate`` rad/s, ``height`` m below the start.
        title: title of the figure.

    Raises:
        CfbError: the ending of ``path`` is not supported, or the file cannot be written.
    """
    path = style.check_path(path)
    with style.context():
        figure = style.new_figure(12.0, 3.7)
        commands, *others = figure.subplots(1, 4)
        time, rows = _window(calm, calm.starts[0])
        for motor, colour in enumerate(MOTORS):
            commands.step(
                time, calm.command[rows, motor], where="post", color=colour, linewidth=1.0, label=f"M{motor + 1}"
            )
        commands.set_ylabel("command")
        commands.set_xlim(-0.1, calm.length * TICK + 0.2)
        commands.legend(loc="upper right", ncols=2, fontsize=7.5)
        for axes, (name, unit) in zip(others, (("tilt", "deg"), ("body rate", "rad/s"), ("height", "m")), strict=True):
            for index, start in enumerate(flown.starts):
                time, rows = _window(flown, start)
                label = "repetitions, with noise and disturbances" if index == 0 else None
                values = _value(flown, name, start)[rows]
                axes.plot(time, values, color=style.COLOURS["commands_in"], linewidth=0.9, alpha=0.6, label=label)
            time, rows = _window(calm, calm.starts[0])
            values = _value(calm, name, calm.starts[0])[rows]
            axes.plot(time, values, color=style.MEASURED, linewidth=1.4, label="undisturbed")
            bound = {"tilt": limits["tilt"], "body rate": limits["rate"], "height": -limits["height"]}[name]
            axes.axhline(bound, color=style.COLOURS["hold"], linestyle="--", linewidth=1.0, label="limit")
            axes.set_ylabel(f"{name}{' from the start' * (name == 'height')}, {unit}")
        for axes in (commands, *others):
            axes.axvspan(0.0, calm.length * TICK, color="#f0f0f0", zorder=0, linewidth=0)
            axes.set_xlabel("time since the start of the manoeuvre, s", fontsize=8)
            axes.margins(x=0)
        figure.subplots_adjust(left=0.05, right=0.99, top=0.9, bottom=0.24, wspace=0.28)
        figure.legend(*others[0].get_legend_handles_labels(), loc="lower center", ncols=3)
        if title:
            figure.suptitle(title, fontsize=11, y=0.985)
        style.save(figure, path)


def _window(experiment: Experiment, start: int) -> tuple[np.ndarray, slice]:
    """Times since tick ``start``, and the slice of ticks to draw."""
    before, after = (round(t / TICK) for t in SHOWN)
    rows = slice(max(start - before, 0), min(start + experiment.length + after, len(experiment.time)))
    return experiment.time[rows] - experiment.time[start], rows


def _value(experiment: Experiment, name: str, start: int) -> np.ndarray:
    state = experiment.state
    if name == "tilt":
        return tilt_deg(np.asarray(state.quaternion))
    if name == "body rate":
        return np.linalg.norm(state.body_rate, axis=1)
    height = np.asarray(state.position[:, 2])
    return height - height[start]
