"""A process that times one run of a workload per request, so that its runs can alternate with those of others."""

from __future__ import annotations

import os
import subprocess
from typing import IO

from cfb_mjx.optional import not_none


def without_options() -> dict[str, str]:
    """The environment in which users of other programs run them: without the options of `configure_jax`."""
    return {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"} | {"TF_CPP_MIN_LOG_LEVEL": "3"}


class TimedProcess:
    """Handle of such a process; its standard input and output are text pipes."""

    process: subprocess.Popen

    def seconds(self) -> float:
        """Run it once and return the wall time."""
        given, answers = self._pipes()
        given.write("\n")
        given.flush()
        return float(answers.readline())

    def close(self) -> None:
        """End the process."""
        given, answers = self._pipes()
        given.close()
        self.process.wait()
        answers.close()
        if self.process.stderr is not None:
            self.process.stderr.close()

    def _pipes(self) -> tuple[IO[str], IO[str]]:
        return not_none(self.process.stdin), not_none(self.process.stdout)
