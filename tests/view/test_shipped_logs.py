"""The shipped flight logs are what their script makes, and the model and its missing drag show in them as described."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfb_mjx.logs import read_log
from cfb_mjx.model import Quadrotor
from cfb_mjx.sysid import evaluate

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "data" / "flight_logs"


@pytest.fixture(scope="module")
def script():
    """The generating script as a module."""
    spec = importlib.util.spec_from_file_location("make_flight_logs", ROOT / "scripts" / "make_flight_logs.py")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up by name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.parametrize("index", [0, 1, 2])
def test_script_makes_the_shipped_rows(script, index):
    flight = script.FLIGHTS[index]
    made = script.fly(replace(flight, seconds=0.6), script.Noise())
    shipped = read_log(FOLDER / f"{flight.name}.mcap").slice(0.0, 0.6)
    assert len(made) == len(shipped) == 151
    for field in ("time", "position", "velocity", "quaternion", "body_rate", "specific_force", "command"):
        # Other versions of NumPy and SciPy may round differently.
        np.testing.assert_allclose(getattr(made, field), getattr(shipped, field), atol=2e-6, rtol=2e-6)
    np.testing.assert_allclose(made.rotor_speed, shipped.rotor_speed, rtol=1e-5)


def test_without_noise_only_the_unlogged_commands_are_missed(script):
    log = script.fly(replace(script.FLIGHTS[0], seconds=2.2), script.Noise().scaled(0.0))
    evaluation = evaluate(Quadrotor.from_file("cfb-guards"), [log])
    commands, rotors = evaluation.metrics("commands_in"), evaluation.metrics("rotor_speed_in")
    assert commands["attitude_rmse_deg@0.5s"] < 0.25
    assert commands["position_rmse_m@0.5s"] < 2e-3
    assert rotors["attitude_rmse_deg@0.5s"] < 5e-3
    assert rotors["position_rmse_m@0.5s"] < 1e-4


def test_drag_leaves_a_residual_in_velocity_alone():
    logs = [read_log(FOLDER / f"{name}.mcap") for name in ("figure8", "drag")]
    figure8, drag = evaluate(Quadrotor.from_file("cfb-guards"), logs).logs
    ratio = {
        q: drag.errors["commands_in"][q][:, -1].mean() / figure8.errors["commands_in"][q][:, -1].mean()
        for q in ("velocity", "attitude", "rate")
    }
    assert ratio["velocity"] > 10
    assert ratio["attitude"] < 1.5
    assert ratio["rate"] < 1.5


def test_size_and_content():
    paths = sorted(FOLDER.glob("*.mcap"))
    assert [path.stem for path in paths] == ["drag", "figure8", "yaw"]
    assert sum(path.stat().st_size for path in paths) < 2.5e6
    for path in paths:
        log = read_log(path)
        assert log.observation_delay == 0.008
        assert not len(log.gaps())
        fastest, turning = np.linalg.norm(log.velocity, axis=1).max(), np.abs(log.body_rate[:, 2]).max()
        assert (fastest < 0.1 and turning > 1.0) if path.stem == "yaw" else 2.0 < fastest < 3.5
        assert log.rotor_speed is not None
        assert log.battery_voltage[-100:].mean() < log.battery_voltage[:100].mean() - 0.0016 * log.duration
