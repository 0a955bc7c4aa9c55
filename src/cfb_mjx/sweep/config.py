"""The file that describes a sweep; unknown keys and wrong types are errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Any

from cfb_mjx.commands.command import Command
from cfb_mjx.documents import load_named, refuse_unknown, told
from cfb_mjx.errors import CfbError
from cfb_mjx.sweep.kinds import KINDS
from cfb_mjx.sweep.parameters import Parameters

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
