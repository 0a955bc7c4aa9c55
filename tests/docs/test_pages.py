"""Python on the hand-written pages runs and prints what they say it prints; commands on all pages exist."""

from __future__ import annotations

import ast
import importlib.util
import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from cfb_mjx.cli import main
from cfb_mjx.commands import COMMANDS, line
from cfb_mjx.commands.command import Command, Written
from cfb_mjx.control.policy_file import load_policy, shipped_policies
from cfb_mjx.parameters import load_model_file

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
# Numbers of a fit or a flight may differ a little between versions and processors.
RTOL, ATOL = 0.05, 0.011


def _script(name: str):
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


page_outputs = _script("page_outputs")


def _same(found: str, said: str) -> bool:
    if NUMBER.sub("#", found).split() != NUMBER.sub("#", said).split():
        return False
    pairs = [[float(x) for x in NUMBER.findall(text)] for text in (found, said)]
    return np.allclose(*pairs, rtol=RTOL, atol=ATOL)


@pytest.mark.xdist_group("pages")  # they share what one worker compiled
@pytest.mark.parametrize("name", page_outputs.PAGES)
def test_python_on_a_page_runs_and_prints_what_the_page_says(name, tmp_path, monkeypatch):
    page = DOCS / f"{name}.md"
    monkeypatch.chdir(tmp_path)
    for block, printed in zip(page_outputs.blocks(page.read_text()), page_outputs.run(page), strict=True):
        said = block.output or ""
        assert _same(printed, said), f"{page.name}, line {block.line}: prints\n{printed}\nwhere the page says\n{said}"


def test_outputs_are_written_below_their_blocks(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```python\nprint(1)\n```\n\n```text\nold\n```\n\n```python\nx = 2\n```\nEnd\n")
    written = page_outputs.written(page.read_text(), page_outputs.run(page))
    assert written == "```python\nprint(1)\n```\n\n```text\n1\n```\n\n```python\nx = 2\n```\nEnd\n"
    assert page_outputs.written(written, page_outputs.run(page)) == written


def _command_lines(page: Path):
    """``cfb ...`` lines of the shell blocks of a page, as words."""
    for block in re.findall(r"^```(?:sh|bash)\n(.*?)^```", page.read_text(), flags=re.S | re.M):
        for text in block.replace("\\\n", " ").splitlines():
            words = shlex.split(text, comments=True)
            for i, word in enumerate(words):
                if word == "cfb" and (i == 0 or words[i - 1] in ("&&", ";", "|")):
                    yield words[i + 1 :]


PAGES_WITH_COMMANDS = [p for p in [ROOT / "README.md", *sorted(DOCS.glob("*.md"))] if any(_command_lines(p))]


@pytest.fixture
def parsed(monkeypatch):
    """Parse a command line with the command's own parser, without running it; its exit status."""

    def parse(words: list[str]) -> int:
        if words[:1] in (["--help"], ["--version"]) or words[1:] == ["--help"]:
            return 0
        read = line.parse
        with monkeypatch.context() as patched:
            patched.setattr(line, "parse", lambda *words: read(*words) and Idle())
            return main(words)

    return parse


class Idle(Command):
    """What runs in place of a command."""

    def run(self) -> Written:
        return Written("")


@pytest.mark.parametrize("page", PAGES_WITH_COMMANDS, ids=lambda page: page.name)
def test_commands_on_a_page_parse(page, parsed, capsys):
    for words in _command_lines(page):
        words = [word for word in words if word not in ("...",)]
        status = parsed(words)
        assert status == 0, f"{page.name}: cfb {shlex.join(words)}\n{capsys.readouterr()}"


def test_the_check_of_commands_would_notice(parsed, capsys):
    assert parsed(["evaluate", "a.mcap", "--figure", "a.png"]) == 0
    assert parsed(["evaluate", "a.mcap", "--figures", "a.png"]) == 2
    assert parsed(["evaluates", "a.mcap"]) == 2
    assert parsed(["fly", "target", "--task", "stand"]) == 2
    capsys.readouterr()


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_in_the_help_parse(name, parsed, capsys):
    for example in COMMANDS[name].examples:
        assert parsed(shlex.split(example)[1:]) == 0, f"{example}\n{capsys.readouterr()}"


def test_the_quick_commands_of_the_tutorial_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = list(_command_lines(DOCS / "tutorial.md"))
    for quick in (["version"], ["export", "target", "-o", "target-c"]):
        assert quick in words
        assert main(quick) == 0
    assert (tmp_path / "target-c" / "contract.json").exists()
    capsys.readouterr()


def _strings(path: Path):
    """All strings of a source file; what is filled in stands as an ellipsis."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.JoinedStr):
            yield "".join(part.value if isinstance(part, ast.Constant) else "..." for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_messages_in_the_remedies_are_those_of_the_code():
    said = "\n".join(text for path in (ROOT / "src").rglob("*.py") for text in _strings(path))
    headings = re.findall(r"^### (.*)$", (DOCS / "faq.md").read_text(), flags=re.M)
    quoted = [text for heading in headings for text in re.findall(r'"([^"]+)"', heading)]
    assert len(quoted) > 10
    foreign = {"Reverse-mode differentiation does not work for lax.while_loop"}  # jax's own
    for text in set(quoted) - foreign:
        for part in filter(None, (part.strip(" ;,") for part in text.split("..."))):
            assert part in said, f"no message of the library says: {part}"


def test_cards_of_policies_say_what_was_measured():
    """With other results under benchmarks, or another policy, `scripts/policy_cards.py` writes others."""
    cards = _script("policy_cards")
    assert len(shipped_policies()) == 7
    for name, path in shipped_policies().items():
        assert path.with_name("card.md").read_text() == cards.card(path.parent), name
        assert load_policy(path).card == path.with_name("card.md").read_text(), f"{name}: the file has another card"


def test_the_page_of_controllers_says_what_was_measured(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    measured = json.loads((ROOT / "benchmarks" / "controllers.json").read_text())
    plants = measured["target"]["drones"]
    written = _script("measure_controllers").page(measured, plants, load_model_file("cfb-guards"))
    assert written == (DOCS / "controllers.md").read_text()


def test_pages_speak_of_the_project_only():
    for page in [*DOCS.rglob("*.md"), *DOCS.rglob("*.ipynb")]:
        text = page.read_text()
        for word in ("/tmp/", "/work/", "/root/", "/home/"):
            assert word not in text, f"{page.name} names a place on some machine: {word}"
