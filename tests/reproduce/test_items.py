"""What the paper's figures and tables are made of."""

import csv
import importlib.util
import re
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from cfb_mjx.control.controllers import find_controller
from cfb_mjx.envs import TargetTask
from cfb_mjx.envs.task import QUIET
from cfb_mjx.files import shipped
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_model_file
from cfb_mjx.reproduce import ITEMS, brushed, manoeuvres
from cfb_mjx.reproduce.flights import Given, generated, real_flights
from cfb_mjx.reproduce.item import Result, Row, markdown, page
from cfb_mjx.reproduce.manoeuvres import bands
from cfb_mjx.train.flying import STEP_DISTANCE_M, back_and_forth, six_metres

pytestmark = pytest.mark.xdist_group("reproduce")
ROOT = Path(__file__).resolve().parents[2]


def test_shipped_parameters_are_the_papers(tmp_path):
    result = ITEMS["parameters"].make(tmp_path, None)
    stated = [row for row in result.rows if row.paper]
    assert len(stated) >= 20
    assert all(row.paper == row.ours for row in stated)
    # Files that repeat the paper are no second measurement of it.
    assert {row.kind for row in stated} == {"input"}
    follows = {row.what: float(row.ours) for row in result.rows if not row.paper}
    assert follows["command in hover with guards"] == pytest.approx(0.550, abs=1e-3)
    assert follows["thrust to weight without guards"] == pytest.approx(2.95, abs=0.01)


def test_curves_go_through_what_was_put_in_and_come_out_the_same_twice(tmp_path):
    first, second = tmp_path / "a", tmp_path / "b"
    for folder in (first, second):
        folder.mkdir()
        result = ITEMS["rotor-curves"].make(folder, None)
    assert (first / "rotor-curves.csv").read_bytes() == (second / "rotor-curves.csv").read_bytes()
    assert (first / "rotor-curves.png").read_bytes() == (second / "rotor-curves.png").read_bytes()
    assert len(result.rows) == 6
    assert {row.kind for row in result.rows} == {"input"}
    for row in result.rows:
        ours, std = map(float, row.ours.split(" +- "))
        assert abs(ours - float(row.paper)) < 4 * std


