"""A process that times one run of something for every line it is sent, so that its runs can alternate with others."""

from __future__ import annotations

import subprocess


class TimedProcess:
    """The caller's end of such a process, whose standard input and output are pipes of text."""

    process: subprocess.Popen

    def seconds(self) -> float:
        """Wall time of one run there."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())

    def close(self) -> None:
        """End it."""
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()
        if self.process.stderr is not None:
            self.process.stderr.close()
