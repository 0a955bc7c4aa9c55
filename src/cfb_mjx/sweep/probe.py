"""Whether another machine sees the folders of a sweep."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cfb_mjx import __version__

PATIENCE_S = 10.0
"""Network file systems show new files late."""


@contextmanager
def say_hello(folder: Path) -> Iterator[Path]:
    """A file in the folder during the block, for others to look for."""
    handle, name = tempfile.mkstemp(prefix=".seen-", dir=folder)
    os.close(handle)
    try:
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)


def look(marker: str, place: str, patience_s: float = PATIENCE_S) -> tuple[str, str | None]:
    """Version of the library here, and which folder is not seen from here: the marker's, ``place``, or None."""
    end = time.monotonic() + patience_s
    while not Path(marker).exists():
        if time.monotonic() > end:
            return __version__, str(Path(marker).parent)
        time.sleep(0.2)
    return __version__, None if Path(place).is_dir() else place
