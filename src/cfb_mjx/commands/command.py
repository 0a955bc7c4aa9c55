"""The base classes `Command` and `Result`, and the types of the arguments of commands.

A command is a frozen dataclass of its arguments with a method ``run() -> Result``. This module imports nothing heavy;
a command imports jax and the rest of the library only when it runs.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from itertools import chain
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import tyro
import yaml

from cfb_mjx.errors import CfbError
from cfb_mjx.files import FIGURES, require_ending
from cfb_mjx.plugins import plugged


@dataclass(frozen=True)
class Within:
    """The allowed range of a number. A command with a number outside it raises `CfbError` when it is constructed."""

    least: float
    most: float = float("inf")

    def __str__(self) -> str:
        return f"at least {self.least:g}" if self.most == float("inf") else f"from {self.least:g} to {self.most:g}"


@dataclass(frozen=True)
class Ending:
    """The allowed endings of a file name. Other names raise `CfbError` when the command is constructed."""

    endings: tuple[str, ...]
    demand: str


Output = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")]
OutputFolder = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")]
File = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
Figure = Annotated[
    Path | None, tyro.conf.arg(metavar="PATH"), Ending(FIGURES, f"a figure must end in {', '.join(FIGURES)}")
]
ModelOutput = Annotated[
    Path,
    tyro.conf.arg(aliases=["-o"], metavar="PATH"),
    Ending((".yaml", ".yml"), "the output is a model and must end in .yaml"),
]
Folder = Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")]
Files = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")]
Logs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG...")]
OtherLogs = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="LOG...")]
FlownWith = Annotated[tuple[Path, ...], tyro.conf.arg(aliases=["--with"], metavar="LOG...")]
Model = Annotated[str, tyro.conf.arg(metavar="MODEL")]
Devices = Annotated[int, Within(1)]
if TYPE_CHECKING:
    Pairs = tuple[str, ...]
    Spans = tuple[str, ...]
else:  # The types that the parser reads.
    Pairs = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE...")]
    Spans = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="A:B...")]
"""``--set A=1 B=2`` and ``--set A=1 --set B=2`` mean the same, and so do ``set={"A": 1, "B": 2}`` and
``set=("A=1", "B=2")``. If a name is given twice, the last value is used. The command stores the words,
``("A=1", "B=2")``. Likewise a path may be given as a string, and a single log instead of a sequence of logs."""

_PLUGIN = "Python file that defines effects of your own, for use in models; may be given several times."
_METAVARS = {float: "NUMBER", int: "INT", str: "TEXT", Path: "PATH"}
_Class = TypeVar("_Class", bound=type)


class Result:
    """The result of a command. ``str(result)`` is the text that ``cfb`` prints; ``run()`` has written all files."""

    @property
    def complaint(self) -> str | None:
        """One sentence on why ``cfb`` exits with status 2 although there is a result; None if it does not."""
        return None


@dataclass(frozen=True)
class Written(Result):
    """A result that consists of text, and of the files that were written.

    Attributes:
        text: the text that ``cfb`` prints.
        files: paths of the files written, by kind; None for a file that was not asked for.
    """

    text: str
    files: Mapping[str, Path | None] = field(default_factory=dict)

    def __str__(self) -> str:
        return "\n".join([*([self.text] if self.text else []), *lines_of(self.files)])


def lines_of(files: Mapping[str, Path | None]) -> list[str]:
    """One line ``kind: path`` for each file that was written; a path of None was not asked for."""
    return [f"{what}: {path}" for what, path in files.items() if path is not None]


@dataclass(frozen=True)
class Command:
    """Base class of all commands.

    A subclass is a frozen dataclass whose fields are the arguments of the command.
    """

    lists_in_yaml: ClassVar[bool] = False
    """Whether a list on the right side of NAME=VALUE is written as YAML, as for trainings. Otherwise it is written as
    numbers separated by commas, as for models."""

    plugin: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="FILE.py", help=_PLUGIN)] = (
        field(default=(), kw_only=True)
    )

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self), include_extras=True)
        for one in fields(self):
            value, hint = getattr(self, one.name), hints[one.name]
            if _nested(hint):
                value = self._pairs(value)
            else:
                value = _taken(value, hint, f"--{one.name.replace('_', '-')}")
            object.__setattr__(self, one.name, value)

    def run(self) -> Result:
        """Run the command, write the files that were asked for, and return the result.

        Raises:
            CfbError: bad input, described in one sentence. In this case nothing is written.
        """
        raise NotImplementedError

    @classmethod
    def changed(cls, value: Any) -> str:
        """A value as text, for the right side of NAME=VALUE."""
        if isinstance(value, list | tuple) and not cls.lists_in_yaml:
            return ",".join(map(text, value))
        return text(value)

    @classmethod
    def _pairs(cls, value: Any) -> tuple[str, ...]:
        if isinstance(value, str):
            return (value,)
        if isinstance(value, Mapping):
            return tuple(f"{name}={cls.changed(one)}" for name, one in value.items())
        return tuple(chain.from_iterable((one,) if isinstance(one, str) else one for one in value))

    def words(self) -> list[str]:
        """The arguments as the words of an equivalent command line, without ``cfb`` and the command's name."""
        hints = get_type_hints(type(self), include_extras=True)
        first, rest = [], []
        for one in sorted(fields(self), key=lambda one: one.name == "plugin"):
            value, hint = getattr(self, one.name), hints[one.name]
            if value == default_of(one):
                continue
            values = [str(v) for v in value] if isinstance(value, tuple) else [str(value)]
            option = f"--{one.name.replace('_', '-')}"
            if is_positional(hint):
                first += values
            elif isinstance(value, bool):
                rest.append(option if value else f"--no-{option[2:]}")
            elif _appended(hint) and not _nested(hint):
                rest += [word for v in values for word in (option, v)]
            elif value is not None:
                rest += ["-o" if "-o" in _aliases(hint) else option, *values]
        return first + rest


