"""Command lines: parsing them into command objects, running them, and the text of their help."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import MISSING, fields
from typing import get_type_hints

import tyro

from cfb_mjx.commands import COMMANDS, load
from cfb_mjx.commands.command import Command, default_of, told
from cfb_mjx.errors import CfbError
from cfb_mjx.optional import not_none
from cfb_mjx.terminal import escaped, shown

_DOCUMENTED = re.compile(r"\n\s*(Attributes|Examples):")


def parse(name: str, words: Sequence[str]) -> Command:
    """Parse a command line into a command.

    Args:
        name: name of the command.
        words: the words of the line after the name.

    Raises:
        CfbError: a number outside its range, or a file name with the wrong ending.
        SystemExit: the user asked for help, or the line is invalid; the parser has printed the reason.
    """
    kind = load(name)
    # The parser prints in colour and repeats the words of the line, which may contain control characters.
    harmless = all(shown(word) == word for word in words)
    with nullcontext() if harmless else escaped():
        values = tyro.cli(_arguments(kind), prog=f"cfb {name}", description=_description(name), args=list(words))
    return kind(**values)


def run_line(name: str, words: Sequence[str]) -> int:
    """Parse and run a command line, print the result, and return the exit status.

    Raises:
        CfbError: bad input, or a result with a `complaint`.
    """
    try:
        asked = parse(name, words)
        with escaped():
            found = asked.run()
            if text := str(found):
                print(text)
    except SystemExit as stop:  # the parser, or the supervising process, has already printed why
        return stop.code if isinstance(stop.code, int) else 2
    if found.complaint is not None:
        raise CfbError(found.complaint)
    return 0


def _arguments(kind: type[Command]):
    """A function with the signature and docstring for the parser; it returns a command's arguments by name."""

    def given(**values):
        return values

    hints = get_type_hints(kind, include_extras=True)
    parameters = [
        inspect.Parameter(
            one.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if default_of(one) is MISSING else default_of(one),
        )
        for one in sorted(fields(kind), key=lambda one: (one.name == "plugin", one.name not in kind.__annotations__))
    ]
    given.__name__ = kind.__name__
    shared = "".join(inspect.cleandoc(one.__doc__ or "").partition("\nAttributes:")[2] for one in kind.__mro__[1:])
    given.__doc__ = not_none(inspect.getdoc(kind)).replace("\nAttributes:", f"\nArgs:{shared}")
    given.__signature__ = inspect.Signature(parameters)
    given.__annotations__ = {one.name: told(hints[one.name]) for one in fields(kind)}
    return given


def _description(name: str) -> str:
    """The text above the arguments in the help: examples, and what the command does."""
    examples = "\n".join(f"  {line}" for line in COMMANDS[name].examples)
    text = _DOCUMENTED.split(not_none(inspect.getdoc(load(name))))[0].strip()
    return f"Examples:\n{examples}\n\n{text}"
