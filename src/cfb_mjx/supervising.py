"""A parent for a process that may be ended by force: it says in one sentence what became of it.

When a process of several dies, jax ends the others from C++, with a stack trace and SIGABRT; no Python runs any more
that could say something better. So the work is done by a child, and what its libraries print by themselves is read
here, and shown only if nobody can explain it.
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
    """Return in a child process. The parent waits for it, and leaves by SystemExit with its status.

    Call it before threads and jax: it forks.

    Args:
        explain: given how the child ended (its exit status; minus the signal's number where one ended it) and what its
            libraries printed, the status to leave with and a sentence; None if it is not to be explained.
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
    # What the caller had ignored stays so.
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
    """In the child: Python prints where it did, libraries into the pipe; and the parent's end is the child's."""
    # A Ctrl-C in the terminal goes to the parent alone, which passes it on.
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
    """To its end; the last `KEPT_BYTES`."""
    kept = b""
    while piece := os.read(source, 4096):
        kept = (kept + piece)[-KEPT_BYTES:]
    os.close(source)
    return kept.decode(errors="replace")
