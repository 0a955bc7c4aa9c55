"""The parameters of a command, from its class, and their values as words of a command line."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from cfb_mjx.commands.command import Command, default_of, held, text
from cfb_mjx.documents import told
from cfb_mjx.errors import CfbError
from cfb_mjx.sweep.kinds import CHOSEN_HERE, REPEATED, Kind

Shape = Literal["flag", "pairs", "files", "file", "texts", "text", "whole", "number"]
_NUMBERS = {"whole": int, "number": float}
_SHAPES: dict[Any, Shape] = {bool: "flag", Path: "file", int: "whole", float: "number"}


@dataclass(frozen=True)
class Parameters:
    """Parameters of a command.

    Attributes:
        command: name of the command.
        made: class of the command.
        shapes: kind of value of every parameter.
        defaults: defaults of the parameters that have one.
        kind: the command as a task.
    """

    command: str
    made: type[Command]
    shapes: Mapping[str, Shape]
    defaults: Mapping[str, Any]
    kind: Kind

    @classmethod
    def of(cls, command: str, made: type[Command], kind: Kind) -> Parameters:
        """Return the parameters of a command, given its class."""
        hints = typing.get_type_hints(made, include_extras=True)
        # Plugins come last on a command line.
        known = sorted(fields(made), key=lambda one: one.name == "plugin")
        defaults = {one.name: default_of(one) for one in known if default_of(one) is not MISSING}
        return cls(command, made, {one.name: _shape(held(hints[one.name])) for one in known}, defaults, kind)

    def require_fitting(self, values: Mapping[str, Any], where: str) -> None:
        """Refuse values that the command would refuse.

        Raises:
            CfbError: a value has the wrong kind, is out of range or is missing.
        """
        given: dict[str, Any] = {} if self.kind.output is None else {"output": self.kind.output}
        for name, shape in self.shapes.items():
            if shape == "pairs" or values.get(name) is None:
                continue
            value = values[name]
            if shape in _NUMBERS:
                value = _number(value, _NUMBERS[shape], f"{where}: {name}")
            given[name] = text(value) if shape == "text" else value
        if absent := [name for name in self.shapes if name not in self.defaults and name not in given]:
            raise CfbError(f"{where}: cfb {self.command} needs {', '.join(absent)}; give it under 'arguments'.")
        try:
            self.made(**given)
        except CfbError as error:
            raise CfbError(f"{where}: {error}") from None

    def has(self, key: str) -> bool:
        """Whether ``key`` (``seed``, ``set.mass``) is an argument that a sweep may give."""
        name, dot, _ = key.partition(".")
        return name in self.known and (not dot or self.shapes[name] == "pairs")

    @property
    def known(self) -> list[str]:
        """Parameters that a sweep may give."""
        return [name for name in self.shapes if name not in CHOSEN_HERE]

    def words(self, values: Mapping[str, Any], where: str) -> list[str]:
        """Return the command line of values by key, in the order of the parameters.

        Raises:
            CfbError: a parameter cannot take a value.
        """
        first, rest = [], []
        for name, shape in self.shapes.items():
            value = values.get(name)
            if shape == "pairs":
                changes = {k.partition(".")[2]: v for k, v in values.items() if k.startswith(f"{name}.")}
                pairs = [f"{k}={self.made.changed(v)}" for k, v in sorted(changes.items())]
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


def _texts(value: Any, where: str) -> list[str]:
    values = value if isinstance(value, list) else [value]
    if not values or any(v is None or isinstance(v, list | dict) for v in values):
        raise CfbError(f"{where} must be a value or a list of values, found {told(value)}.")
    return [text(v) for v in values]


def _number(value: Any, kind: type, where: str) -> float:
    # Accept text as well: values from braces are text, and so is 1e-3 in YAML.
    try:
        if isinstance(value, bool | list | dict) or (kind is int and isinstance(value, float)):
            raise TypeError
        return kind(value)
    except (TypeError, ValueError):
        raise CfbError(f"{where} must be a {'whole ' * (kind is int)}number, found {told(value)}.") from None


def _dashed(name: str) -> str:
    return name.replace("_", "-")


def _shape(kind: Any) -> Shape:
    if typing.get_origin(kind) is tuple:
        one = typing.get_args(kind)[0]
        if one is Path:
            return "files"
        return "pairs" if typing.get_origin(one) is tuple else "texts"
    return _SHAPES.get(kind, "text")
