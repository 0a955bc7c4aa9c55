"""What a command takes, read off its function, and values written as words of a command line."""

from __future__ import annotations

import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import Any, Literal

import yaml

from cfb_mjx.documents import told
from cfb_mjx.errors import CfbError
from cfb_mjx.sweep.kinds import CHOSEN_HERE, REPEATED, Kind

Shape = Literal["flag", "pairs", "files", "file", "texts", "text"]


@dataclass(frozen=True)
class Parameters:
    """Of a command.

    Attributes:
        command: its name.
        shapes: what every parameter holds.
        defaults: of all parameters that have one.
        kind: the command as a task.
    """

    command: str
    shapes: Mapping[str, Shape]
    defaults: Mapping[str, Any]
    kind: Kind

    @classmethod
    def of(cls, command: str, function: Callable, kind: Kind) -> Parameters:
        """Those of the function behind a command."""
        hints = typing.get_type_hints(function)
        names = signature(function).parameters
        defaults = {name: p.default for name, p in names.items() if p.default is not p.empty}
        return cls(command, {name: _shape(hints[name]) for name in names}, defaults, kind)

    def has(self, key: str) -> bool:
        """Whether ``key`` (``seed``, ``set.mass``) is an argument that a sweep may give."""
        name, dot, _ = key.partition(".")
        return name in self.known and (not dot or self.shapes[name] == "pairs")

    @property
    def known(self) -> list[str]:
        """Parameters that a sweep may give."""
        return [name for name in self.shapes if name not in CHOSEN_HERE]

    def words(self, values: Mapping[str, Any], where: str) -> list[str]:
        """Command line of values by key; in the order of the parameters, so that it does not depend on theirs.

        Raises:
            CfbError: a value that this parameter cannot hold.
        """
        first, rest = [], []
        for name, shape in self.shapes.items():
            value = values.get(name)
            if shape == "pairs":
                changes = {k.partition(".")[2]: v for k, v in values.items() if k.startswith(f"{name}.")}
                pairs = [f"{k}={self._changed(v)}" for k, v in sorted(changes.items())]
                rest += [f"--{_dashed(name)}", *pairs] if pairs else []
            elif value is None:
                continue
            elif name == self.kind.positional:
                first += _texts(value, f"{where}: {name}")
            elif name in REPEATED:
                rest += [word for one in _texts(value, f"{where}: {name}") for word in (f"--{_dashed(name)}", one)]
            else:
                rest += self._option(name, shape, value, f"{where}: {name}")
        return first + rest

    def _option(self, name: str, shape: Shape, value: Any, where: str) -> list[str]:
        option = f"--{_dashed(name)}"
        if shape == "flag":
            if not isinstance(value, bool):
                raise CfbError(f"{where} must be true or false, found {told(value)}.")
            said = option if value else f"--no-{_dashed(name)}"
            return [] if value == self.defaults.get(name) else [said]
        if isinstance(value, list | dict) and shape not in ("files", "texts"):
            raise CfbError(f"{where} takes one value, found {told(value)}; what varies belongs under 'over' or 'each'.")
        return [option, *_texts(value, where)]

    def _changed(self, value: Any) -> str:
        """The right side of NAME=VALUE: trainings take YAML there, models numbers with commas."""
        if isinstance(value, list) and self.command != "train":
            return ",".join(text(v) for v in value)
        return text(value)


def text(value: Any) -> str:
    """A value as it is typed."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | dict):
        return yaml.safe_dump(value, default_flow_style=True, width=10**6).strip()
    return repr(value) if isinstance(value, int | float) else str(value)


def _texts(value: Any, where: str) -> list[str]:
    values = value if isinstance(value, list) else [value]
    if not values or any(v is None or isinstance(v, list | dict) for v in values):
        raise CfbError(f"{where} must be a value or a list of values, found {told(value)}.")
    return [text(v) for v in values]


def _dashed(name: str) -> str:
    return name.replace("_", "-")


def _shape(hint: Any) -> Shape:
    if hint is bool:
        return "flag"
    if hint in (Path, Path | None):
        return "file"
    if typing.get_origin(hint) is tuple:
        held = typing.get_args(hint)[0]
        if held is Path:
            return "files"
        return "pairs" if typing.get_origin(held) is tuple else "texts"
    return "text"
