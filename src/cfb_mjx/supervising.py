"""Run the work in a child process, and explain in one sentence how it ended.

When one of several processes dies, jax ends the others from C++, with a stack trace and SIGABRT; Python code cannot
print a better message then. So a child does the work. The parent reads the output of its libraries, and shows it only
if there is no explanation.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable

from cfb_mjx.terminal import Escaped

KEPT_BYTES = 1 << 16
_FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def supervised(explain: Callable[[int, str], tuple[int, str] | None]) -> None:
    """Fork, and return in the child. The parent waits for the child and raises SystemExit with its status.

    Call it before starting threads or loading jax.

    Args:
        explain: function from the child's exit status (minus the number of a signal that ended it) and the output of
            its libraries to the status of the parent and a sentence; None if there is no explanation.
    """
    said, say = os.pipe()
    waited, alive = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        os.close(said)
        os.close(alive)
        _begin(say, waited)
        return
    os.close(say)
    os.close(waited)
    # Signals that the caller ignored stay ignored.
    heard = [number for number in _FORWARDED if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, lambda number, _: _send(child, number)) for number in heard}
    printed = _read(said)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    for number, handler in before.items():
        signal.signal(number, handler)
    os.close(alive)
    explained = explain(status, printed)
    if explained is None:
        print(printed, end="", file=sys.stderr)
        explained = (128 - status if status < 0 else status), ""
    if explained[1]:
        print(f"cfb: {explained[1]}", file=sys.stderr)
    raise SystemExit(explained[0])


def _begin(say: int, waited: int) -> None:
    """Set up the child: libraries print into the pipe, Python as before; it ends when the parent ends."""
    # A Ctrl-C in the terminal goes to the parent only, which forwards it.
    os.setpgid(0, 0)
    sys.stdout = Escaped(os.fdopen(os.dup(1), "w", buffering=1))
    sys.stderr = Escaped(os.fdopen(os.dup(2), "w", buffering=1))
    os.dup2(say, 1)
    os.dup2(say, 2)
    os.close(say)

    def watch() -> None:
        os.read(waited, 1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _send(child: int, number: int) -> None:
    try:
        os.kill(child, number)
    except ProcessLookupError:
        return


def _read(source: int) -> str:
    """Read to the end; return the last `KEPT_BYTES`."""
    kept = b""
    while piece := os.read(source, 4096):
        kept = (kept + piece)[-KEPT_BYTES:]
    os.close(source)
    return kept.decode(errors="replace")
