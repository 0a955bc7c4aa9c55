"""Safe output to the terminal: control characters in file names and in other programs' output are escaped."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TextIO

# Control characters except tab and newline, characters that change the writing direction, other line ends, and lone
# surrogates, which are bytes of a file name that is not valid text and cannot be printed.
_STEERING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def shown(text: str) -> str:
    r"""Return the text with escapes (``\x1b``) in place of characters that control a terminal."""
    return _STEERING.sub(lambda found: ascii(found[0])[1:-1], text)


class Escaped:
    """A stream that writes `shown` text; otherwise it behaves as the stream it wraps."""

    def __init__(self, stream: TextIO):
        self.unescaped = stream

    def write(self, text: str) -> int:
        """Write the escaped text."""
        return self.unescaped.write(shown(text))

    def writelines(self, lines: Iterable[str]) -> None:
        """Write several escaped texts."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str):
        return getattr(self.unescaped, name)


@contextmanager
def escaped() -> Iterator[None]:
    """Escape everything that is printed in this block (see `shown`)."""
    out, err = Escaped(sys.stdout), Escaped(sys.stderr)
    sys.stdout, sys.stderr = out, err
    try:
        yield
    finally:
        # A child process may have replaced the streams.
        if sys.stdout is out:
            sys.stdout = out.unescaped
        if sys.stderr is err:
            sys.stderr = err.unescaped


def aligned(rows: Iterable[Sequence[str]], gap: int = 2) -> str:
    """Format rows of texts as a table with aligned columns, at least ``gap`` spaces apart."""
    rows = [list(row) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ((text.ljust(width + gap) for text, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join("".join(line).rstrip() for line in lines)
