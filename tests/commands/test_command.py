"""Commands as objects: made from Python or from a line they are the same, and what cannot be is refused when made."""

import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cfb_mjx
from cfb_mjx.commands import COMMANDS, load
from cfb_mjx.commands.command import Ending, default_of, held
from cfb_mjx.commands.fit import Fit
from cfb_mjx.commands.fly import Fly
from cfb_mjx.commands.import_log import Import
from cfb_mjx.commands.line import parse
from cfb_mjx.commands.sweep import Sweep
from cfb_mjx.commands.train import Train
from cfb_mjx.errors import CfbError
from cfb_mjx.train.config import load_config

WORD = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)


def values_of(hint):
    """What an argument may hold, as a strategy."""
    kind, marks = held(hint), getattr(hint, "__metadata__", ())
    if kind is bool:
        return st.booleans()
    if kind is int:
        return st.integers(1, 50)
    if kind is float:
        return st.floats(0.125, 64.0, allow_nan=False)
    if kind is Path:
        ending = next((mark.endings[0] for mark in marks if isinstance(mark, Ending)), "")
        return WORD.map(lambda word: Path(f"{word}{ending}"))
    if choices := get_args(kind):
        if isinstance(choices[0], str):
            return st.sampled_from(choices)
        one = choices[0]
        if get_args(one):
            return st.lists(st.tuples(WORD, WORD).map("=".join), max_size=3).map(tuple)
        each = st.integers(1, 9) if one is int else WORD.map(one)
        return st.lists(each, min_size=1, max_size=3).map(tuple)
    return WORD


@pytest.mark.parametrize("name", COMMANDS)
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_a_command_and_the_line_of_its_words_are_the_same(name, data):
    kind = load(name)
    hints = get_type_hints(kind, include_extras=True)
    arguments = {}
    for one in fields(kind):
        required = default_of(one) is not None and repr(default_of(one)).startswith("<dataclasses._MISSING")
        if required or data.draw(st.booleans()):
            arguments[one.name] = data.draw(values_of(hints[one.name]))
    made = kind(**arguments)
    assert parse(name, made.words()) == made


def test_python_may_say_it_shorter():
    light, slow = "mass=0.04", "inertia=1e-05,2e-05,3e-05"
    plain = Fit((Path("a.mcap"),), Path("m.yaml"), set=(light, slow))
    assert plain == Fit("a.mcap", "m.yaml", set={"mass": 0.04, "inertia": [1e-5, 2e-5, 3e-5]})
    assert plain == Fit(["a.mcap"], "m.yaml", set=[light, slow])
    assert plain == parse("fit", ["a.mcap", "-o", "m.yaml", "--set", light, "--set", slow])
    # A training reads YAML there, a model numbers with commas.
    trained = Train("target", "out", set={"network.hidden": [8, 8], "reward.near": None})
    assert trained.set == ("network.hidden=[8, 8]", "reward.near=null")
    assert load_config("target", trained.set[:1]).network.hidden == (8, 8)
    assert Import("a.csv", "a.mcap", cut=":3").cut == (":3",)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Sweep("randomisation", "out", workers=0), "--workers 0: must be at least 1."),
        (lambda: Sweep("randomisation", "out", retries=-1), "--retries -1: must be at least 0."),
        (lambda: Train("targets", "out"), "--task targets: choose from target, flip, track."),
        (lambda: Fly("pid", task="stand"), "--task stand: choose from hover"),
        (lambda: Fit("a.mcap", "model.json"), "model.json: the output is a model and must end in .yaml."),
        (lambda: Fit("a.mcap", "m.yaml", figure="f.bmp"), "f.bmp: a figure must end in"),
    ],
)
def test_what_cannot_be_is_refused_when_the_command_is_made(make, said):
    with pytest.raises(CfbError) as refused:
        make()
    assert said in str(refused.value)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_begins_with_examples_and_is_in_words(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        parse(name, ["--help"])
    text = capsys.readouterr().out
    assert text.index("Examples:") < text.index(f"cfb {name}", text.index("Examples:")) < text.index("options")
    for never in ("{None}", "(default: )", "(default: None)", "[None]"):
        assert never not in text


def test_every_field_of_every_command_is_documented(capsys):
    for name in COMMANDS:
        own = {field.name for field in fields(load(name))}
        said = "".join(kind.__doc__ or "" for kind in load(name).__mro__)
        assert [field for field in own if field != "plugin" and f"\n        {field}:" not in said] == [], name


def test_all_that_the_package_promises_is_there_and_costs_nothing_before():
    code = (
        "import sys, cfb_mjx as cfb; before = {'jax', 'numpy', 'tyro'} & set(sys.modules); "
        "print(sorted(before), all(getattr(cfb, name) is not None for name in cfb.__all__))"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[] True\n"
    named = {*cfb_mjx._PACKAGES, *cfb_mjx._FUNCTIONS, "__version__", "load"}
    assert named <= set(cfb_mjx.__all__)
    assert set(cfb_mjx.__all__) - named <= {load(name).__name__ for name in COMMANDS}
    with pytest.raises(AttributeError, match="no attribute 'no_such'"):
        _ = cfb_mjx.no_such
