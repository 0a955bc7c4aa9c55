"""The tasks of a sweep: every combination of what varies, as a command line with a name."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from glob import glob
from itertools import product
from pathlib import Path
from typing import Any

from cfb_mjx.documents import told
from cfb_mjx.errors import CfbError
from cfb_mjx.sweep.config import Sweep
from cfb_mjx.sweep.kinds import EXTRA_FILES, Kind
from cfb_mjx.sweep.naming import name_of, twice
from cfb_mjx.sweep.parameters import Parameters

LOG_SUFFIXES = (".mcap", ".parquet", ".csv")
"""What counts as a flight log where a folder stands for the logs in it."""
_FILE_SUFFIXES = (".yaml", ".yml", ".npz")
_HOLE = re.compile(r"\{([A-Za-z_]\w*)\}")


@dataclass(frozen=True)
class Task:
    """One command of a sweep.

    Attributes:
        name: of its folder.
        command: for instance ``fly``.
        arguments: of the command, without those that name files of the task's folder.
        files: options that do, with the file.
        varied: what makes this task another than the rest, by key.
    """

    name: str
    command: str
    arguments: tuple[str, ...]
    files: tuple[tuple[str, str], ...]
    varied: dict[str, Any]

    def words(self, folder: Path) -> list[str]:
        """What to give to ``cfb`` for results in ``folder``."""
        outputs = [word for option, name in self.files for word in (option, str(folder / name))]
        return [self.command, *self.arguments, *outputs]

    @property
    def line(self) -> str:
        """The command line, with results in the current folder: what tells a task from another of its name."""
        return shlex.join(["cfb", *self.words(Path("."))])


def tasks_of(sweep: Sweep) -> tuple[Task, ...]:
    """Every combination, in the order of the file.

    Raises:
        CfbError: a name that is no argument, a value that cannot be one, logs that are not there, or two tasks of one
            name.
    """
    where = str(sweep.path)
    used = _require_known(sweep, where)
    tasks = tuple(_task(sweep, label, varied, used, where) for label, varied in _points(sweep))
    if (name := twice(task.name for task in tasks)) is not None:
        raise CfbError(
            f"{where}: two tasks are called '{name}'; take out what is there twice, or give the cases under 'each' a "
            "'name'."
        )
    return tasks


def _points(sweep: Sweep) -> Iterator[tuple[str | None, dict[str, Any]]]:
    for case in sweep.each:
        for values in product(*sweep.over.values()):
            yield case.label, case.values | dict(zip(sweep.over, values, strict=True))


def _require_known(sweep: Sweep, where: str) -> set[str]:
    """Names that stand in braces in the arguments; every other one that varies must be an argument."""
    groups = {"arguments": sweep.arguments, "over": sweep.over}
    groups |= {"each": {key: None for case in sweep.each for key in case.values}}
    used = {hole for values in (sweep.arguments, sweep.over) for hole in _holes(list(values.values()))}
    used |= {hole for case in sweep.each for hole in _holes(list(case.values.values()))}
    parameters = sweep.parameters
    for group, values in groups.items():
        for key in values:
            if parameters.has(key) or (group != "arguments" and key in used):
                continue
            if key in parameters.shapes:
                raise CfbError(f"{where}: {group}.{key}: the sweep chooses that itself; leave it out.")
            known = ", ".join(parameters.known)
            braces = "" if group == "arguments" else f", nor does {{{key}}} stand in any argument"
            raise CfbError(
                f"{where}: {group}.{key} is no argument of cfb {parameters.command}{braces}; it takes {known}."
            )
    for a, b in (("arguments", "over"), ("arguments", "each"), ("over", "each")):
        if both := sorted(set(groups[a]) & set(groups[b])):
            raise CfbError(f"{where}: '{both[0]}' is given under '{a}' and under '{b}'; give it once.")
    return used


def _holes(value: Any) -> set[str]:
    if isinstance(value, list):
        return {hole for v in value for hole in _holes(v)}
    return set(_HOLE.findall(value)) if isinstance(value, str) else set()


def _task(sweep: Sweep, label: str | None, varied: dict[str, Any], used: set[str], where: str) -> Task:
    parameters, kind = sweep.parameters, sweep.parameters.kind
    # A label stands for all that its case says.
    named = {key: value for key, value in varied.items() if label is None or key in sweep.over}
    name = name_of(label, named)
    where = f"{where}: task {name}"
    filled = {
        key: _filled(value, varied, where) for key, value in (sweep.arguments | varied).items() if parameters.has(key)
    }
    given = {key: _checked(key, value, parameters, where) for key, value in filled.items()}
    files = [(f"--{key}", value) for key, value in given.items() if key in EXTRA_FILES and value is not None]
    words = parameters.words({key: value for key, value in given.items() if key not in EXTRA_FILES}, where)
    parameters.require_fitting(given, where)
    return Task(name, parameters.command, tuple(words), (*kind.outputs(), *sorted(files)), varied)


def _filled(value: Any, varied: Mapping[str, Any], where: str) -> Any:
    """``{name}`` in texts becomes what varies under that name."""
    if isinstance(value, list):
        return [_filled(v, varied, where) for v in value]
    if not isinstance(value, str):
        return value
    for hole in _HOLE.findall(value):
        if hole not in varied:
            raise CfbError(f"{where}: nothing called {hole} varies, for {{{hole}}} in '{value}'.")
    return _HOLE.sub(lambda match: str(varied[match[1]]), value)


def _checked(key: str, value: Any, parameters: Parameters, where: str) -> Any:
    """Files that are read must be there; patterns and folders become the files they stand for."""
    if key in EXTRA_FILES and value is not None:
        if not isinstance(value, str) or Path(value).name != value or value in _taken(parameters.kind):
            raise CfbError(
                f"{where}: {key} must be the name of a file of its own, without a folder, found {told(value)}."
            )
        return value
    shape = parameters.shapes.get(key)
    if shape == "files" and value is not None:
        listed = value if isinstance(value, list) else [value]
        return [log for one in listed for log in _logs(str(one), f"{where}: {key}")]
    if isinstance(value, str) and (shape == "file" or value.endswith(_FILE_SUFFIXES)) and not Path(value).exists():
        raise CfbError(f"{where}: {key}: {value}: there is no such file; paths count from the current folder.")
    return value


def _taken(kind: Kind) -> set[str | None]:
    return {kind.result, kind.output, "task.json", "output.txt"}


def _logs(named: str, where: str) -> list[str]:
    path = Path(named)
    if path.is_dir():
        logs = sorted(str(p) for p in path.iterdir() if p.suffix.lower() in LOG_SUFFIXES and not p.name.startswith("."))
        if not logs:
            raise CfbError(f"{where}: {named}: this folder holds no log ({', '.join(LOG_SUFFIXES)}).")
        return logs
    if path.exists():
        return [named]
    found = sorted(glob(named, recursive=True))
    if not found:
        raise CfbError(f"{where}: nothing matches {named} in {Path.cwd()}.")
    return found