def test_bench_data_are_what_their_script_makes(tmp_path):
    spec = importlib.util.spec_from_file_location("make_bench_data", ROOT / "scripts" / "make_bench_data.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main(tmp_path)
    for name in ("motor_steps.csv", "rotor_points.csv"):
        made, kept = (np.loadtxt(f / name, delimiter=",", skiprows=1) for f in (tmp_path, ROOT / "data" / "bench"))
        np.testing.assert_allclose(made, kept, atol=0.02)


@pytest.mark.parametrize(("name", "start"), [("figure8", 1.0), ("yaw", 1.0)])
def test_bands_enclose_a_flight_that_another_program_flew(name, start):
    piece = bands(load_model_file("cfb-guards"), generated(name), start, count=64)
    assert piece.simulated.shape == (64, len(piece.time), 9)
    velocity, attitude, rate = piece.off(0.2)
    assert velocity < 0.1
    assert attitude < 3.0
    assert rate < 0.5
    lost = piece.lost()
    assert lost[0] == 0.0
    assert lost[-1] > 0.5  # a centre of gravity two millimetres off tips a drone over that nobody steers
    again = bands(load_model_file("cfb-guards"), generated(name), start, count=64)
    np.testing.assert_array_equal(piece.simulated, again.simulated)


def test_the_useful_horizon_is_evidence_on_flights_that_are_given_only(tmp_path, monkeypatch):
    for name in ("SIMULATIONS", "FEWER"):
        monkeypatch.setattr(manoeuvres, name, 64)
    given = Given((generated("figure8"), generated("drag")), 0.05)
    result = manoeuvres.hover_to_forward(tmp_path, None, given)
    own, measured = (row for row in result.rows if row.what.startswith("useful horizon"))
    assert (own.kind, measured.kind) == ("own", "result")
    assert "given; median and quartiles of 2 flights" in measured.what
    assert 50 < float(measured.ours.split()[0]) < 1e3 * manoeuvres.REACH_S
    assert any("a mass of 0.05 kg, as weighed" in text for text in result.text)
    assert (tmp_path / "hover-to-forward-given.png").exists()


def test_given_brushed_flights_are_predicted_by_the_brushed_model_alone(tmp_path, monkeypatch):
    asked = []

    def evaluated(drone, logs):
        asked.append((round(float(drone.parameters.mass), 4), [log.name for log in logs]))
        return SimpleNamespace(metrics=lambda kind: defaultdict(lambda: 1.0))

    monkeypatch.setattr("cfb_mjx.sysid.evaluate", evaluated)
    monkeypatch.setattr(brushed, "_draw", lambda *_: None)
    result = brushed.brushed(tmp_path, None, Given((generated("drag"),), 0.0347))
    assert asked == [(0.044, ["figure8"]), (0.027, ["figure8"]), (0.0347, ["drag"])]
    named = [row.what for row in result.rows if "(brushed flights)" in row.what]
    assert len(named) == 3
    assert all(what.endswith("(brushed flights): brushed, hold") for what in named)
    assert "brushed model on brushless flights" in " ".join(brushed.brushed(tmp_path, None).text)


def test_flights_of_a_brushed_drone_are_read_from_its_cards():
    folder = ROOT.parent / "shared" / "real2" / "brushed"
    if not folder.is_dir():
        pytest.skip("../shared/real2 is not beside this checkout")
    logs = Given.read(folder, None).logs
    assert [log.name for log in logs] == ["run00", "run10", "run23", "run30"]
    assert all(0.3 < log.command.min() < 0.75 < log.command.max() < 1 for log in logs)


def test_a_target_that_jumps_is_reached_every_time_and_the_first_time_as_in_a_single_step():
    nominal = Quadrotor.from_file("cfb-guards")
    controller, task, key = find_controller("target", nominal), TargetTask(noise=QUIET), jax.random.PRNGKey(0)
    flown = back_and_forth(controller, task, nominal, key, legs=3, leg_s=2.5)
    steps = round(2.5 / controller.control_dt_s)
    for leg, target in enumerate((STEP_DISTANCE_M, 0.0, STEP_DISTANCE_M)):
        there = slice(leg * steps, (leg + 1) * steps)
        np.testing.assert_array_equal(flown.watched[there, 0], target)
        assert abs(float(flown.position[there][-1, 0]) - target) < 0.1
    single = six_metres(controller, task, nominal, key[None])[1].position[0, :steps]
    # A network that is told of the jump at once flies it as if it had begun far off; it remembers the time before.
    np.testing.assert_allclose(flown.position[:steps] - np.array([STEP_DISTANCE_M, 0, 0]), single, atol=0.3)


def test_every_study_policy_is_there():
    for algorithm in ("analytic", "ppo"):
        for magnitude in ("0", "0.5", "1", "1.5"):
            for seed in range(3):
                assert shipped("data", "study", algorithm, f"{magnitude}-{seed}.npz").is_file()


def test_pages_hold_every_row(tmp_path):
    rows = [Row("a | b", "1", "2", "because"), Row("<c>", "", "3"), Row("<d>", "5", "5", kind="input")]
    results = {"some": Result("Title", ["Text."], rows)}
    text = markdown(results, {"date": "today"}, "a command")
    assert "1 comparisons with numbers of the paper. In addition there are 1 inputs" in text
    assert "and 0 predictions of flights that were simulated with the model's own constants" in text
    table = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(table) == 4
    assert {line.count("|") for line in table} == {6}
    assert "| <d> | 5 | 5 | an input, not a result |  |" in table
    html = page(results, {"date": "today"})
    assert "&lt;c&gt;" in html
    assert not re.search(r'(src|href)="(?!data:)', html)


def test_real_flights_stand_beside_generated_ones(tmp_path):
    folder = ROOT.parent / "shared" / "real"
    if not folder.is_dir():
        pytest.skip("../shared/real is not beside this checkout")
    assert len(real_flights(folder)) == 11
    result = ITEMS["rotor-curves"].make(tmp_path, folder)
    row = next(row for row in result.rows if row.what.startswith("thrust at 1700"))
    assert float(row.ours) == pytest.approx(float(row.paper), rel=0.2)
    with open(tmp_path / "rotor-curves.csv", newline="") as file:
        assert {row["source"] for row in csv.DictReader(file)} >= {"real flights", "paper"}
