"""The file that describes a sweep; unknown keys and wrong types are errors.

Sweepable commands, and the parameters of each, are derived from the classes of the commands.
"""

from __future__ import annotations

import math
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from glob import glob
from pathlib import Path
from typing import Any, Literal

from cfb_mjx.commands.command import Command, default_of, held, text
from cfb_mjx.documents import load_named, refuse_unknown, told
from cfb_mjx.errors import CfbError

RESULT = "result.json"


@dataclass(frozen=True)
class Kind:
    """A command as a task of a sweep.

    Attributes:
        positional: parameter that is given without its name.
        output: argument of ``-o`` inside the task's folder (``.`` for the folder itself); None for commands without it.
        result: JSON file with the numbers of the task, requested with ``--json`` unless the command always writes it.
        writes_result: whether the command always writes it.
        goes_on: file in the folder of an interrupted task that the command resumes from.
        more: arguments that make the command resume.
        calls: tasks per worker process; they share compiled programs, which must not accumulate.
    """

    positional: str | None = None
    output: str | None = None
    result: str = RESULT
    writes_result: bool = False
    goes_on: str | None = None
    more: tuple[str, ...] = ()
    calls: int = 20

    def outputs(self) -> tuple[tuple[str, str], ...]:
        """Options that name a file in the task's folder, with the file."""
        folder = () if self.output is None else (("--output", self.output),)
        return folder if self.writes_result else (*folder, ("--json", self.result))


KINDS = {
    "benchmark-nanodrone": Kind("folder"),
    "close-loop": Kind(output=".", result="report.json", writes_result=True, goes_on="search.json"),
    "demo-loop": Kind(output=".", result="loop.json", writes_result=True, goes_on="settings.json"),
    "evaluate": Kind("logs"),
    "excite": Kind("manoeuvre", output="."),
    "fit": Kind("logs", output="model.yaml"),
    "fit-rotors": Kind("files", output="model.yaml"),
    "fly": Kind("controller"),
    "refine": Kind("logs", output="model.yaml"),
    # A training configures XLA before jax loads (virtual devices, derivatives of the MJX body), so one per process.
    "train": Kind(
        "task",
        output=".",
        result="training.json",
        writes_result=True,
        goes_on="checkpoint.npz",
        more=("--resume",),
        calls=1,
    ),
}

EXTRA_FILES = frozenset({"figure", "recording", "video", "log", "keep"})
"""Parameters that name another output file, which is put into the task's folder."""
REPEATED = frozenset({"plugin"})
"""Parameters whose option is repeated for each value."""
CHOSEN_HERE = frozenset({"output", "json", "resume"})
"""Parameters that the sweep sets itself."""


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


FORMAT = "cfb_mjx sweep 1"
FOLDER = "sweeps"
_KEYS = {"format", "description", "command", "arguments", "over", "each", "cpus", "gpus"}


@dataclass(frozen=True)
class Point:
    """A case of a sweep: values by key, and its label (None: a name from the values)."""

    values: dict[str, Any]
    label: str | None = None


@dataclass(frozen=True)
class Sweep:
    """A sweep, as its file describes it.

    Attributes:
        path: the file.
        parameters: parameters of the command that every task runs.
        arguments: arguments of all tasks, by key (``seed``, ``set.mass``).
        over: lists of values; the sweep takes their product.
        each: cases; each is combined with that product.
        cpus: processors per task; its computations are limited to as many threads.
        gpus: GPUs per task.
    """

    path: Path
    parameters: Parameters
    arguments: dict[str, Any]
    over: dict[str, list[Any]]
    each: tuple[Point, ...]
    cpus: float = 1.0
    gpus: float = 0.0


