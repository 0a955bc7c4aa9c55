"""``cfb check``: what recordings hold, what their signals say about each other, what they are good for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cfb_mjx.commands.command import File, Folder, Logs, Result, command, lines_of
from cfb_mjx.commands.import_log import ReadingOptions
from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, require_folder, together, write_json

if TYPE_CHECKING:
    from cfb_mjx.logs.uses import Recording


@dataclass(frozen=True)
class Checked(Result):
    """Recordings that were checked.

    Attributes:
        recordings: one for each log: the flight, what its signals say about each other, or why it was refused.
            ``recordings[0].report()`` is what ``--json`` writes of it.
        files: what was written, by what it is.
    """

    recordings: tuple[Recording, ...]
    files: Mapping[str, Path | None]

    def __str__(self) -> str:
        return "\n".join([*(line for one in self.recordings for line in one.lines()), *lines_of(self.files)])

    @property
    def complaint(self) -> str | None:
        """That recordings were refused; None where all were read."""
        refused = sum(one.refusal is not None for one in self.recordings)
        if not refused:
            return None
        return f"{refused} of {len(self.recordings)} recordings were refused, for the reasons above."


@command
class Check(ReadingOptions):
    """Say what recordings hold, whether their signals agree, what they are good for and what to log next time.

    Every recording is read as by import, by itself; one that is refused stops none of the others.

    Attributes:
        logs: recordings of any format.
        output: folder for a page with figures (index.html).
        json: write the results here.
    """

    logs: Logs
    output: Folder = None
    json: File = None

    def run(self) -> Checked:
        """Check every recording by itself, and write what was asked for.

        Raises:
            CfbError: no logs, or outputs that cannot be written.
        """
        if not self.logs:
            raise CfbError("check needs at least one log; see 'cfb check --help'.")
        from cfb_mjx.logs.uses import Recording

        require_folder(self.json)
        if self.output is not None:
            output_folder(self.output)
        recordings = tuple(Recording.read(path, **self.reading()) for path in self.logs)
        page = None if self.output is None else self.output / "index.html"
        with together():
            if self.json is not None:
                from cfb_mjx.runtime import environment

                reports = {str(one.path): one.report() for one in recordings}
                write_json(self.json, {"logs": reports, "environment": environment()})
            if page is not None:
                from cfb_mjx.view.checked import checked_page

                checked_page(recordings, page)
        return Checked(recordings, {"page": page, "results": self.json})
