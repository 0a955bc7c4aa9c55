"""Files that people write: whatever they say, a reader takes it or answers with one sentence."""

from __future__ import annotations

import copy
import datetime
from contextlib import suppress
from functools import cache
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfb_mjx import documents
from cfb_mjx.commands import Fly, load
from cfb_mjx.control.manoeuvre import load_manoeuvre
from cfb_mjx.documents import load_yaml, parse_yaml, told
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.logs.crazyswarm import _custom_topics
from cfb_mjx.logs.variables import load_mapping
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_model_file, load_randomisation
from cfb_mjx.sweep import load_sweep, tasks_of
from cfb_mjx.train.config import FlipTrainingConfig, TrainingConfig, load_config, with_changes
from cfb_mjx.train.flying import load_plants

SWEEP = {
    "format": "cfb_mjx sweep 1",
    "description": "some",
    "command": "train",
    "arguments": {"task": "target", "config": "quick-analytic", "set": {"randomisation.magnitude": 0.5}},
    "over": {"seed": [0, 1], "algorithm": ["ppo"]},
    "each": [{"name": "a", "set": {"reward.position_width_m": 1}}],
    "cpus": 1,
    "gpus": 0,
}
TOPICS = {
    "all": {"firmware_logging": {"custom_topics": {"a": {"vars": ["stateEstimate.x"]}}}},
    "robots": {"cf1": {"type": "cf21", "firmware_logging": {"custom_topics": {"b": {"vars": ["gyro.x"]}}}}},
    "robot_types": {"cf21": {"firmware_logging": {}}},
}


def written(*parts: str) -> dict:
    return load_yaml(shipped("configs", *parts))


DRAG = [{"name": "rotor_drag", "parameters": {"coefficient": 0.01}, "source": "a test"}]
PLANTS = written("plants", "off-nominal.yaml")
READERS = {
    "training": (TrainingConfig().to_mapping(), load_config),
    "flip training": (FlipTrainingConfig().to_mapping(), load_config),
    "sweep": (SWEEP, lambda path: tasks_of(load_sweep(path, load))),
    "manoeuvre": (written("manoeuvres", "double-flip.yaml"), load_manoeuvre),
    "randomisation": (written("randomisation", "paper.yaml"), load_randomisation),
    "model": (written("parameters", "cfb.yaml") | {"effects": DRAG}, Quadrotor.from_file),
    "plants": (PLANTS | {"plants": PLANTS["plants"][:3]}, lambda path: load_plants(load_model_file("cfb"), path)),
    "variables": (written("logs", "crazyflie.yaml"), load_mapping),
    "topics": (TOPICS, lambda path: _custom_topics(path, "cf1")),
}
NUMBERS = st.one_of(
    st.integers(),
    st.sampled_from([10**18, 2**63, -(2**64), 10**30, 10**400, 0, -1]),
    st.floats(),
)
KEYS = st.one_of(st.text(max_size=5), st.integers(), st.booleans(), st.none(), st.dates(), st.floats(allow_nan=False))
VALUES = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        NUMBERS,
        st.text(max_size=20),
        st.sampled_from(["target", "flip", "yes", "1e-3", "{seed}", "x" * 5000, "a\nb", "\x1b[2J", "rotor_drag"]),
        st.binary(max_size=5),
        st.dates(),
        st.datetimes(timezones=st.sampled_from([None, datetime.UTC])),
        st.sets(st.integers(), max_size=2),
    ),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=8,
)


def places(document, here=()):
    """Paths of every value in a document, of groups too."""
    yield here
    if isinstance(document, dict | list):
        for key, value in document.items() if isinstance(document, dict) else enumerate(document):
            yield from places(value, (*here, key))


def changed(document, place, value):
    if not place:
        return value
    document = copy.deepcopy(document)
    inner = document
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return document


