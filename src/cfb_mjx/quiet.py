"""Imports of libraries that talk."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Import within: MJX prints that its optional warp backend is missing, and Brax brings it along together with
    jaxopt, which warns that it is no longer maintained."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        yield
