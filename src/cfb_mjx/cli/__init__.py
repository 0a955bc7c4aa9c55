"""The ``cfb`` command."""

from __future__ import annotations

import errno
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from cfb_mjx import __version__
from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.interrupts import heard
from cfb_mjx.runtime import set_up_xla
from cfb_mjx.terminal import shown

SUMMARY = {
    "import": "convert a flight log to MCAP",
    "check": "say what recordings hold, whether their signals agree, what they are good for",
    "evaluate": "measure how well a model predicts flights, open loop",
    "benchmark-nanodrone": "judge a model by the rules of the IDSIA nano-drone benchmark",
    "fit": "refit the model to flights, with uncertainty",
    "fit-rotors": "fit motors and rotor maps, from flights or a bench",
    "excite": "design a manoeuvre that identifies the drone, and predict what a fit will know",
    "close-loop": "find the physical effect a model lacks, and add it",
    "refine": "fit the numbers of named effects, to innovations or to predictions",
    "train": "train a controller, by PPO or by back-propagation through the model",
    "fly": "fly a controller in simulation and measure it",
    "sweep": "run a command many times over, on this machine or a cluster",
    "export": "write a policy as C for the drone, and check that it does the same there",
    "view": "show flights: a rerun recording with predictions and residuals, or a film",
    "bench": "measure throughput, compile time and memory",
    "demo-loop": "fly a drone the model does not know, diagnose it, retrain, and fly it again",
    "reproduce": "make the paper's figures and tables, its numbers beside ours",
    "demo": "evaluate a flight, fly 4096 randomised drones, write a page",
    "version": "print versions",
}
"""Kept apart from the commands themselves: help and typing errors answer without loading anything."""


def main(arguments: list[str] | None = None) -> int:
    """Entry point.

    Exit status: 0 done, 1 a fault in the library, 2 bad input, 3 another process of several gone, 130 interrupted.
    """
    set_up_xla()
    try:
        with heard(), unusual_said_once():
            status = _dispatch(sys.argv[1:] if arguments is None else arguments)
        sys.stdout.flush()
    except CfbError as error:
        return _fail(str(error), 2)
    except KeyboardInterrupt:
        return _fail("interrupted; earlier results are as they were.", 130)
    except BrokenPipeError:
        # The reader of our output has gone (`cfb ... | head`); say nothing, and nothing at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EACCES, errno.EROFS):
            raise
        return _fail(f"{error.filename or 'output'}: {error.strerror}; earlier results are as they were.", 2)
    except MemoryError:
        return _fail("out of memory; use fewer drones or shorter logs.", 2)
    return status


@contextmanager
def unusual_said_once() -> Iterator[None]:
    """Print every `CfbWarning` once, as a sentence on standard error; others go where they went."""
    said, before = set(), warnings.showwarning

    def show(message, category, *where, **more):
        if not issubclass(category, CfbWarning):
            before(message, category, *where, **more)
        elif str(message) not in said:
            said.add(str(message))
            print(f"cfb: {shown(str(message))}", file=sys.stderr, flush=True)

    with warnings.catch_warnings():
        warnings.simplefilter("always", CfbWarning)
        warnings.showwarning = show
        yield


def _dispatch(arguments: list[str]) -> int:
    name = arguments[0] if arguments else "--help"
    if name in ("-h", "--help", "help"):
        print(_help())
        return 0 if arguments else 2
    if name in ("-V", "--version"):
        print(f"cfb_mjx {__version__}")
        return 0
    if name not in SUMMARY:
        raise CfbError(f"there is no command {name!r}; the commands are {', '.join(SUMMARY)}.")
    from importlib.util import find_spec

    from cfb_mjx.commands import COMMANDS

    if find_spec(f"cfb_mjx.commands.{COMMANDS[name].place.partition('.')[0]}") is not None:
        from cfb_mjx.commands.line import run_line

        return run_line(name, arguments[1:])
    from cfb_mjx.cli.commands import run

    try:
        run(name, arguments[1:])
    except SystemExit as stop:  # the parser has already explained itself
        return stop.code if isinstance(stop.code, int) else 2
    return 0


def _help() -> str:
    width = max(map(len, SUMMARY))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, text in SUMMARY.items())
    return (
        f"usage: cfb COMMAND ...\n\nCrazyflie Brushless: simulate, identify, train. cfb_mjx {__version__}\n\n"
        f"commands:\n{rows}\n\n'cfb COMMAND --help' explains a command."
    )


def _fail(message: str, status: int) -> int:
    print(shown(f"cfb: {message}"), file=sys.stderr)
    return status
