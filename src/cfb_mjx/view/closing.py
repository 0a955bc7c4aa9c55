"""Write the report of a model correction: an HTML page, and a rerun recording of the residuals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cfb_mjx.files import scratch, write_text
from cfb_mjx.logs import FlightLog
from cfb_mjx.sysid.tracing.diagnosis import Diagnosis
from cfb_mjx.view.closing_figures import draw
from cfb_mjx.view.closing_recording import write_recording
from cfb_mjx.view.closing_sections import sections
from cfb_mjx.view.closing_words import verdict
from cfb_mjx.view.page import html_page


def write_report(
    diagnosis: Diagnosis,
    folder: Path,
    facts: Mapping[str, object],
    logs_fit: list[FlightLog],
    logs_held_out: list[FlightLog],
) -> None:
    """Write ``report.html``, which is self-contained, and ``residual.rrd`` into a folder.

    Args:
        diagnosis: result of `cfb_mjx.sysid.tracing.closing.close_loop`.
        folder: an existing folder; each file in it is replaced atomically.
        facts: date, machine and versions, printed at the end.
        logs_fit: the fit flights, as read.
        logs_held_out: the held-out flights, as read.

    Raises:
        CfbError: a file cannot be written, or rerun is not installed.
    """
    folder = Path(folder)
    with scratch() as drawn:
        figures = draw(diagnosis, Path(drawn))
        found = sections(diagnosis, figures, logs_fit, logs_held_out)
        page = html_page(f"Model correction of {diagnosis.base.name}", verdict(diagnosis), found, facts)
    write_recording(folder / "residual.rrd", diagnosis.held_out.rows, diagnosis.before, diagnosis.after)
    write_text(folder / "report.html", page)
