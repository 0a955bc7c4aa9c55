"""Types of arguments that several commands take. Light, as everything that ``cfb --help`` loads."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Annotated

import tyro

Output = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")]
Model = Annotated[str, tyro.conf.arg(metavar="MODEL")]
File = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
Pairs = Annotated[
    tuple[tuple[str, ...], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(metavar="NAME=VALUE...", help_behavior_hint=""),
]
"""``--set A=1 B=2`` and ``--set A=1 --set B=2`` mean the same; the later of two of one name counts."""


def flat(pairs: tuple[tuple[str, ...], ...]) -> list[str]:
    """One list of what every occurrence of the argument gave."""
    return list(chain.from_iterable(pairs))
