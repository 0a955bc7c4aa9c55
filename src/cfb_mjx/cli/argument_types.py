"""Arguments that several commands take. Light, as everything that ``cfb --help`` loads."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Annotated, get_type_hints

import tyro

from cfb_mjx.plugins import plugged

Output = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")]
Model = Annotated[str, tyro.conf.arg(metavar="MODEL")]
File = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
Plugin = Annotated[
    tuple[Path, ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(
        metavar="FILE.py",
        help="a Python file with effects of your own, known to this command; may be given several times.",
        help_behavior_hint="",
    ),
]
Pairs = Annotated[
    tuple[tuple[str, ...], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(metavar="NAME=VALUE...", help_behavior_hint=""),
]
"""``--set A=1 B=2`` and ``--set A=1 --set B=2`` mean the same; the later of two of one name counts."""
Spans = Annotated[
    tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="A:B...", help_behavior_hint="")
]


def flat(pairs: tuple[tuple[str, ...], ...]) -> list[str]:
    """One list of what every occurrence of the argument gave."""
    return list(chain.from_iterable(pairs))


def with_plugins(command: Callable[..., None]) -> Callable[..., None]:
    """The command with ``--plugin FILE.py``: while it runs, the effects of these files are known."""

    def run(*arguments, plugin: tuple[Path, ...] = (), **options) -> None:
        with plugged(*plugin):
            command(*arguments, **options)

    more = inspect.Parameter("plugin", inspect.Parameter.KEYWORD_ONLY, default=())
    own = inspect.signature(command)
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__signature__ = own.replace(parameters=[*own.parameters.values(), more])
    # Not `functools.wraps`: tyro looks at what is wrapped, which knows nothing of plugins.
    run.__annotations__ = get_type_hints(command, include_extras=True) | {"plugin": Plugin}
    return run
