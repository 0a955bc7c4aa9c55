"""Locks of files: they end with the process that holds them, however it ends, and hold on shared file systems too."""

from __future__ import annotations

import fcntl
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cfb_mjx.errors import CfbError

POLL_S = 0.3


@contextmanager
def held(path: Path, shared: bool = False, busy: str | None = None) -> Iterator[None]:
    """Hold a lock during the block.

    Args:
        path: of the lock; the file stays.
        shared: with others who say so.
        busy: what to say when another holds it; None waits.

    Raises:
        CfbError: ``busy``, with who holds it, or a file system without locks.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    how = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    with open(path, "a+", encoding="utf-8") as file:
        while True:
            try:
                fcntl.flock(file, how | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if busy is not None:
                    file.seek(0)
                    raise CfbError(f"{busy} ({file.read().strip() or 'elsewhere'}).") from None
                # Polled, so that Ctrl-C is heard.
                time.sleep(POLL_S)
            except OSError as error:
                raise CfbError(
                    f"{path}: its file system has no locks ({error.strerror or error}), without which two processes "
                    "could write at once; choose a folder elsewhere."
                ) from None
        file.truncate(0)
        file.write(f"{socket.gethostname()}, process {os.getpid()}")
        file.flush()
        yield
