"""Figure of the spread of randomised drones that all receive the same commands."""

from __future__ import annotations

import os

import numpy as np

from cfb_mjx.view import style

BANDS = ((5.0, 95.0, "5 to 95 %", 0.22), (25.0, 75.0, "25 to 75 %", 0.42))


def spread_figure(
    time: np.ndarray,
    position: np.ndarray,
    tilt: np.ndarray,
    path: str | os.PathLike,
    *,
    reference: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    reference_label: str = "measured",
    title: str = "",
) -> None:
    """Draw quantile bands of position and tilt over many drones.

    Args:
        time: (T,) s.
        position: (N, T, 3) m.
        tilt: (N, T) angle between the body's and the world's z axis, deg.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``.
        reference: time (K,), position (K, 3) and tilt (K,) of one flight to compare with, in the same units.
        reference_label: legend label of that flight.
        title: title of the figure.

    Raises:
        CfbError: the ending of ``path`` is not supported, or the file cannot be written.
    """
    path = style.check_path(path)
    panels = [(f"position {axis}", "m", position[..., i]) for i, axis in enumerate(style.AXES)]
    panels.append(("tilt", "deg", tilt))
    with style.context():
        figure = style.new_figure(12.0, 3.7)
        plots = figure.subplots(1, 4, sharex=True)
        for index, (axes, (name, unit, values)) in enumerate(zip(plots, panels, strict=True)):
            for low, high, label, alpha in BANDS:
                lower, upper = np.percentile(values, [low, high], axis=0)
                axes.fill_between(
                    time, lower, upper, color=style.COLOURS["commands_in"], alpha=alpha, linewidth=0, label=label
                )
            axes.plot(time, np.median(values, axis=0), color=style.COLOURS["commands_in"], label="median")
            if reference is not None:
                at, measured_position, measured_tilt = reference
                measured = measured_tilt if index == 3 else measured_position[:, index]
                axes.plot(at, measured, color=style.MEASURED, linewidth=1.2, linestyle="--", label=reference_label)
            axes.set_ylabel(f"{name}, {unit}")
            axes.set_xlabel("time, s")
            axes.margins(x=0)
        figure.subplots_adjust(left=0.055, right=0.99, top=0.9, bottom=0.23, wspace=0.28)
        figure.legend(*plots[-1].get_legend_handles_labels(), loc="lower center", ncols=4)
        if title:
            figure.suptitle(title, fontsize=11, y=0.985)
        style.save(figure, path)


def tilt_deg(quaternion: np.ndarray) -> np.ndarray:
    """Angle between body z and world z, deg, from [w, x, y, z] quaternions (..., 4)."""
    _, x, y, _ = np.moveaxis(quaternion, -1, 0)
    # From the sine of the half angle, because arccos of the matrix entry is inaccurate near zero.
    return np.degrees(2 * np.arcsin(np.clip(np.hypot(x, y), 0.0, 1.0)))
