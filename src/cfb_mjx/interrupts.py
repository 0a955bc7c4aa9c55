"""Reliable handling of Ctrl-C and SIGTERM."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def heard() -> Iterator[None]:
    """Make every Ctrl-C in this block raise KeyboardInterrupt.

    Without this a Ctrl-C is lost in two cases. The shell may have started the process with the signal ignored (scripts,
    ``make -j``). And Python discards exceptions in callbacks of the garbage collector and in finalisers, of which jax
    has several; the signal is then sent again a moment later.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and sys.stdin is not None and sys.stdin.isatty():
        signal.signal(signal.SIGINT, signal.default_int_handler)
    before = sys.unraisablehook

    def again(event: sys.UnraisableHookArgs) -> None:
        if issubclass(event.exc_type, KeyboardInterrupt):
            main = threading.main_thread().ident
            threading.Timer(0.02, signal.pthread_kill, (main, signal.SIGINT)).start()
        else:
            before(event)

    sys.unraisablehook = again
    try:
        yield
    finally:
        sys.unraisablehook = before


@contextmanager
def held_back() -> Iterator[None]:
    """Delay a Ctrl-C to the end of this block, which should be short; while jaxlib loads, it would crash."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        signal.raise_signal(signal.SIGINT)


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Treat SIGTERM, which batch systems send, as Ctrl-C in this block; in the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number, frame) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
