"""``cfb train`` and ``cfb fly`` as a user types them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cfb_mjx.logs import read_log
from cfb_mjx.parameters import load_model_file, save_model_file
from cfb_mjx.train.measuring import summary

pytestmark = pytest.mark.xdist_group("training")

SMALL = (
    "checkpoints=2",
    "network.hidden=[8, 8]",
    "ppo.drones=8",
    "ppo.unroll=4",
    "ppo.steps=128",
    "ppo.minibatches=2",
    "ppo.copies=2",
    "ppo.epochs=1",
    "ppo.value_hidden=[8]",
)


@pytest.fixture(scope="module")
def trained(cfb, tmp_path_factory):
    """A training on two virtual devices, of a model with an effect."""
    folder = tmp_path_factory.mktemp("trained")
    drag = {"name": "rotor_drag", "parameters": {"coefficient": 1e-6}}
    save_model_file(replace(load_model_file("cfb-guards"), name="draggy", effects=(drag,)), folder / "draggy.yaml")
    done = cfb(
        "train", "target", "--model", folder / "draggy.yaml", "--devices", 2, "-o", folder / "run", "--set", *SMALL
    )
    assert done.returncode == 0, done.stderr
    return folder / "run", done


def test_a_training_leaves_what_it_says(trained):
    folder, done = trained
    assert {p.name for p in folder.iterdir()} == {
        "policy.npz",
        "best.npz",
        "curve.csv",
        "updates.csv",
        "curve.png",
        "config.yaml",
        "checkpoint.npz",
        "training.json",
    }
    rows = (folder / "curve.csv").read_text().splitlines()
    assert len(rows) == 3
    assert rows[0].startswith("update,commands,seconds")
    assert "ppo on draggy" in done.stderr
    assert str(folder / "policy.npz") in done.stdout


def test_going_on_after_the_end_changes_nothing_and_another_training_is_refused(cfb, trained):
    folder, _ = trained
    before = (folder / "policy.npz").read_bytes()
    model = ("--model", folder.parent / "draggy.yaml", "--devices", 2)
    again = cfb("train", "target", *model, "--resume", "-o", folder, "--set", *SMALL)
    assert again.returncode == 0, again.stderr
    assert (folder / "policy.npz").read_bytes() == before
    plain = cfb("train", "target", *model, "-o", folder, "--set", *SMALL)
    assert plain.returncode == 2
    assert "--resume" in plain.stderr
    other = cfb("train", "target", *model, "--resume", "--seed", 5, "-o", folder, "--set", *SMALL)
    assert other.returncode == 2
    assert "another config.seed" in other.stderr
    assert (folder / "policy.npz").read_bytes() == before


def test_a_policy_file_flies(cfb, trained, tmp_path):
    folder, _ = trained
    arguments = ("--plants", 3, "--magnitude", 1, "--json", tmp_path / "h.json", "--figure", tmp_path / "h.png")
    done = cfb("fly", folder / "policy.npz", *arguments)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "h.json").read_text())
    assert {"mean_distance_mm", "command_std", "failed", "success_rate", "quantiles", "environment"} <= set(result)
    assert (tmp_path / "h.png").stat().st_size > 10_000
    assert "mean distance [mm]" in done.stdout


def test_the_firmwares_pid_holds_hover_and_steps_slowly(cfb, tmp_path):
    path = tmp_path / "r.json"
    assert cfb("fly", "pid", "--json", path).returncode == 0
    hover = json.loads(path.read_text())
    assert hover["mean_distance_mm"] < 30
    assert hover["command_std"] < 0.1
    assert hover["failed"] is False
    assert cfb("fly", "pid", "--task", "step", "--json", path).returncode == 0
    step = json.loads(path.read_text())
    # Its velocity limit is 1 m/s per axis, with a tenth on top.
    assert 0.9 < step["peak_speed_mps"] < 1.6
    assert step["arrival_s"] is None


def test_the_firmwares_pid_lands(cfb, tmp_path):
    """On two devices, which take turns with MuJoCo's floor."""
    names = ("json", "figure", "log", "recording")
    files = [tmp_path / f"landed.{end}" for end in ("json", "png", "mcap", "rrd")]
    options = [word for name, path in zip(names, files, strict=True) for word in (f"--{name}", path)]
    done = cfb("fly", "pid", "--task", "land", "--plants", 4, "--devices", 2, *options)
    assert done.returncode == 0, done.stderr
    result = json.loads(files[0].read_text())
    assert result["success_rate"] == 1
    assert 0 < result["vertical_speed_mps"] < 0.3
    assert result["quantiles"]["distance_mm"]["0.95"] < 100
    assert "tilt [deg]" in done.stdout
    assert all(path.stat().st_size > 10_000 for path in files[1:])
    log = read_log(files[2])
    assert log.position[0, 2] > 0.85
    np.testing.assert_allclose(log.position[-1, 2], 0.014, atol=0.001)
    np.testing.assert_array_equal(log.command[-100:], 0)