@dataclass_transform(frozen_default=True, kw_only_default=False, field_specifiers=(field,))
def command(cls: _Class) -> _Class:
    """Make a class a command: a frozen dataclass whose ``run`` loads the effects of its plugins first."""
    run = cls.run

    @functools.wraps(run)
    def plugged_run(self):
        with plugged(*self.plugin):
            return run(self)

    cls.run = plugged_run
    return dataclass(frozen=True)(cls)


def text(value: Any) -> str:
    """A value as it is written on a command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple | dict):
        value = list(value) if isinstance(value, tuple) else value
        return yaml.safe_dump(value, default_flow_style=True, width=10**6).strip()
    return repr(value) if isinstance(value, int | float) else str(value)


def default_of(one: Field) -> Any:
    """The default value of a field; `dataclasses.MISSING` if the field has none."""
    return one.default_factory() if one.default_factory is not MISSING else one.default


def is_positional(hint: Any) -> bool:
    """Whether an argument is positional."""
    return tyro.conf.Positional in _marks(hint)


def held(hint: Any) -> Any:
    """The type of an argument's value if it is given, without the annotations for the parser."""
    return _plain(_bare(hint))


def told(hint: Any) -> Any:
    """The annotation for the parser: with a placeholder for the value, and without a default of None or ()."""
    if get_origin(hint) is not Annotated:
        hint = Annotated[hint, None]
    kind, marks = get_args(hint)[0], _marks(hint)
    optional = _plain(kind) is not kind
    named = any(getattr(mark, "metavar", None) for mark in marks)
    more = {}
    if not named and get_origin(_plain(kind)) is Literal and optional:
        more["metavar"] = "{" + ",".join(get_args(_plain(kind))) + "}"
    elif not named and optional:
        more["metavar"] = _METAVARS.get(_plain(kind), "TEXT")
    if optional or get_origin(kind) is tuple:
        more["help_behavior_hint"] = ""
    within = next((mark for mark in marks if isinstance(mark, Within)), None)
    if within is not None:
        more["help_behavior_hint"] = f"({within})" if optional else lambda default: f"({within}; default: {default})"
    kept = [mark for mark in marks if mark is not None and not isinstance(mark, Within | Ending)]
    return functools.reduce(lambda so_far, mark: Annotated[so_far, mark], [*kept, tyro.conf.arg(**more)], kind)


def _marks(hint: Any) -> tuple:
    return getattr(hint, "__metadata__", ())


def _aliases(hint: Any) -> tuple[str, ...]:
    return tuple(chain.from_iterable(getattr(mark, "aliases", None) or () for mark in _marks(hint)))


def _appended(hint: Any) -> bool:
    return tyro.conf.UseAppendAction in _marks(hint)


def _nested(hint: Any) -> bool:
    kind = _bare(hint)
    return get_origin(kind) is tuple and get_origin(get_args(kind)[0]) is tuple


def _bare(hint: Any) -> Any:
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _plain(kind: Any) -> Any:
    """The type of an optional argument without None."""
    if get_origin(kind) in (Union, UnionType):
        left = [one for one in get_args(kind) if one is not NoneType]
        return left[0] if len(left) == 1 else kind
    return kind


def _taken(value: Any, hint: Any, option: str) -> Any:
    """A value as the command stores it: a string becomes a path where a path is expected, a single value a tuple.

    Raises:
        CfbError: a number outside its range, a file name with the wrong ending, or an invalid choice.
    """
    kind = held(hint)
    if get_origin(kind) is tuple:
        several = (value,) if isinstance(value, str | Path) or not isinstance(value, Sequence) else tuple(value)
        one_of = get_args(kind)[0]
        return tuple(one_of(one) if isinstance(one_of, type) else one for one in several)
    if value is None:
        return None
    if kind is Path:
        for mark in _marks(hint):
            if isinstance(mark, Ending):
                require_ending(value, mark.endings, mark.demand)
        return Path(value)
    if get_origin(kind) is Literal and value not in get_args(kind):
        raise CfbError(f"{option} {value}: choose from {', '.join(map(str, get_args(kind)))}.")
    for mark in _marks(hint):
        if isinstance(mark, Within) and not mark.least <= value <= mark.most:
            raise CfbError(f"{option} {value:g}: must be {mark}.")
    return value
