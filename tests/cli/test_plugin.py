"""An effect in a file outside the package, from simulation to a report and a training: ``--plugin FILE.py``."""

from __future__ import annotations

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
import yaml

from cfb_mjx.cli import main
from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.logs import write_mcap
from cfb_mjx.model import CATALOGUE, Quadrotor
from cfb_mjx.parameters import load_model_file, save_model_file
from cfb_mjx.plugins import plugged
from cfb_mjx.sysid.tracing.checkpoint import identity
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.train.config import load_config
from cfb_mjx.train.run import Training
from tests.helpers import SMALL_TRAINING
from tests.own_effect import AIR_DRAG
from tests.simulated_log import noisy, simulated_log

# They share a folder and compiled programs.
pytestmark = pytest.mark.xdist_group("plugin")

DRAG = 0.03


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The plugin, a model with its effect, and four flights of that drone."""
    folder = tmp_path_factory.mktemp("plugin")
    (folder / "my_effects.py").write_text(AIR_DRAG)
    drag = {"name": "air_drag", "parameters": {"coefficient": DRAG}}
    save_model_file(replace(load_model_file("cfb-guards"), name="mine", effects=(drag,)), folder / "mine.yaml")
    with plugged(folder / "my_effects.py"):
        flight = simulated_log(10.0, Quadrotor.from_file(folder / "mine.yaml"))
    for seed in range(4):
        write_mcap(noisy(flight, seed, f"flight{seed}"), folder / f"flight{seed}.mcap")
    return folder


@pytest.fixture(scope="module")
def closed(folder):
    """``cfb close-loop`` with the effect alone in the search, which compiles in a fraction of the time."""
    start = Search.start
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Search, "start", lambda *given, **more: replace(start(*given, **more), names=("air_drag",)))
        flights = [str(folder / f"flight{i}.mcap") for i in range(4)]
        plugin = ("--plugin", str(folder / "my_effects.py"))
        words = ("close-loop", "--fit", *flights[:2], "--held-out", *flights[2:], *plugin, "-o", str(folder / "closed"))
        assert main(list(words)) == 0
    return folder / "closed"


def test_the_search_takes_the_effect_up(folder):
    with plugged(folder / "my_effects.py"):
        assert CATALOGUE["air_drag"].searched
    assert "air_drag" not in CATALOGUE


def test_close_loop_finds_and_measures_it(closed):
    report = json.loads((closed / "report.json").read_text())
    (found,) = report["effects"]
    assert found["name"] == "air_drag"
    assert found["parameters"]["coefficient"] == pytest.approx(DRAG, rel=0.1)
    assert found["p_value"] < 1e-6
    held = report["held_out"]
    assert held["after"]["velocity_rmse_mps@0.5s"] < 0.7 * held["before"]["velocity_rmse_mps@0.5s"]
    model = yaml.safe_load((closed / "model.yaml").read_text())
    assert model["effects"][0]["parameters"]["coefficient"] == found["parameters"]["coefficient"]


def test_the_report_says_what_the_effect_says_of_itself(closed):
    page = (closed / "report.html").read_text()
    assert "air_drag" in page
    assert "F = -coefficient v, with v the velocity in body axes" in page
    assert "N s/m" in page


def test_a_model_with_it_predicts_flies_and_trains(folder, closed, tmp_path, capsys):
    plugin = ("--plugin", str(folder / "my_effects.py"))
    errors = {}
    for name, model in (("declared", "cfb-guards"), ("closed", str(closed / "model.yaml"))):
        path = tmp_path / f"{name}.json"
        assert main(["evaluate", str(folder / "flight2.mcap"), "--model", model, "--json", str(path), *plugin]) == 0
        errors[name] = json.loads(path.read_text())["commands_in"]["velocity_rmse_mps@0.5s"]
    assert errors["closed"] < 0.7 * errors["declared"]
    run = tmp_path / "run"
    small = ("algorithm=analytic", *SMALL_TRAINING)
    words = ("train", "target", "--model", str(closed / "model.yaml"), "-o", str(run), *plugin, "--set", *small)
    assert main(list(words)) == 0
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(load_policy(run / "policy.npz").controller))
    capsys.readouterr()


def test_without_the_plugin_a_model_with_it_is_refused_by_a_sentence_that_says_how(folder, capsys):
    assert main(["fly", "pid", "--model", str(folder / "mine.yaml")]) == 2
    said = capsys.readouterr().err
    assert "mine.yaml: unknown effect 'air_drag'" in said
    assert "load an effect of your own with --plugin FILE.py" in said


def test_a_search_and_a_training_do_not_go_on_with_another_text_of_the_effect(folder, tmp_path):
    """Half of it would be computed with one physics and half with another."""
    plugin, base = tmp_path / "my_effects.py", load_model_file("cfb-guards")
    plugin.write_text(AIR_DRAG)
    keys, identities = [identity([], base)], []
    for text in (AIR_DRAG, AIR_DRAG, AIR_DRAG.replace("* -self", "* -2.0 * self")):
        plugin.write_text(text)
        with plugged(plugin):
            keys.append(identity([], base))
            training = Training.prepare(load_config("target", (f"model={folder / 'mine.yaml'}",)), {})
            identities.append(training.identity()["effects"])
    assert keys[1] == keys[2] != keys[3]
    assert keys[0] not in keys[1:]
    assert identities[0] == identities[1] != identities[2]
    assert "effects" not in Training.prepare(load_config("target"), {}).identity()