def load_sweep(name_or_path: str | Path, load: Callable[[str], type[Command]], files: Sequence[Path] = ()) -> Sweep:
    """Read a sweep from a YAML file, or a shipped one by its name.

    Args:
        name_or_path: file or name of the sweep; its patterns of files start from the current folder.
        load: function from the name of a command to its class, whose fields are the arguments of a task.
        files: plugins for every task, in addition to those of the sweep.

    Raises:
        CfbError: the file is missing or invalid; one sentence says where and why.
    """
    path, raw = load_named(name_or_path, "sweep", FORMAT, FOLDER)
    refuse_unknown(raw, _KEYS, path, "")
    command = raw.get("command")
    if not isinstance(command, str) or command not in KINDS:
        raise CfbError(f"{path}: 'command' must be one of {', '.join(KINDS)}, found {told(command)}.")
    parameters = Parameters.of(command, load(command), KINDS[command])
    arguments = _flat(_mapping(raw, "arguments", path), parameters, f"{path}: arguments")
    if files:
        own = arguments.get("plugin", [])
        arguments["plugin"] = [*map(str, files), *(own if isinstance(own, list) else [own])]
    over = _flat(_mapping(raw, "over", path), parameters, f"{path}: over")
    for key, values in over.items():
        if not isinstance(values, list) or not values:
            raise CfbError(f"{path}: over.{key} must be a list of values, found {told(values)}.")
    each = _each(raw.get("each"), parameters, path)
    if not over and not each:
        raise CfbError(f"{path}: nothing varies; list values under 'over', or cases under 'each'.")
    return Sweep(
        path,
        parameters,
        arguments,
        over,
        each or (Point({}),),
        _share(raw, "cpus", 1, path),
        _share(raw, "gpus", 0, path),
    )


def _mapping(raw: Mapping, key: str, path: Path) -> dict:
    value = raw.get(key) or {}
    if not isinstance(value, dict):
        raise CfbError(f"{path}: '{key}' must be a mapping, found {told(value)}.")
    return value


def _flat(mapping: Mapping, parameters: Parameters, where: str) -> dict[str, Any]:
    """Flatten arguments: keys as in Python (``held_out``), and ``set: {mass: 0.04}`` becomes ``set.mass: 0.04``."""
    flat: dict[str, Any] = {}
    for raw_key, value in mapping.items():
        name, dot, rest = str(raw_key).partition(".")
        name = name.replace("-", "_")
        if not dot and parameters.shapes.get(name) == "pairs":
            if not isinstance(value, dict):
                raise CfbError(f"{where}.{name} must be a mapping NAME: VALUE, found {told(value)}.")
            entries = {f"{name}.{key}": v for key, v in value.items()}
        else:
            entries = {f"{name}{dot}{rest}": value}
        if both := sorted(set(flat) & set(entries)):
            raise CfbError(f"{where}: '{both[0]}' is given twice.")
        flat |= {key: _plain(v) for key, v in entries.items()}
    return flat


def _plain(value: Any) -> Any:
    """Turn values such as dates, which YAML makes of 2026-01-31, back into text."""
    if isinstance(value, list):
        return [_plain(v) for v in value]
    return value if value is None or isinstance(value, str | bool | int | float | dict) else str(value)


def _each(raw: Any, parameters: Parameters, path: Path) -> tuple[Point, ...]:
    if raw is None:
        return ()
    if isinstance(raw, dict):
        return _matches(raw, path)
    if not isinstance(raw, list) or not raw or not all(isinstance(case, dict) and case for case in raw):
        raise CfbError(f"{path}: 'each' must be a list of mappings, or one NAME: PATTERN of files or folders.")
    points = []
    for number, case in enumerate(raw, 1):
        values = {key: value for key, value in case.items() if key != "name"}
        label = None if case.get("name") is None else str(case["name"])
        points.append(Point(_flat(values, parameters, f"{path}: each, case {number}"), label))
    return tuple(points)


def _matches(raw: dict, path: Path) -> tuple[Point, ...]:
    """Return one case for every file or folder that matches the pattern."""
    if len(raw) != 1 or not all(isinstance(pattern, str) for pattern in raw.values()):
        raise CfbError(f"{path}: 'each' must be a list of mappings, or one NAME: PATTERN of files or folders.")
    ((key, pattern),) = raw.items()
    found = sorted(glob(pattern, recursive=True))
    if not found:
        raise CfbError(f"{path}: each.{key}: nothing matches {pattern} in {Path.cwd()}.")
    paths = [Path(name) for name in found]
    return tuple(Point({str(key).replace("-", "_"): str(p)}, p.name if p.is_dir() else p.stem) for p in paths)


def _share(raw: Mapping, key: str, default: float, path: Path) -> float:
    value = raw.get(key, default)
    least = "positive" if key == "cpus" else "zero or positive"
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not 0 <= value < math.inf or (key == "cpus" and value == 0):
        raise CfbError(f"{path}: '{key}' must be a {least} number, found {told(value)}.")
    # Ray can share one processor, but it does not accept several and a fraction.
    if value > 1 and value != int(value):
        raise CfbError(f"{path}: '{key}' above 1 must be a whole number, found {told(value)}.")
    return float(value)
