"""Run the Python blocks of hand-written pages and write their output below them.

    python scripts/page_outputs.py [docs/tutorial.md ...]

The blocks of a page run in order and share a namespace. A ``text`` block directly after a ``python`` block holds its
output. tests/docs/test_pages.py runs the same pages and compares the output.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
import tempfile
import types
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    *("tutorial", "my-drone", "train-and-deploy", "choosing", "adding-an-effect", "effects", "faq", "scaling"),
    "swarms",
    "tracking",
    "scenes",
)
BLOCK = re.compile(r"^```python\n(?P<code>.*?)^```\n(?:\n```text\n(?P<output>.*?)^```\n)?", re.S | re.M)


@dataclass(frozen=True)
class Block:
    """A Python block of a page."""

    code: str
    output: str | None
    """Its output according to the page; None for no output."""
    line: int


def blocks(text: str) -> list[Block]:
    """Return the Python blocks of a page."""
    return [Block(m["code"], m["output"], text[: m.start()].count("\n") + 2) for m in BLOCK.finditer(text)]


def run(page: Path) -> list[str]:
    """Run the blocks of a page in the current folder; return the output of each, without trailing spaces."""
    module = types.ModuleType(f"page_{page.stem.replace('-', '_')}")
    sys.modules[module.__name__] = module  # dataclasses look up their module here
    printed = []
    for block in blocks(page.read_text(encoding="utf-8")):
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            # Leading empty lines make a traceback name the line of the page.
            exec(compile("\n" * (block.line - 1) + block.code, str(page), "exec"), module.__dict__)
        printed.append("".join(f"{line.rstrip()}\n" for line in out.getvalue().splitlines()))
    return printed


def written(text: str, printed: list[str]) -> str:
    """Return the page with the given output below each block."""
    outputs = iter(printed)

    def replaced(match: re.Match) -> str:
        output = next(outputs)
        return f"```python\n{match['code']}```\n" + (f"\n```text\n{output}```\n" if output else "")

    return BLOCK.sub(replaced, text)


def main(pages: list[Path]) -> None:
    """Update the outputs on the given pages."""
    from cfb_mjx.runtime import configure_jax

    configure_jax(x64=True)
    for page in pages:
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            printed = run(page)
        before = page.read_text(encoding="utf-8")
        page.write_text(written(before, printed), encoding="utf-8")
        print(f"{os.path.relpath(page)}: {len(printed)} blocks")


if __name__ == "__main__":
    main([Path(p).resolve() for p in sys.argv[1:]] or [ROOT / "docs" / f"{name}.md" for name in PAGES])