@pytest.fixture
def answers(tmp_path, monkeypatch):
    """What a reader says of a document: None, or a sentence that names the file."""
    path, said = tmp_path / "mine.yaml", []
    path.write_text("")
    load = cache(documents.yaml.load)
    instead = SimpleNamespace(load=lambda text, Loader: load(text, Loader) if text else said[-1])
    monkeypatch.setattr(documents, "yaml", SimpleNamespace(**vars(documents.yaml) | vars(instead)))

    def of(read, document) -> str | None:
        said.append(document)
        try:
            read(path)
        except CfbError as refusal:
            sentence = str(refusal)
        else:
            return None
        assert sentence.startswith(str(path)) or "no such" in sentence or "model " in sentence, sentence
        assert len(sentence) < 3000, sentence
        return sentence

    return of


@pytest.mark.filterwarnings("ignore::cfb_mjx.errors.CfbWarning")
@pytest.mark.parametrize("name", READERS)
def test_any_value_anywhere_is_taken_or_refused_in_a_sentence(name, answers):
    document, read = READERS[name]
    assert answers(read, document) is None

    @settings(max_examples=100, deadline=None, derandomize=True)
    @given(st.sampled_from(sorted(places(document), key=repr)), VALUES)
    def check(place, value):
        answers(read, changed(document, place, value))

    check()


@pytest.mark.filterwarnings("ignore::cfb_mjx.errors.CfbWarning")
@pytest.mark.parametrize("name", READERS)
def test_wrong_kinds_at_every_key_are_taken_or_refused_in_a_sentence(name, answers):
    document, read = READERS[name]
    for place in places(document):
        for value in ([], ["target"], {}, {"a": [1]}, None, True, "x", -1, 10**400, 16**5000, float("inf"), 5):
            answers(read, changed(document, place, value))


@pytest.mark.parametrize(
    "text",
    [
        "a: !!bool x",
        "a: !!int ''",
        "a: !!int abc",
        "a: !!float x",
        "a: !!timestamp x",
        "a: 2026-13-45",
        "? !!set {a}\n: 1",
        "? [a]\n: 1",
        "a: &a [*a]",
        "&a {b: *a}",
        "a: 1\na: 2",
        "a: " + "[" * 1000,
        "a: 0x" + "f" * 6000,
        "a: " + "9" * 6000,
        "<<: 5",
        "a: *nobody",
        "a: !!python/object:os.system x",
        "\0",
        "a: !!binary é",
    ],
    ids=lambda text: text[:20],
)
def test_what_is_no_document_is_refused_in_a_sentence(text, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(text, encoding="utf-8", newline="")
    with pytest.raises(CfbError, match=r"mine\.yaml: is not valid YAML"):
        load_yaml(path)


@settings(max_examples=300, derandomize=True)
@given(
    st.lists(
        st.sampled_from([*"ab12:-?[]{}&*!,#|>'\"%@ \n\t", "!!set ", "!!int ", "!!omap ", "&x ", "*x", "<<", "---\n"]),
        max_size=12,
    ).map("".join)
)
def test_any_text_is_read_or_refused(text):
    with suppress(CfbError):
        parse_yaml(text, "here")


def test_repeated_anchors_are_neither_walked_nor_quoted_over_and_over():
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 30)]
    assert len(told(parse_yaml("\n".join(lines), "here"))) < 200


@pytest.mark.parametrize("change", ["seed=!!bool x", "seed=2026-13-45", "seed=[", "seed=&a [*a]", "seed=: : :"])
def test_changes_on_the_command_line_are_read_as_strictly(change):
    with pytest.raises(CfbError, match=r"--set"):
        load_config("target", (change,))
    with pytest.raises(CfbError, match=r"--set"):
        load_manoeuvre("flip", (change.replace("seed", "climb_s"),))


def test_seeds_that_jax_would_cut_short_are_refused():
    assert load_config("target", (f"seed={2**32 - 1}",)).seed == 2**32 - 1
    for seed in (-1, 2**32):
        with pytest.raises(CfbError, match=f"seed = {seed} must be from 0 to"):
            load_config("target", (f"seed={seed}",))
        with pytest.raises(CfbError, match=f"--seed {seed} must be from 0 to"):
            with_changes(load_config("target"), seed=seed)
        with pytest.raises(CfbError, match=f"--seed {seed} must be from 0 to"):
            Fly("pid", seed=seed).run()
