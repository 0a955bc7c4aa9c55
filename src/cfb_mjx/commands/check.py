"""``cfb check``: what recordings contain, whether their signals agree, and what they can be used for."""

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
        recordings: one for each log: the flight and the agreement of its signals, or the reason why it was refused.
            ``recordings[0].report()`` is what ``--json`` writes about it.
        files: paths of the files written, by kind; None for a file that was not asked for.
    """

    recordings: tuple[Recording, ...]
    files: Mapping[str, Path | None]

    def __str__(self) -> str:
        return "\n".join([*(line for one in self.recordings for line in one.lines()), *lines_of(self.files)])

    @property
    def complaint(self) -> str | None:
        """How many recordings were refused; None if all were read."""
        refused = sum(one.refusal is not None for one in self.recordings)
        if not refused:
            return None
        return f"{refused} of {len(self.recordings)} recordings were refused; the reasons are listed above."


@command
class Check(ReadingOptions):
    """Report what recordings contain, whether their signals agree, what they are good for and what to log next time.

    Each recording is read on its own, as `cfb import` reads it. If one is refused, the others are still checked, and
    the exit status is 2.

    Attributes:
        logs: recordings in any format that `cfb import` reads.
        output: folder for a page with figures (index.html).
        json: JSON file for the results.
    """

    logs: Logs
    output: Folder = None
    json: File = None

    def run(self) -> Checked:
        """Check each recording on its own, and write the files that were asked for.

        Raises:
            CfbError: no logs, or files that cannot be written.
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
