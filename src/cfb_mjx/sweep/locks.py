"""File locks. They end with the process that holds them, and also work on shared file systems."""

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
        path: file of the lock; it is not deleted.
        shared: allow other shared holders.
        busy: message if another process holds the lock; None waits for it.

    Raises:
        CfbError: another process holds the lock (``busy``, with that process), or the file system has no locks.
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
                # Polling lets Ctrl-C through.
                time.sleep(POLL_S)
            except OSError as error:
                raise CfbError(
                    f"{path}: its file system has no locks ({error.strerror or error}), so two processes could write "
                    "at the same time; choose a folder on another file system."
                ) from None
        file.truncate(0)
        file.write(f"{socket.gethostname()}, process {os.getpid()}")
        file.flush()
        yield
