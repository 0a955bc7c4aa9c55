"""The state of a search on disk: whole, and taken up only by what it belongs to."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.model.effects import CATALOGUE, ParasiticDrag, RotorDrag
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid.tracing import checkpoint
from cfb_mjx.sysid.tracing.checkpoint import Checkpoint, Progress, identity
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis


@pytest.fixture
def nothing():
    effects = tuple(kind.neutral() for kind in CATALOGUE.values())
    return Hypothesis(effects, origin=effects)


@pytest.fixture
def logs(tmp_path):
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(name.encode())
    return [tmp_path / "a.mcap", tmp_path / "b.mcap"]


def test_all_of_a_search_comes_back_to_the_last_bit(tmp_path, nothing):
    rng = np.random.default_rng(0)
    first = nothing.having(replace(RotorDrag.neutral(), coefficient=np.asarray(0.1 / 3)))
    slowed = first.having(replace(ParasiticDrag.neutral(), linear=0.1 * rng.uniform(size=3)))
    found = replace(slowed, lead=0.2 / 3, shift=1 / 7, levels=rng.normal(size=5))
    tried = ({"present": [], "ranking": [{"name": "wind", "gain": 1 / 3, "t": 2 / 3, "p_value": 1e-300}]},)
    progress = Progress(found, frozenset({"payload", "inertia"}), tried, 2, ("rotor_drag",), first)
    Checkpoint(tmp_path / "search.json", {"a": "b"}).save(progress)
    state = json.loads((tmp_path / "search.json").read_text())
    again = Checkpoint(tmp_path / "search.json", {"a": "b"}, state).restore(nothing)
    for name in ("refused", "tried", "vain", "left_out"):
        assert getattr(again, name) == getattr(progress, name)
    for a, b in ((again.hypothesis, found), (again.judged, first)):
        for x, y in zip(jax.tree.leaves(a.effects), jax.tree.leaves(b.effects), strict=True):
            np.testing.assert_array_equal(x, y)
        assert (a.present, a.lead, a.shift) == (b.present, b.lead, b.shift)
        np.testing.assert_array_equal(a.levels, b.levels)


def test_a_search_of_something_else_is_kept_aside_and_said(tmp_path, nothing, logs, monkeypatch):
    said, path, base = [], tmp_path / "search.json", load_model_file("cfb")
    Checkpoint.open(path, logs, base, said.append).save(Progress(nothing, frozenset({"wind"})))
    kept = path.read_text()
    assert Checkpoint.open(path, logs, base, said.append).restore(nothing).refused == {"wind"}
    assert not said
    heavier = base.with_values("a test", mass=float(base.entries["mass"].value) * (1 + 1e-12))
    for what, flights, model in (("model", logs, heavier), ("flights", logs[:1], base), ("code", logs, base)):
        path.write_text(kept)
        with monkeypatch.context() as patched:
            if what == "code":
                patched.setattr(checkpoint, "code_identity", lambda: "0.0.0")
            opened = Checkpoint.open(path, flights, model, said.append)
        assert opened.restore(nothing) is None
        why = f"was interrupted with different {what}: starting again; the old file is kept as search.json.old"
        assert why in said.pop()
        assert not path.exists()
        assert (tmp_path / "search.json.old").read_text() == kept


@pytest.mark.parametrize("text", ["", "[1]", "{}", '{"key": "of an earlier version"}', "\x00"])
def test_a_file_that_is_no_search_is_kept_aside_and_said(tmp_path, nothing, logs, text):
    said, path = [], tmp_path / "search.json"
    path.write_text(text)
    assert Checkpoint.open(path, logs, load_model_file("cfb"), said.append).restore(nothing) is None
    assert "cannot be read: starting again" in said[0]
    assert (tmp_path / "search.json.old").read_text() == text


def test_a_search_with_a_part_missing_is_refused(tmp_path, nothing):
    made = Checkpoint(tmp_path / "search.json", {"a": "b"})
    made.save(Progress(nothing))
    for name in ("hypothesis", "vain", "tried", "judged"):
        state = {key: value for key, value in made.state.items() if key != name}
        with pytest.raises(CfbError, match=r"search\.json: is damaged"):
            Checkpoint(made.path, made.of, state).restore(nothing)


def test_what_a_search_depends_on_is_told_apart(logs):
    base = load_model_file("cfb")
    found = identity(logs, base)
    assert identity(logs, base) == found
    logs[1].write_bytes(b"other")
    assert identity(logs, base)["flights"] != found["flights"]
    drag = replace(base, effects=({"name": "rotor_drag", "parameters": {"coefficient": 0.01}},))
    assert identity(logs, drag)["model"] != found["model"]
