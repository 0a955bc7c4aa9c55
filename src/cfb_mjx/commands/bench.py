"""``cfb bench``: throughput beside the peers, from one run on one machine."""

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
    """Speeds of this machine.

    Attributes:
        numbers: as ``--json`` writes them: ``numbers["rows"][0]["steps_per_s"]`` and the like.
    """

    numbers: Mapping[str, Any]

    def __str__(self) -> str:
        from cfb_mjx.bench.page import text

        return text(self.numbers)


@command
class Bench(Command):
    """Measure throughput: simulation steps per second of every body, compile time and memory.

    Attributes:
        drones: batch sizes; 1, 64, 1024, 8192 and 65536 if none are given.
        json: write the results here.
        markdown: write the results as a Markdown page here.
        peer_python: a Python that has crazyflow installed, to measure it side by side.
        quick: fewer rows and repetitions, for a first look.
        roofline: measure also what this machine can do at most, and how much of it the hot paths use.
    """

    drones: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N...")] = (1, 64, 1024, 8192, 65536)
    json: File = None
    markdown: File = None
    peer_python: File = None
    quick: bool = False
    roofline: bool = False

    def run(self) -> Measured:
        """Measure, and write what was asked for.

        Raises:
            CfbError: impossible batch sizes, no such peer, outputs that cannot be written.
        """
        if not self.drones or min(self.drones) < 1:
            raise CfbError("--drones must be whole numbers from 1.")
        require_folder(self.json, self.markdown)
        from cfb_mjx.runtime import configure_jax, cores

        # A CPU shows itself as one device per core, where the backend has not started yet.
        configure_jax(x64=False, devices=cores())
        from cfb_mjx.bench.benchmark import benchmark
        from cfb_mjx.bench.page import page

        numbers = benchmark(self.drones, self.peer_python, quick=self.quick, roofline=self.roofline)
        if self.json is not None:
            write_json(self.json, numbers)
        if self.markdown is not None:
            write_text(self.markdown, page(numbers, os.environ.get("XLA_FLAGS", "")))
        return Measured(numbers)
