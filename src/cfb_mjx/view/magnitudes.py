"""Figure of hover error and command std over the magnitude of the randomisation, as in the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cfb_mjx.view.style import COLOURS, check_path, context, new_figure, save


def magnitudes_figure(
    found: Mapping[str, Mapping[float, Mapping[str, Sequence[float | None]]]],
    paper: Mapping[float, tuple[float, float]],
    path: str | Path,
) -> None:
    """Draw hover error and command std over magnitude: seeds as points, their mean as a line, the paper as crosses.

    Args:
        found: algorithm (one column each) to magnitude to one number per seed, None where a drone was lost:
            ``nominal`` and ``away`` (drones with effects), mm, and ``nominal_std`` and ``away_std``.
        paper: magnitude to hover error (mm) and command std of the paper's real drone.
        path: figure to write.
    """
    from matplotlib.ticker import FormatStrFormatter

    path = check_path(path)
    colours = {"nominal": COLOURS["hold"], "away": COLOURS["commands_in"]}
    labels = {"nominal": "nominal drone", "away": "off-nominal drones"}
    with context():
        plot = new_figure(4.2 * len(found), 4.8)
        axes = plot.subplots(2, len(found), squeeze=False, sharex=True, sharey="row")
        for column, (algorithm, of) in enumerate(found.items()):
            for row, (suffix, label) in enumerate((("", "mean distance, mm"), ("_std", "command std"))):
                axis = axes[row][column]
                for where, colour in colours.items():
                    means = []
                    for magnitude, scores in of.items():
                        values = [v for v in scores[where + suffix] if v is not None]
                        axis.plot([magnitude] * len(values), values, ".", color=colour)
                        means.append(sum(values) / len(values) if values else float("nan"))
                    axis.plot(list(of), means, color=colour, label=labels[where])
                axis.plot(
                    list(paper), [both[row] for both in paper.values()], "x:", color="black", label="paper, real drone"
                )
                if row == 0:
                    axis.set_yscale("log")
                    axis.yaxis.set_major_formatter(FormatStrFormatter("%g"))
                    axis.set_title(algorithm)
                else:
                    axis.set_xlabel("magnitude of the randomisation")
                if column == 0:
                    axis.set_ylabel(label)
        axes[1][0].set_ylim(bottom=0)
        axes[0][0].legend(frameon=False, fontsize=8, loc="upper right")
        plot.subplots_adjust(left=0.17 / len(found), right=0.98, bottom=0.1, top=0.93, wspace=0.12, hspace=0.12)
        save(plot, path)
