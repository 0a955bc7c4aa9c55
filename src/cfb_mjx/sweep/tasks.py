"""The tasks of a sweep: every combination of arguments, as a command line with a name.

Names are readable, valid as folder names, and made only of what varies, so that they do not change.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from glob import glob
from hashlib import sha256
from itertools import product
from pathlib import Path, PurePath
from typing import Any

from cfb_mjx.commands.command import text
from cfb_mjx.documents import told
from cfb_mjx.errors import CfbError
from cfb_mjx.sweep.config import EXTRA_FILES, Kind, Parameters, Sweep

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
    return PurePath(said).stem if "/" in said or said.endswith((".yaml", ".yml", ".npz", ".onnx", ".mcap")) else said


LOG_SUFFIXES = (".mcap", ".parquet", ".csv")
"""Suffixes of the flight logs in a folder that is given in place of logs."""
_FILE_SUFFIXES = (".yaml", ".yml", ".npz", ".onnx")
_HOLE = re.compile(r"\{([A-Za-z_]\w*)\}")


@dataclass(frozen=True)
class Task:
    """One command of a sweep.

    Attributes:
        name: name of the task and of its folder.
        command: command, for instance ``fly``.
        arguments: arguments of the command, without those that name files in the task's folder.
        files: options that name files in the task's folder, with the file.
        varied: arguments that distinguish the task from the others, by key.
    """

    name: str
    command: str
    arguments: tuple[str, ...]
    files: tuple[tuple[str, str], ...]
    varied: dict[str, Any]

    def words(self, folder: Path) -> list[str]:
        """Return the arguments of ``cfb`` that write the results to ``folder``."""
        outputs = [word for option, name in self.files for word in (option, str(folder / name))]
        return [self.command, *self.arguments, *outputs]

    @property
    def line(self) -> str:
        """The command line with results in the current folder; it identifies the task."""
        return shlex.join(["cfb", *self.words(Path("."))])


def tasks_of(sweep: Sweep) -> tuple[Task, ...]:
    """Return the tasks of every combination, in the order of the file.

    Raises:
        CfbError: an unknown argument, an invalid value, missing logs, or two tasks with the same name.
    """
    where = str(sweep.path)
    used = _require_known(sweep, where)
    tasks = tuple(_task(sweep, label, varied, used, where) for label, varied in _points(sweep))
    if (name := twice(task.name for task in tasks)) is not None:
        raise CfbError(
            f"{where}: two tasks are called '{name}'; remove the duplicate, or give the cases under 'each' a 'name'."
        )
    return tasks


def _points(sweep: Sweep) -> Iterator[tuple[str | None, dict[str, Any]]]:
    for case in sweep.each:
        for values in product(*sweep.over.values()):
            yield case.label, case.values | dict(zip(sweep.over, values, strict=True))


def _require_known(sweep: Sweep, where: str) -> set[str]:
    """Return the names in braces in the arguments; refuse other varied names that are not arguments."""
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
                raise CfbError(f"{where}: {group}.{key}: the sweep sets this itself; leave it out.")
            known = ", ".join(parameters.known)
            braces = "" if group == "arguments" else f", and no argument contains {{{key}}}"
            raise CfbError(
                f"{where}: {group}.{key} is not an argument of cfb {parameters.command}{braces}; it takes {known}."
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
    # A label replaces the values of its case in the name.
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
    """Replace ``{name}`` in texts by the varied value of that name."""
    if isinstance(value, list):
        return [_filled(v, varied, where) for v in value]
    if not isinstance(value, str):
        return value
    for hole in _HOLE.findall(value):
        if hole not in varied:
            raise CfbError(
                f"{where}: {{{hole}}} in '{value}' needs a varied value called {hole}; add it, or correct the name."
            )
    return _HOLE.sub(lambda match: str(varied[match[1]]), value)


def _checked(key: str, value: Any, parameters: Parameters, where: str) -> Any:
    """Check a value: input files must exist; patterns and folders are replaced by their files."""
    if key in EXTRA_FILES and value is not None:
        if not isinstance(value, str) or Path(value).name != value or value in _taken(parameters.kind):
            raise CfbError(f"{where}: {key} must be a file name of its own, without a folder, found {told(value)}.")
        return value
    shape = parameters.shapes.get(key)
    if shape == "files" and value is not None:
        listed = value if isinstance(value, list) else [value]
        return [log for one in listed for log in _logs(str(one), f"{where}: {key}")]
    if isinstance(value, str) and (shape == "file" or value.endswith(_FILE_SUFFIXES)) and not Path(value).exists():
        raise CfbError(f"{where}: {key}: {value}: there is no such file; paths start from the current folder.")
    return value


def _taken(kind: Kind) -> set[str | None]:
    return {kind.result, kind.output, "task.json", "output.txt"}


def _logs(named: str, where: str) -> list[str]:
    path = Path(named)
    if path.is_dir():
        logs = sorted(str(p) for p in path.iterdir() if p.suffix.lower() in LOG_SUFFIXES and not p.name.startswith("."))
        if not logs:
            raise CfbError(f"{where}: {named}: this folder has no flight log ({', '.join(LOG_SUFFIXES)}).")
        return logs
    if path.exists():
        return [named]
    found = sorted(glob(named, recursive=True))
    if not found:
        raise CfbError(f"{where}: nothing matches {named} in {Path.cwd()}.")
    return found
