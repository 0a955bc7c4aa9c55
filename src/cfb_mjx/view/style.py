"""One look for all figures: colours that survive colour blindness and grey print, and headless saving."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfb_mjx.files import FIGURES, replacing, require_ending

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

MEASURED = "#222222"
# Okabe and Ito's palette.
COLOURS = {"commands_in": "#0072B2", "rotor_speed_in": "#D55E00", "hold": "#8C8C8C"}
MARKERS = {"commands_in": "o", "rotor_speed_in": "s", "hold": "^"}
LABELS = {
    "commands_in": "model, commands in",
    "rotor_speed_in": "model, rotor speed in",
    "hold": "hold (constant velocity and rate)",
}
AXES = "xyz"

_RC: dict[RcKeyType, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    # Fixed ids and text as text: the same results give the same small SVG.
    "svg.hashsalt": "cfb_mjx",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Arial", "Helvetica", "sans-serif"],
}


def context():
    """Settings for the drawing and saving of one figure; the caller's own stay untouched."""
    import matplotlib

    return matplotlib.rc_context(_RC)


def new_figure(width: float, height: float):
    """An empty figure of ``width`` x ``height`` inches that needs no display and leaves no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Callers give margins themselves: matplotlib's constrained layout would draw everything twice.
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def check_path(path: str | os.PathLike) -> Path:
    """The path, if its ending names a format figures are written in.

    Raises:
        CfbError: another ending.
    """
    return require_ending(path, FIGURES, f"a figure must end in {', '.join(FIGURES)}")


def save(figure, path: Path) -> None:
    """Write the figure atomically, in the format of the path's ending.

    Raises:
        CfbError: the folder is missing or the file cannot be written.
    """
    suffix = path.suffix.lower()
    # Without a date, equal figures are equal files.
    metadata = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(suffix)
    with replacing(path) as temporary:
        figure.savefig(temporary, format=suffix[1:], dpi=130, metadata=metadata)
