"""Figure and page of `cfb check`: measured changes of signals, and the integrals that should equal them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cfb_mjx.files import scratch, write_text
from cfb_mjx.logs.consistency import Comparison, Relation, comparisons
from cfb_mjx.logs.gate import Verdict
from cfb_mjx.logs.uses import Recording
from cfb_mjx.runtime import environment
from cfb_mjx.view import style
from cfb_mjx.view.page import Section, html_page

_HEADER = ("comparison", "slope", "lag, ms", "correlation", "unexplained", "verdict")
_WORDS = {
    "displacement": ("change of position", "integrated velocity", "m"),
    "attitude": ("change of attitude", "integrated gyro", "rad"),
    "velocity": ("change of velocity", "integrated accelerometer", "m/s"),
}


def checked_figure(
    compared: Mapping[str, Comparison], relations: Sequence[Relation], path: str | os.PathLike, title: str = ""
) -> None:
    """Draw the comparisons of `cfb check`: one row per comparison, one column per axis.

    Args:
        compared: the comparisons ``displacement``, ``attitude`` and ``velocity``.
        relations: their results; panels of contradicting signals are marked.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``.
        title: title of the figure.

    Raises:
        CfbError: the ending of ``path`` is not supported, or the file cannot be written.
    """
    path = style.check_path(path)
    found = {(r.name, r.axis): r for r in relations}
    with style.context():
        figure = style.new_figure(11.0, 1.0 + 1.9 * len(compared))
        panels = figure.subplots(len(compared), 3, squeeze=False, sharex=True)
        for row, (name, c) in zip(panels, compared.items(), strict=True):
            measured, integrated, unit = _WORDS[name]
            for axis, panel in enumerate(row):
                # Break the line at gaps of the log, which show as larger steps between windows.
                gap = np.concatenate([[False], np.diff(c.time) > 3 * np.median(np.diff(c.time))])
                for values, label, colour, width in (
                    (c.measured, measured, style.MEASURED, 1.2),
                    (c.integrated, integrated, style.COLOURS["commands_in"], 0.9),
                ):
                    panel.plot(
                        c.time, np.where(gap, np.nan, values[:, axis]), color=colour, linewidth=width, label=label
                    )
                said = found.get((name, "xyz"[axis]))
                panel.set_title(
                    "xyz"[axis] + (f": contradicts, slope {said.slope:.2f}" if said and said.contradicts else ""),
                    fontsize=9,
                    loc="right",
                    color=style.COLOURS["rotor_speed_in"] if said and said.contradicts else "black",
                )
            row[0].set_ylabel(f"{unit} in {c.width:.2g} s")
            row[0].legend(fontsize=7, loc="lower left", bbox_to_anchor=(0.0, 0.98), ncols=2, borderaxespad=0)
        for panel in panels[-1]:
            panel.set_xlabel("s")
        height = figure.get_figheight()
        top = 1 - (0.65 if title else 0.35) / height
        figure.subplots_adjust(left=0.07, right=0.99, top=top, bottom=0.5 / height, wspace=0.18, hspace=0.3)
        if title:
            figure.suptitle(title, fontsize=11)
        style.save(figure, path)


def checked_page(recordings: Sequence[Recording], path: str | os.PathLike) -> None:
    """Write a page with a summary of each recording, and its comparisons as a table and a figure.

    Args:
        recordings: the recordings, including refused ones.
        path: file to write, ``.html``.

    Raises:
        CfbError: the file cannot be written.
    """
    refused = sum(one.refusal is not None for one in recordings)
    lead = (
        f"{len(recordings)} recordings, {refused} refused. Each signal is compared with the integral of its derivative "
        "over short windows."
    )
    with scratch() as folder:
        sections = [_section(one, Path(folder) / f"{number}.png") for number, one in enumerate(recordings)]
        write_text(path, html_page("Recordings, checked", lead, sections, environment()))


def _section(one: Recording, figure: Path) -> Section:
    said, tables, figures = [line.strip() for line in one.lines()], [], []
    if one.log is not None and one.verdict is not None:
        if compared := comparisons(one.log):
            checked_figure(compared, one.verdict.relations, figure)
            figures = [(figure, f"measured and integrated signals of {one.path.name}")]
        caption = "Comparisons of signals; two signals contradict each other if 0.2 or more is unexplained."
        tables = [(caption, _HEADER, _rows(one.verdict))]
    return Section(one.path.name, said, tables, figures)


def _rows(verdict: Verdict) -> list[list[str]]:
    """Rows of the table: one per comparison, and the motors."""
    rows = [
        [
            f"{r.name} {r.axis}".strip(),
            f"{r.slope:.3f}",
            f"{r.lag * 1e3:.0f}",
            f"{r.correlation:.3f}",
            f"{r.unexplained:.3f}",
            "contradicts" if r.contradicts else "agrees" if r.moves else "too little motion to compare",
        ]
        for r in verdict.relations
    ]
    for source, value in verdict.agreement.items():
        said = "agrees" if value > 0.6 else "weak"
        rows.append([f"motors by {source.replace('_', ' ')}", "", "", f"{value:.3f}", "", said])
    return rows
