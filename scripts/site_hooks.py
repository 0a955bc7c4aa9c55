"""Additions to docs/ while the documentation site is built (`hooks` in mkdocs.yml).

- `cli.md` gets the help of every command from the parsers, so the page is always up to date.
- CHANGELOG.md becomes the page `changes.md`.
- Notebooks become pages with their text, code, output and figures. (mkdocs-jupyter could do this too, but needs forty
  more packages, and its pages load scripts from other servers.)
- Lists are indented for Python-Markdown; the pages are written for GitHub.
- Files of the repository that pages link to (``../configs/...``) become part of the site, so that no link leaves it.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = "<!-- commands -->"
"""Place of the commands in `cli.md`."""
NOTEBOOK = re.compile(r"\]\(((?!https?:)[^)#\s]+)\.ipynb\)")
OUTSIDE = re.compile(r"\]\(((?:\.\./)+[^)#\s]+)((?:#[^)\s]*)?)\)")
WIDTH = "100"
ITEM = re.compile(r"( *)([-*]|\d+\.) +")


def on_files(files, config):
    """Add the changelog, the notebooks' pages and the linked files."""
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").replace("](docs/", "](")
    files.append(File.generated(config, "changes.md", content=changes))
    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        _add_notebook(files, notebook, config)
    for page in [file for file in files if file.src_uri.endswith(".md") and file.abs_src_path]:
        for target, _ in OUTSIDE.findall(Path(page.abs_src_path).read_text(encoding="utf-8")):
            found = _outside(page.src_uri, target)
            if found is not None and files.get_file_from_path(_copied(found)) is None:
                files.append(File.generated(config, _copied(found), abs_src_path=str(ROOT / found)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Insert the commands; redirect links out of docs/ to the copies of the files."""
    if page.file.src_uri == "cli.md":
        markdown = markdown.replace(COMMANDS, commands())

    def led(match):
        found = _outside(page.file.src_uri, match[1])
        if found is None:
            return match[0]
        to = "changes.md" if found == "CHANGELOG.md" else _copied(found)
        return f"]({posixpath.relpath(to, posixpath.dirname(page.file.src_uri) or '.')}{match[2]})"

    return lists(NOTEBOOK.sub(r"](\1.md)", OUTSIDE.sub(led, markdown)))


def _add_notebook(files, notebook: File, config) -> None:
    """Add the page and the figures of a notebook; the notebook itself stays available for download."""
    name = notebook.src_uri.removesuffix(".ipynb")
    cells = json.loads(Path(notebook.abs_src_path).read_text(encoding="utf-8"))["cells"]
    text, figures = notebook_page(cells, posixpath.basename(name))
    for path, content in figures.items():
        files.append(File.generated(config, posixpath.join(posixpath.dirname(name), path), content=content))
    files.append(File.generated(config, f"{name}.md", content=text))


def notebook_page(cells: list[dict], name: str) -> tuple[str, dict[str, bytes]]:
    """Return the Markdown of an executed notebook, and its figures by path."""
    parts, figures = [], {}
    for cell in cells:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                path = f"{name}-{len(figures) + 1}.png"
                figures[path] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![figure]({path})")
            elif text := "".join(output.get("text", data.get("text/plain", ""))).rstrip():
                parts.append(f"```text\n{text}\n```")
    return "\n\n".join(parts) + "\n", figures


def _outside(page: str, target: str) -> str | None:
    """Return the path from the repository's root of a link target outside docs/; None if inside or not a file."""
    path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), target))
    return None if path.startswith(("docs/", "../")) or not (ROOT / path).is_file() else path


def _copied(path: str) -> str:
    """Return the path of a copied file in the site; the suffix makes browsers show it and mkdocs ignore it."""
    return f"files/{path}.txt"


def lists(markdown: str) -> str:
    """Convert lists from GitHub's rules to Python-Markdown's: four spaces per level, an empty line before a list."""
    out, fenced, levels = [""], False, []
    for line in markdown.split("\n"):
        text, item = line.lstrip(" "), None if fenced else ITEM.match(line)
        indent = len(line) - len(text)
        # Within a paragraph, only these begin a list on GitHub.
        if item and (levels or not out[-1] or text.startswith(("- ", "* ", "1. "))):
            if not levels and out[-1]:
                out.append("")
            while levels and indent < levels[-1]:
                levels.pop()
            out.append("    " * len(levels) + text)
            levels.append(item.end())
        elif text and levels and indent >= levels[0]:
            while not fenced and indent < levels[-1]:
                levels.pop()
            out.append("    " * len(levels) + " " * (indent - levels[-1]) + text)
        else:
            if text and not indent and (not out[-1] or text.startswith(("#", "|", "```"))):
                levels = []
            out.append(line)
        if text.startswith("```"):
            fenced = not fenced
    return "\n".join(out[1:])


def commands() -> str:
    """Return the help of every command, as Markdown."""
    from cfb_mjx.commands import COMMANDS

    parts = [f"| command | does |\n|---|---|\n{_rows({name: entry.summary for name, entry in COMMANDS.items()})}"]
    parts += [f"## cfb {name}\n\n```text\n{help_of(name)}\n```" for name in COMMANDS]
    return "\n\n".join(parts)


def _rows(summary: dict[str, str]) -> str:
    return "\n".join(f"| [`cfb {name}`](#cfb-{name}) | {text} |" for name, text in summary.items())


def help_of(command: str) -> str:
    """Return the output of ``cfb COMMAND --help``, without colours and with a fixed width."""
    from cfb_mjx.cli import main

    printed = io.StringIO()
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = WIDTH
    try:
        with contextlib.redirect_stdout(printed):
            main([command, "--help"])
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before
    lines = re.sub(r"\x1b\[[0-9;]*m", "", printed.getvalue()).splitlines()
    return "\n".join(line.rstrip() for line in lines).strip()
