"""Check whether another machine sees the folders of a sweep."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cfb_mjx import __version__

PATIENCE_S = 10.0
"""Time to wait for a new file; network file systems show it with a delay."""


@contextmanager
def say_hello(folder: Path) -> Iterator[Path]:
    """Create a file in the folder during the block, for other machines to look for."""
    handle, name = tempfile.mkstemp(prefix=".seen-", dir=folder)
    os.close(handle)
    try:
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)


def look(marker: str, place: str, patience_s: float = PATIENCE_S) -> tuple[str, str | None]:
    """Return the library's version on this machine, and the folder that it does not see (None: it sees both)."""
    end = time.monotonic() + patience_s
    while not Path(marker).exists():
        if time.monotonic() > end:
            return __version__, str(Path(marker).parent)
        time.sleep(0.2)
    return __version__, None if Path(place).is_dir() else place
