"""Names of tasks: readable, valid as folder names, and made only of what varies, so that they do not change."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from hashlib import sha256
from pathlib import PurePath
from typing import Any

from cfb_mjx.commands.command import text

LONGEST = 120
"""Largest number of characters in a name; file systems allow 255, and names of files are made from it."""
_UNSAFE = re.compile(r"[^A-Za-z0-9.=+_-]+")


def name_of(label: str | None, varied: Mapping[str, Any]) -> str:
    """Return the name of a task: its label, if it has one, then ``key=value`` of what varies.

    A key is shortened to its last part (``set.randomisation.magnitude`` to ``magnitude``) unless another key has the
    same last part.
    """
    ends = [key.rpartition(".")[2] for key in varied]
    short = {key: end if ends.count(end) == 1 else key for key, end in zip(varied, ends, strict=True)}
    parts = ([] if label is None else [label]) + [f"{short[key]}={_said(value)}" for key, value in varied.items()]
    name = _UNSAFE.sub("-", "_".join(parts)).lstrip(".-+") or "task"
    if len(name) > LONGEST:
        digest = sha256(name.encode()).hexdigest()[:8]
        name = f"{name[: LONGEST - 9]}-{digest}"
    return name


def twice(names: Iterable[str]) -> str | None:
    """Return a name that occurs twice, ignoring case as some file systems do; None if there is none."""
    seen = set()
    for name in names:
        if name.casefold() in seen:
            return name
        seen.add(name.casefold())
    return None


def _said(value: Any) -> str:
    if value is None:
        return "default"
    if isinstance(value, list):
        return "+".join(_said(v) for v in value)
    if isinstance(value, dict):
        return "+".join(f"{key}-{_said(v)}" for key, v in value.items())
    # A path is shortened to its file name without suffix.
    said = text(value)
    return PurePath(said).stem if "/" in said or said.endswith((".yaml", ".yml", ".npz", ".mcap")) else said
