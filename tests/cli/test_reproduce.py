"""``cfb reproduce`` as a user types it."""

import json
import re

import pytest


def test_what_is_asked_for_is_made_and_nothing_else(cfb, tmp_path):
    done = cfb("reproduce", "rotor-curves", "parameters", "-o", tmp_path / "paper")
    assert done.returncode == 0, done.stderr
    names = {path.name for path in (tmp_path / "paper").iterdir()}
    made = {"parameters.csv", "rotor-curves.csv", "rotor-curves.png"}
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
