"""Self-contained HTML pages: text, tables and figures in one file."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cfb_mjx.files import read_bytes

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 74rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
p { max-width: 52rem; } img { width: 100%; border: 1px solid #e4e4e4; margin: .6rem 0; }
table { border-collapse: collapse; font-size: .8rem; } caption { text-align: left; padding: .3rem 0; color: #555; }
th, td { padding: .15rem .5rem; text-align: right; border-bottom: 1px solid #e4e4e4; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } .table { overflow-x: auto; }
footer { margin-top: 2.5rem; color: #555; font-size: .9rem; }
"""
_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}


@dataclass(frozen=True)
class Section:
    """A heading followed by paragraphs, tables and figures, in this order.

    Attributes:
        title: heading.
        paragraphs: plain text.
        tables: (caption, header, rows) of each table, with cells as text.
        figures: (file, alternative text) of each figure; PNG or SVG, embedded in the page.
    """

    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[tuple[str, Sequence[str], Sequence[Sequence[str]]]] = ()
    figures: Sequence[tuple[Path, str]] = ()


def html_page(title: str, lead: str, sections: Sequence[Section], footer: Mapping[str, object]) -> str:
    """Build a self-contained page.

    Args:
        title: heading of the page.
        lead: first paragraph.
        sections: the sections after it.
        footer: facts on which the results depend (date, machine, versions), printed at the end.

    Returns:
        The HTML as text.
    """
    body = "\n".join(_section(section) for section in sections)
    facts = " · ".join(f"{html.escape(str(key))} {html.escape(str(value))}" for key, value in footer.items())
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{html.escape(title)}</h1>\n<p>{html.escape(lead)}</p>\n{body}\n<footer>{facts}</footer>\n</body>\n</html>\n"
    )


def _section(section: Section) -> str:
    parts = [f"<h2>{html.escape(section.title)}</h2>"]
    parts += [f"<p>{html.escape(text)}</p>" for text in section.paragraphs]
    parts += [_table(*table) for table in section.tables]
    parts += [_figure(*figure) for figure in section.figures]
    return "\n".join(parts)


def _table(caption: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    lines = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
    body = "\n".join(f"<tr>{line}</tr>" for line in lines)
    return (
        f'<div class="table"><table><caption>{html.escape(caption)}</caption>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


def _figure(path: Path, alternative: str) -> str:
    # An image element, because the ids of two inline SVG figures could collide.
    data = base64.b64encode(read_bytes(path)).decode("ascii")
    return f'<img alt="{html.escape(alternative)}" src="data:{_TYPES[Path(path).suffix]};base64,{data}">'
