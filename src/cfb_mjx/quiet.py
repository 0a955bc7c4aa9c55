"""Imports of libraries that print messages."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Suppress the output of imports in this block.

    MJX prints that its optional warp backend is missing. Brax imports MJX and jaxopt, which warns that it is no longer
    maintained.
    """
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        yield