@pytest.mark.parametrize(("task", "more"), [("cross", ()), ("follow", ("--timescale", "1.5"))])
def test_two_drones_fly_together(cfb, tmp_path, task, more):
    files = ("--json", tmp_path / "t.json", "--figure", tmp_path / "t.png", "--log", tmp_path / "t.mcap")
    done = cfb("fly", "track", "--task", task, *more, *files)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "t.json").read_text())
    assert 0.5 < result["mean_distance_mm"] < 25
    assert 285 < result["closest_mm"] < 305
    assert ("path" in result) == (task == "follow")
    assert "closest [mm]" in done.stdout
    assert read_log(tmp_path / "t.mcap").position[:, 2].max() < 0.02
    done = cfb("fly", "track", "--task", "cross", "--timescale", "2")
    assert done.returncode == 2
    assert "--path and --timescale are for --task track and follow, not for cross" in done.stderr


def test_a_double_flip_by_its_name(cfb, tmp_path):
    outputs = ("--json", tmp_path / "f.json", "--figure", tmp_path / "f.png", "--recording", tmp_path / "f.rrd")
    done = cfb("fly", "double-flip", "--keep", tmp_path / "k.yaml", *outputs)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "f.json").read_text())
    assert {"rotations", "vertical_extent_m", "rate_stop_s", "vertical_stop_s", "return_error_m", "failed"} <= set(
        result
    )
    assert result["completed"] is True
    assert abs(result["rotations"] - 2) < 0.05
    assert result["vertical_extent_m"] <= 1.8
    assert (tmp_path / "f.png").stat().st_size > 10_000
    assert (tmp_path / "f.rrd").stat().st_size > 10_000
    assert "vertical extent [m]" in done.stdout
    again = cfb("fly", "flip", "--task", "double-flip", "--knobs", tmp_path / "k.yaml", "--json", tmp_path / "g.json")
    assert again.returncode == 0, again.stderr
    assert json.loads((tmp_path / "g.json").read_text())["knobs"] == pytest.approx(result["knobs"])


