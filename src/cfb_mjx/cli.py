"""Entry point of ``cfb``: it selects the command, and turns each error into one sentence and an exit status."""

from __future__ import annotations

import errno
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from cfb_mjx import __version__
from cfb_mjx.commands import COMMANDS
from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.interrupts import heard
from cfb_mjx.runtime import set_up_xla
from cfb_mjx.terminal import shown


def main(arguments: list[str] | None = None) -> int:
    """Run one ``cfb`` command line and return its exit status.

    0: success. 1: an error in the library. 2: bad input. 3: another process of a training over several processes is
    gone. 130: interrupted.
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
        # The reader of the output has closed it (`cfb ... | head`): print no error, neither now nor at exit.
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
    """Print every `CfbWarning` once, as one sentence on standard error. Other warnings are shown as before."""
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
    name, *rest = arguments or ["--help"]
    if name == "help" and rest:
        name, rest = rest[0], ["--help"]
    if name in ("-h", "--help", "help"):
        print(_help())
        return 0 if arguments else 2
    if name in ("-V", "--version"):
        print(f"cfb_mjx {__version__}")
        return 0
    if name == "--install-completion":
        from cfb_mjx.completion import install

        print(install(*rest[:1] or [os.path.basename(os.environ.get("SHELL", ""))]))
        return 0
    if name not in COMMANDS:
        raise CfbError(f"unknown command {name!r}; the commands are {', '.join(COMMANDS)}.")
    from cfb_mjx.commands.line import run_line

    return run_line(name, rest)


def _help() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {entry.summary}" for name, entry in COMMANDS.items())
    return (
        f"usage: cfb COMMAND ...\n\nCrazyflie Brushless: simulate, identify, train. cfb_mjx {__version__}\n\n"
        f"commands:\n{rows}\n\n"
        "'cfb help COMMAND' explains a command. 'cfb --install-completion bash' (or zsh, fish) installs completion."
    )


def _fail(message: str, status: int) -> int:
    print(shown(f"cfb: {message}"), file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
