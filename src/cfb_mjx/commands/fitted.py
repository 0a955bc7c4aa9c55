"""Shared by the commands that read logs and fit models: drones that flew together, held-out logs, provenance."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from cfb_mjx import __version__
from cfb_mjx.errors import CfbError

if TYPE_CHECKING:
    from cfb_mjx.logs import FlightLog


def read_together(paths: Sequence[Path], others: Sequence[Path]) -> list[FlightLog]:
    """Read logs, each with that of another drone that flew at the same time.

    Args:
        paths: the logs.
        others: logs of the other drone, one for each of ``paths`` in the same order; empty if the drone flew alone.

    Raises:
        CfbError: a bad log, other numbers of logs, or logs that do not overlap in time.
    """
    from cfb_mjx.logs import read_log, with_other

    if others and len(others) != len(paths):
        raise CfbError(
            f"--with: {len(others)} logs of another drone for {len(paths)} logs; give one for each, in the same order."
        )
    logs = [read_log(path) for path in paths]
    return [with_other(log, read_log(other)) for log, other in zip(logs, others, strict=True)] if others else logs


def require_apart(fit: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Check that no log is both fitted and held out.

    Raises:
        CfbError: a file is in both lists.
    """
    both = {path.resolve() for path in fit} & {path.resolve() for path in held_out}
    if both:
        names = ", ".join(sorted(path.name for path in both))
        raise CfbError(
            f"{names}: given both to fit and as --held-out; a model must not be evaluated on flights it was fitted to, "
            "so leave them out of one of the two."
        )


def provenance(words: Sequence[str], base: str, hashes_name: str, paths: Sequence[Path], **more) -> dict:
    """Where a fitted model comes from: the command line without folders, hashes of the fitted files, versions.

    Args:
        words: words of the command line without ``cfb``: ``["fit", *self.words()]``.
        base: name of the model that the fit started from.
        hashes_name: key of the entry with the hashes.
        paths: the fitted files.
        **more: further entries.
    """
    from cfb_mjx.runtime import environment

    return {
        "command": shlex.join(["cfb", *(Path(word).name if "/" in word else word for word in words)]),
        "base_model": base,
        hashes_name: {path.name: sha256(path.read_bytes()).hexdigest() for path in paths},
        **more,
        "cfb_mjx": __version__,
        "environment": environment(),
    }
