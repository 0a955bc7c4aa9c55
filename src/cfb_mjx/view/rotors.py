"""Figure of rotor fits: simulated and measured speed, and thrust and torque curves with their bench points."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.sysid.rotors.motors import Replay
from cfb_mjx.sysid.rotors.rotor_maps import MapFit
from cfb_mjx.view import style

_MARKS = "os^Dv"
_UNITS = {"thrust": ("mN", 1e3), "torque": ("mN m", 1e3)}


def rotor_figure(
    replays: Sequence[Replay], maps: Mapping[str, MapFit], path: str | os.PathLike, title: str = ""
) -> None:
    """Draw the fits of `cfb fit-rotors`, each with its residuals below.

    Args:
        replays: simulated and measured rotor speeds, one column each.
        maps: fits of ``thrust`` and ``torque``, one column each.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``.
        title: title of the figure.

    Raises:
        CfbError: there is no fit to draw, the ending of ``path`` is not supported, or the file cannot be written.
    """
    path = style.check_path(path)
    count = len(replays) + len(maps)
    if not count:
        raise CfbError(f"{path}: there is no fit to draw.")
    with style.context():
        figure = style.new_figure(max(4.1 * count, 6.0), 5.2)
        panels = figure.subplots(2, count, squeeze=False, sharex="col", height_ratios=(2.2, 1.0))
        columns = iter(panels.T)
        for item in replays:
            top, bottom = next(columns)
            _draw_replay(top, bottom, item)
        for name, fitted in maps.items():
            top, bottom = next(columns)
            _draw_map(top, bottom, name, fitted)
        inches = figure.get_figwidth()
        figure.subplots_adjust(
            left=0.75 / inches, right=1 - 0.12 / inches, top=0.88, bottom=0.1, wspace=0.27, hspace=0.1
        )
        figure.align_ylabels()
        if title:
            figure.suptitle(title, fontsize=11, y=0.985)
        style.save(figure, path)


def _draw_replay(top, bottom, item: Replay) -> None:
    top.plot(item.time, item.measured, color=style.MEASURED, linewidth=1.1, label="measured")
    top.plot(item.time, item.simulated, color=style.COLOURS["commands_in"], linewidth=1.2, label="from commands alone")
    name = f"motor M{item.motor}" if item.motor else "motor"
    top.set_title(f"{name}: {item.rms:.3g} rad/s rms error")
    top.set_ylabel("rotor speed, rad/s")
    top.legend(loc="best", fontsize=8)
    bottom.plot(item.time, item.measured - item.simulated, color=style.MEASURED, linewidth=0.9)
    bottom.axhline(0, color=style.COLOURS["hold"], linewidth=0.8)
    bottom.set_ylabel("residual, rad/s")
    bottom.set_xlabel("time, s")
    top.margins(x=0)


def _draw_map(top, bottom, name: str, fitted: MapFit) -> None:
    unit, factor = _UNITS[name]
    grid = np.linspace(0, fitted.shape.top, 300)
    curve, spread = factor * fitted.curve(grid), 2 * factor * fitted.curve_std(grid)
    colour = style.COLOURS["commands_in"]
    top.fill_between(grid, curve - spread, curve + spread, color=colour, alpha=0.22, linewidth=0)
    low, high = fitted.shape.measured
    inside = (grid >= low) & (grid <= high)
    top.plot(grid, curve, color=colour, linewidth=1.0, linestyle=":")
    top.plot(grid[inside], curve[inside], color=colour, linewidth=1.4, label="cubic, 95 % band")
    for mark, number in zip(_MARKS, sorted(set(fitted.motor.tolist())), strict=False):
        of = fitted.motor == number
        look = {"color": style.MEASURED, "linestyle": "", "marker": mark, "markersize": 3.2, "markerfacecolor": "none"}
        top.plot(
            fitted.rotor_speed[of], factor * fitted.value[of], label=f"M{number}" if number else "measured", **look
        )
        bottom.plot(fitted.rotor_speed[of], factor * fitted.residual[of], **look)
    off = fitted.outliers
    if len(off):
        bottom.plot(
            fitted.rotor_speed[off],
            factor * fitted.residual[off],
            "x",
            color=style.COLOURS["rotor_speed_in"],
            markersize=7,
        )
    bottom.axhline(0, color=style.COLOURS["hold"], linewidth=0.8)
    top.set_title(name)
    top.set_ylabel(f"{name}, {unit}")
    top.legend(loc="upper left", fontsize=8)
    bottom.set_ylabel(f"residual, {unit}")
    bottom.set_xlabel("rotor speed, rad/s")
