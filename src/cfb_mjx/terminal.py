"""What reaches the terminal: names of files and words of other programs, but not what would steer it."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TextIO

# Controls but for tab and newline, what turns the direction of writing, other ends of lines, and lone surrogates: bytes
# of a file's name that are no text, and cannot be printed.
_STEERING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def shown(text: str) -> str:
    r"""The text with escapes (``\x1b``) in place of characters that a terminal would obey."""
    return _STEERING.sub(lambda found: ascii(found[0])[1:-1], text)


class Escaped:
    """A stream whose text is `shown`; in everything else the one it is made of."""

    def __init__(self, stream: TextIO):
        self.unescaped = stream

    def write(self, text: str) -> int:
        """Write what may be shown of a text."""
        return self.unescaped.write(shown(text))

    def writelines(self, lines: Iterable[str]) -> None:
        """Write what may be shown of several."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str):
        return getattr(self.unescaped, name)


@contextmanager
def escaped() -> Iterator[None]:
    """Let all that is printed in this block, by whomever, be `shown`."""
    out, err = Escaped(sys.stdout), Escaped(sys.stderr)
    sys.stdout, sys.stderr = out, err
    try:
        yield
    finally:
        # A child process may have put others in their place.
        if sys.stdout is out:
            sys.stdout = out.unescaped
        if sys.stderr is err:
            sys.stderr = err.unescaped


def aligned(rows: Iterable[Sequence[str]], gap: int = 2) -> str:
    """Rows of texts as a table: columns as wide as what stands in them, apart by at least ``gap`` spaces."""
    rows = [list(row) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ((text.ljust(width + gap) for text, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join("".join(line).rstrip() for line in lines)
