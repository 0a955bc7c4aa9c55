"""``cfb bench``: speed of the library beside other simulators, measured in one run on one machine."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from cfb_mjx.commands.command import Command, File, Result, command
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, write_json, write_text


@dataclass(frozen=True)
class Measured(Result):
    """Speeds measured on this machine.

    Attributes:
        numbers: the results as ``--json`` writes them, for instance ``numbers["rows"][0]["steps_per_s"]``.
    """

    numbers: Mapping[str, Any]

    def __str__(self) -> str:
        from cfb_mjx.bench.page import text

        return text(self.numbers)


@command
class Bench(Command):
    """Measure simulation speed: steps per second with every body, compile time and memory.

    Prints a table. --json and --markdown also write the results to files.

    Attributes:
        drones: batch sizes, at least 1 each. Default: 1 64 1024 8192 65536.
        json: JSON file for the results.
        markdown: Markdown file for the results.
        peer_python: Python interpreter in whose environment crazyflow is installed; it is then measured too, and l2f if
            that is installed there, MuJoCo's C alone, and Brax's own PPO.
        quick: measure fewer cases with fewer repetitions, for a quick look.
        roofline: also measure the peak speed of this machine, and what share of it the main computations reach.
    """

    drones: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N...")] = (1, 64, 1024, 8192, 65536)
    json: File = None
    markdown: File = None
    peer_python: File = None
    quick: bool = False
    roofline: bool = False

    def run(self) -> Measured:
        """Measure, and write the files that were asked for.

        Raises:
            CfbError: invalid batch sizes, a Python without crazyflow, or files that cannot be written.
        """
        if not self.drones or min(self.drones) < 1:
            raise CfbError("--drones: every batch size must be a whole number, at least 1.")
        require_folder(self.json, self.markdown)
        from cfb_mjx.runtime import configure_jax, cores

        # Makes a CPU count as one device per core, if the backend of jax has not started yet.
        configure_jax(x64=False, devices=cores())
        from cfb_mjx.bench.benchmark import benchmark
        from cfb_mjx.bench.page import page

        numbers = benchmark(self.drones, self.peer_python, quick=self.quick, roofline=self.roofline)
        if self.json is not None:
            write_json(self.json, numbers)
        if self.markdown is not None:
            write_text(self.markdown, page(numbers, os.environ.get("XLA_FLAGS", "")))
        return Measured(numbers)
