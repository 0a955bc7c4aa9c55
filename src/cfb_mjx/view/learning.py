"""Learning curve of a training, as a figure and as TensorBoard events."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from pathlib import Path

from cfb_mjx.view.style import COLOURS, check_path, context, new_figure, save

_PANELS = (
    ("hover_mm", "mean hover error, mm", True),
    ("track_mm", "mean error on a figure eight, mm", True),
    ("command_std", "command std", False),
    ("rate_error_radps", "rate error, rad/s", True),
    ("axis_error", "axis error", False),
    ("loss", "loss", False),
)


def learning_figure(rows: list[dict[str, float]], path: str | Path, title: str = "") -> None:
    """Draw the scores of test flights and the loss over the number of commands flown.

    Args:
        rows: rows of the learning curve, from `cfb_mjx.train.run.train`.
        path: figure to write.
        title: title of the figure; the training time is added to it.
    """
    panels = [panel for panel in _PANELS if panel[0] in rows[0]]
    with context():
        from matplotlib.ticker import FormatStrFormatter

        figure = new_figure(3.1 * len(panels), 2.8)
        axes = figure.subplots(1, len(panels), squeeze=False)[0]
        millions = [row["commands"] / 1e6 for row in rows]
        for axis, (key, label, logarithmic) in zip(axes, panels, strict=True):
            axis.plot(millions, [row[key] for row in rows], marker=".", color=COLOURS["commands_in"])
            axis.set_xlabel("commands flown, millions")
            axis.set_ylabel(label)
            if logarithmic:
                axis.set_yscale("log")
                for which in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
                    which(FormatStrFormatter("%g"))
        figure.suptitle(f"{title}: {rows[-1]['seconds']:.0f} s of training" if title else "", fontsize=10)
        figure.subplots_adjust(left=0.26 / len(panels), right=0.98, bottom=0.18, top=0.86, wspace=0.38)
        save(figure, check_path(path))


@contextmanager
def learning_events(folder: Path | None) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """Context manager that gives a function to log numbers over commands flown for TensorBoard.

    Args:
        folder: folder of the events; with None, the function writes nothing.
    """
    if folder is None:
        yield lambda commands, numbers: None
        return
    from tensorboardX import SummaryWriter

    with SummaryWriter(str(folder)) as writer:

        def log(commands: int, numbers: Mapping[str, float]) -> None:
            for name, number in numbers.items():
                # If most drones are lost, their median error is infinite and cannot be drawn.
                if isfinite(number):
                    writer.add_scalar(name, number, commands)

        yield log