def test_every_drone_of_a_set_is_flown(cfb, tmp_path):
    """Told apart by what they do to a controller without integral action on thrust: a weaker drone hangs lower."""
    (tmp_path / "set.yaml").write_text(
        "format: cfb_mjx plants 1\nname: two\nplants:\n"
        "  - {name: as it is, effects: []}\n"
        "  - {name: heavy, effects: [{name: payload, parameters: {mass: 0.006, height: 0.0, offset: [0.0, 0.0]}}]}\n"
    )
    done = cfb("fly", "target-analytic", "--on", tmp_path / "set.yaml", "--plants", 2, "--json", tmp_path / "r.json")
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "r.json").read_text())
    assert list(result["on"]) == ["as it is", "heavy"]
    assert 2 * result["on"]["as it is"]["mean_distance_mm"] < result["on"]["heavy"]["mean_distance_mm"]
    assert result["on"]["heavy"]["failure_rate"] == 0
    assert "heavy     mean distance [mm]" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["fly", "pid", "--on", "nothing"], "nothing: no such set of plants"),
        (["fly", "pid", "--on", "off-nominal", "--figure", "x.png"], "leave out --on"),
        (["fly", "nobody"], "no such controller"),
        (["fly", "nobody.npz"], "nobody.npz: there is no such file"),
        (["fly", "pid", "--plants", "0"], "at least one drone"),
        (["fly", "pid", "--model", "nothing"], "nothing: no such model"),
        (["fly", "pid", "--task", "flip"], "pid: is not a flip policy"),
        (["fly", "flip", "--task", "hover"], "cannot fly --task hover"),
        (["fly", "target", "--set", "climb_s=1"], "are for flips"),
        (["fly", "flip", "--knobs", "double-flip"], "turn 2 times"),
        (["fly", "flip", "--holder", "pid"], "holder pid: must be a target policy"),
        (["fly", "double-flip", "--set", "climb=1"], "climb_s"),
        (["fly", "flip", "--keep", "nowhere/k.yaml"], "nowhere"),
        (["train", "flip", "-o", "x", "--set", "setpoints.rate_radps=[9]"], "setpoints.rate_radps"),
        (["train", "flip", "-o", "x", "--set", "reward.position=1"], "reward.position"),
        (["train", "flip", "-o", "x", "--config", "target"], "trains target, not flip"),
        (["train", "target", "-o", "x", "--config", "nothing"], "no such training"),
        (["train", "target", "-o", "x", "--set", "ppo.dronez=3"], "ppo.dronez"),
        (["train", "target", "-o", "x", "--set", "observation.control_dt_s=0.01"], "control_dt_s = 0.01"),
    ],
)
def test_mistakes_get_a_sentence(cfb, arguments, said, tmp_path):
    done = cfb(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    # Nothing was begun.
    assert not (tmp_path / "x" / "policy.npz").exists()


def test_training_on_a_predictor_must_be_insisted_on(cfb, tmp_path):
    save_model_file(replace(load_model_file("cfb-guards"), kind="predictor"), tmp_path / "p.yaml")
    done = cfb("train", "target", "--model", tmp_path / "p.yaml", "-o", tmp_path / "run")
    assert done.returncode == 2
    assert "predictor" in done.stderr
    assert "--force" in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["p.yaml"]


def test_a_drone_that_diverged_failed_and_is_in_no_mean():
    measured = {
        "mean_distance_m": np.array([0.01, np.nan, 0.03]),
        "command_std": np.array([0.1, np.nan, 0.3]),
        "failed": np.array([False, False, False]),
    }
    found = summary("hover", measured, diverged=np.array([False, True, False]))
    assert found["mean_distance_mm"] == pytest.approx(20.0)
    assert found["failed"] is True
    assert found["diverged"] == 1
    assert found["success_rate"] == pytest.approx(2 / 3)
    alone = summary("hover", {k: v[1:2] for k, v in measured.items()}, diverged=np.array([True]))
    assert alone == {"mean_distance_mm": None, "command_std": None, "failed": True, "diverged": 1}
    assert "diverged" not in summary("hover", {k: v[:1] for k, v in measured.items()})


def test_a_landing_that_touched_nothing_is_in_no_mean():
    touched = np.array([0.1, np.nan, 0.5])
    measured = {key: touched for key in ("vertical_speed_mps", "horizontal_speed_mps", "tilt_deg")}
    measured |= {"distance_m": np.array([0.01, 9.0, 0.03]), "failed": np.zeros(3, bool)}
    found = summary("land", measured | {"landed": np.array([True, False, False])})
    assert found["vertical_speed_mps"] == pytest.approx(0.3)
    assert found["distance_mm"] == pytest.approx(20.0)
    assert found["success_rate"] == pytest.approx(1 / 3)
    assert found["quantiles"]["distance_mm"]["0.95"] == pytest.approx(10.0)
    alone = summary("land", {k: v[1:2] for k, v in measured.items()} | {"landed": np.array([False])})
    assert alone["landed"] is False
    assert alone["tilt_deg"] is None
