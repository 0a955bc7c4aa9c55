"""The site builds without a warning, offline, and holds every page, every command and every notebook."""

from __future__ import annotations

import importlib.util
import inspect
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from cfb_mjx.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
# Built once.
pytestmark = pytest.mark.xdist_group("site")
MISSING = [name for name in ("mkdocs", "material", "mkdocstrings") if importlib.util.find_spec(name) is None]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    if MISSING:
        pytest.skip(f"{', '.join(MISSING)} not installed; pip install '.[docs]'")
    out = tmp_path_factory.mktemp("site")
    # What `make docs` does, by this Python and into another folder.
    recipe = re.search(r"^docs:.*\n\t(.+)\n", (ROOT / "Makefile").read_text(), flags=re.M)[1]
    assert "--strict" in recipe
    assert "$(BIN)/mkdocs " in recipe
    command = (
        recipe.replace("$(BIN)/mkdocs", f"{shlex.quote(sys.executable)} -m mkdocs") + f" -d {shlex.quote(str(out))}"
    )
    done = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stdout + done.stderr
    return out


def test_every_page_is_there(site):
    for page in (ROOT / "docs").rglob("*.md"):
        name = page.relative_to(ROOT / "docs").with_suffix(".html")
        assert (site / name).exists(), name
    assert (site / "changes.html").exists()


def test_lists_within_lists_are_lists(site):
    text = (site / "closing-the-loop.html").read_text()
    assert re.search(r"<ol>(?:(?!</ol>).)*<ul>\s*<li>\s*(?:<p>)?every absent effect", text, flags=re.S)
    for page in site.glob("*.html"):
        assert not re.search(r"<p>(?:(?!</p>).)*\n- ", page.read_text(), flags=re.S), page.name


def test_every_command_is_explained(site):
    text = (site / "cli.html").read_text()
    for name in COMMANDS:
        assert f'id="cfb-{name}"' in text
    assert "--held-out" in text
    assert "[1m" not in text  # no terminal colours


def test_notebooks_show_their_figures(site):
    for name in ("first_flight", "identify"):
        text = (site / "notebooks" / f"{name}.html").read_text()
        figures = re.findall(rf'src="({name}-\d\.png)"', text)
        assert len(figures) == 2
        assert all((site / "notebooks" / figure).stat().st_size > 1000 for figure in figures)


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "api").glob("*.md")), ids=lambda page: page.stem)
def test_the_reference_documents_all_that_is_public(site, page):
    text = (site / "api" / f"{page.stem}.html").read_text()
    for name in re.findall(r"^::: (cfb_mjx[\w.]*)$", page.read_text(), flags=re.M):
        assert f'id="{name}"' in text
        try:
            package = importlib.import_module(name)
        except ModuleNotFoundError:  # a class or function
            continue
        for public in getattr(package, "__all__", ()):
            item = getattr(package, public)
            if inspect.isclass(item) or inspect.isfunction(item):
                # A function with the name of its module is documented by its full path.
                assert any(f'id="{place}.{public}"' in text for place in (name, item.__module__)), public


def test_pages_load_nothing_from_other_servers(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*\bsrc="(?:https?:)?//[^"]*"', text)
        loaded += re.findall(r'<link[^>]*\bhref="(?:https?:)?//[^"]*"', text)
        assert not loaded, f"{page.relative_to(site)} loads {loaded}"
