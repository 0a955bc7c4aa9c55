"""Common style of all figures (colours that suit colour blindness and grey print), and saving without a display."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfb_mjx.files import FIGURES, VectorFormat, replacing, require_ending

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

_COPIES: ContextVar[tuple[VectorFormat, Path | None] | None] = ContextVar("copies", default=None)

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
    # Fixed ids, and text stored as text: equal results give equal, small SVG files.
    "svg.hashsalt": "cfb_mjx",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Arial", "Helvetica", "sans-serif"],
}


def context():
    """Context manager with the settings for drawing and saving a figure; restores the caller's settings."""
    import matplotlib

    return matplotlib.rc_context(_RC)


def new_figure(width: float, height: float):
    """An empty figure of ``width`` x ``height`` inches, without display or global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Callers set the margins, because matplotlib's constrained layout draws everything twice.
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def check_path(path: str | os.PathLike) -> Path:
    """The path, if its ending is a supported format of figures.

    Raises:
        CfbError: the ending is not supported.
    """
    return require_ending(path, FIGURES, f"a figure must end in {', '.join(FIGURES)}")


@contextmanager
def with_vector_copies(form: VectorFormat | None, folder: Path | None = None) -> Iterator[None]:
    """Inside the block, `save` also writes each figure as a vector graphic.

    Args:
        form: format of the copies; None writes none.
        folder: where to write the copies; None: beside the figure.
    """
    token = _COPIES.set(None if form is None else (form, folder))
    try:
        yield
    finally:
        _COPIES.reset(token)


def save(figure, path: Path) -> None:
    """Write the figure atomically, in the format of the path's ending, and its copy (`with_vector_copies`).

    Raises:
        CfbError: the folder is missing or the file cannot be written.
    """
    _write(figure, path)
    copies = _COPIES.get()
    if copies is not None:
        form, folder = copies
        copy = (path.parent if folder is None else folder) / f"{path.stem}.{form}"
        if copy != path:
            _write(figure, copy)


def _write(figure, path: Path) -> None:
    suffix = path.suffix.lower()
    # Without a date, equal figures give equal files.
    metadata = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(suffix)
    with replacing(path) as temporary:
        figure.savefig(temporary, format=suffix[1:], dpi=130, metadata=metadata)
