"""``cfb reproduce`` as a user types it."""

import json
import re
from pathlib import Path

import pytest

from cfb_mjx import cli, reproduce
from cfb_mjx.commands import reproduce as command
from cfb_mjx.files import replacing
from cfb_mjx.reproduce.item import Item, Result, Row, write_csv


def test_what_is_asked_for_is_made_and_nothing_else(cfb, tmp_path):
    done = cfb("reproduce", "rotor-curves", "parameters", "--format", "pdf", "-o", tmp_path / "paper")
    assert done.returncode == 0, done.stderr
    names = {path.name for path in (tmp_path / "paper").iterdir()}
    made = {"parameters.csv", "rotor-curves.csv", "rotor-curves.png", "rotor-curves.pdf"}
    assert names == {"index.html", "paper.md", "paper.json", *made}
    rows = json.loads((tmp_path / "paper" / "paper.json").read_text())["rows"]
    assert list(rows) == ["parameters", "rotor-curves"]  # in the paper's order, whatever was typed
    html = (tmp_path / "paper" / "index.html").read_text()
    assert "Thrust and torque" in html
    assert not re.search(r'(src|href)="(?!data:)', html)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("figure-7",), "figure-7: cannot be reproduced; choose from all, parameters"),
        (("parameters", "--real", "."), "leave --real out"),
    ],
)
def test_mistakes_get_a_sentence(cfb, tmp_path, arguments, sentence):
    done = cfb("reproduce", *arguments, "-o", tmp_path / "paper", cwd=tmp_path)
    assert done.returncode == 2
    assert sentence in done.stderr
    assert not (tmp_path / "paper").exists()


def test_the_help_names_every_item(cfb):
    from cfb_mjx.reproduce import ITEMS

    text = " ".join(cfb("reproduce", "--help").stdout.replace("\u2502", " ").split())
    for name in ITEMS:
        assert name in text


@pytest.fixture
def items(monkeypatch):
    """Three items that are made at once, what was made of them, and which of them is interrupted."""
    made, stopped = [], []

    def item(name):
        def make(folder, real):
            if name in stopped:
                raise KeyboardInterrupt
            made.append(name)
            write_csv(folder / f"{name}.csv", ("x",), [(1,)])
            with replacing(folder / f"{name}.png") as temporary:
                temporary.write_bytes(b"a figure")
            rows = [Row(f"{name} | x", "1", "2", "because"), Row("y", "", "3", kind="input")]
            return Result(
                f"Title {name}", ["Text."], rows, [(folder / f"{name}.png", "alt")], [("t", ("h",), [("c",)])]
            )

        return Item(name, make, False)

    monkeypatch.setattr(reproduce, "ITEMS", {name: item(name) for name in ("one", "two", "three")})
    monkeypatch.setattr("cfb_mjx.runtime.environment", lambda: {"date": "today"})
    return made, stopped


def test_a_run_stopped_at_the_third_item_shows_two_and_goes_on_with_the_third(items, tmp_path, monkeypatch, capsys):
    made, stopped = items
    stopped.append("three")
    arguments = ["reproduce", "all", "-o", str(tmp_path)]
    assert cli.main(arguments) == 130
    page, text = ((tmp_path / name).read_text() for name in ("index.html", "paper.md"))
    for shown in (page, text):
        assert "Title two" in shown
        assert "Not made yet: three; the same command continues with them." in shown
    assert json.loads((tmp_path / "paper.json").read_text())["left"] == ["three"]
    stopped.clear()
    assert cli.main(arguments) == 0
    assert made == ["one", "two", "three"]
    assert "continuing with the rest" in capsys.readouterr().err
    continued = {name: (tmp_path / name).read_bytes() for name in ("index.html", "paper.md", "paper.json")}
    assert b"Not made yet" not in continued["index.html"]
    # One that came to its end is made anew, and comes out the same.
    assert cli.main(arguments) == 0
    assert made == ["one", "two", "three"] * 2
    assert {name: (tmp_path / name).read_bytes() for name in continued} == continued


@pytest.mark.parametrize("change", ["code", "names", "figure", "page"])
def test_what_was_made_by_another_code_or_is_gone_is_made_anew(items, tmp_path, monkeypatch, change):
    made, stopped = items
    stopped.append("three")
    arguments = ["reproduce", "all", "-o", str(tmp_path)]
    assert cli.main(arguments) == 130
    stopped.clear()
    made.clear()
    if change == "code":
        monkeypatch.setattr(command, "code_identity", lambda: "another")
    elif change == "figure":
        (tmp_path / "one.png").unlink()
    elif change == "page":
        (tmp_path / "paper.json").write_text("[]")
    else:
        arguments[1:2] = ["one", "two"]
    assert cli.main(arguments) == 0
    expected = {"code": ["one", "two", "three"], "page": ["one", "two", "three"]}
    assert made == expected.get(change, ["one", "three"] if change == "figure" else ["one", "two"])


def test_an_item_that_fails_leaves_its_own_figures_as_they_were(items, tmp_path, monkeypatch):
    assert cli.main(["reproduce", "one", "-o", str(tmp_path)]) == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def half(folder, real):
        write_csv(folder / "one.csv", ("x",), [(2,)])
        raise KeyboardInterrupt

    monkeypatch.setitem(reproduce.ITEMS, "one", Item("one", half, False))
    assert cli.main(["reproduce", "one", "-o", str(tmp_path)]) == 130
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["all", "--flights", "."],
            "--flights: name the items that use them, of brushed, hover-to-forward, yaw-disturbance",
        ),
        (["brushed", "yaw-disturbance", "--flights", "."], "name brushed alone"),
        (["parameters", "--flights", "."], "name the items that use them"),
        (["brushed", "--mass", "0.03"], "--mass is the mass of the drone of --flights"),
        (["brushed", "--flights", ".", "--mass", "34.7"], "--mass 34.7: must be in kg"),
        (["brushed", "--flights", "nowhere"], "nowhere: there is no such folder"),
        (["brushed", "--flights", "."], "holds no flight logs"),
    ],
)
def test_flights_are_for_what_they_fit(tmp_path, monkeypatch, capsys, arguments, sentence):
    (tmp_path / "README.md").write_text("no log")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["reproduce", *arguments, "-o", "paper"]) == 2
    assert sentence in capsys.readouterr().err
    assert not Path("paper").exists()
