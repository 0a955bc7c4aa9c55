"""A process that times one run of something for every line it is sent, so that its runs can alternate with others."""

from __future__ import annotations

import subprocess
from typing import IO

from cfb_mjx.optional import not_none


class TimedProcess:
    """The caller's end of such a process, whose standard input and output are pipes of text."""

    process: subprocess.Popen

    def seconds(self) -> float:
        """Wall time of one run there."""
        given, answers = self._pipes()
        given.write("\n")
        given.flush()
        return float(answers.readline())

    def close(self) -> None:
        """End it."""
        given, answers = self._pipes()
        given.close()
        self.process.wait()
        answers.close()
        if self.process.stderr is not None:
            self.process.stderr.close()

    def _pipes(self) -> tuple[IO[str], IO[str]]:
        return not_none(self.process.stdin), not_none(self.process.stdout)
