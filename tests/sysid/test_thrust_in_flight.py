"""Thrust in flight, on another author's simulator and on forces put together by hand."""

import json
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.logs import FlightLog, read_log
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid.rotors.flown_motors import thrust_in_flight

GENERATOR = Path(__file__).resolve().parents[3] / "shared" / "cases" / "fit" / "make_fit_logs.py"
PAPER = load_model_file("cfb-guards").parameters()


@pytest.mark.skipif(not GENERATOR.exists(), reason="the generator of fit logs is not here")
def test_drones_of_another_simulator_whose_thrust_is_known(tmp_path):
    settings = ["--drones", "4", "--seed", "77", "--seconds", "12", "--rates", "250", "100", "--omega"]
    subprocess.run([sys.executable, GENERATOR, tmp_path, *settings], check=True)
    for truth in json.loads((tmp_path / "truth.json").read_text()).values():
        drone = eqx.tree_at(lambda p: p.mass, PAPER, jnp.asarray(truth["mass"]))
        for file in truth["files"]:
            found = thrust_in_flight([read_log(tmp_path / file)], drone)
            off = found.ratio - truth["thrust_scale"]
            assert abs(off) < 0.003, file
            assert abs(off) < 4 * found.ratio_std, file
            assert abs(found.climb) < 0.001
            assert abs(found.lift) < 0.001


def made(climb=-0.007, lift=0.003, seconds=20.0, mass=0.037):
    """A level drone that climbs and moves about; its force is put together from the paper's curve by hand."""
    t = np.arange(0, seconds, 0.004)
    speed = 1600 + 90 * np.sin(1.3 * t)[:, None] + 40 * np.sin(np.outer(t, [0.7, 1.1, 1.7, 2.3]))
    velocity = np.stack([1.5 * np.sin(0.8 * t), np.cos(0.5 * t), 0.6 * np.sin(1.9 * t)], axis=1)
    s = speed / 2900
    pull = np.sum(-0.23 * s**3 + 0.562 * s**2 - 0.043 * s, axis=1)
    force = 0.87 * pull + climb * s.sum(axis=1) * velocity[:, 2] + lift * (velocity[:, 0] ** 2 + velocity[:, 1] ** 2)
    level, zero = np.tile([1.0, 0, 0, 0], (len(t), 1)), np.zeros((len(t), 3))
    specific = np.stack([0 * t, 0 * t, force / mass], axis=1)
    return FlightLog(t, zero, velocity, level, zero, specific, np.full((len(t), 4), 0.5), speed)


def test_climb_and_lift_are_told_from_the_curve():
    drone = eqx.tree_at(lambda p: p.mass, PAPER, jnp.asarray(0.037))
    log = made()
    found = thrust_in_flight([log], drone)
    assert found.ratio == pytest.approx(0.87, abs=1e-3)
    assert found.climb == pytest.approx(-0.007, abs=2e-4)
    assert found.lift == pytest.approx(0.003, abs=2e-4)
    rng = np.random.default_rng(0)
    spoiled, lost = log.specific_force.copy(), log.rotor_speed.copy()
    spoiled[1000:1100, 2] += 15.0  # a landing, a touch
    lost[rng.random(lost.shape) < 0.1] = np.nan
    again = thrust_in_flight([log.replace(specific_force=spoiled, rotor_speed=lost)], drone)
    assert again.ratio == pytest.approx(0.87, abs=4e-3)


def test_too_little_flight_tells_nothing():
    log = made(seconds=1.5)
    assert thrust_in_flight([log], PAPER) is None
    assert thrust_in_flight([made().replace(rotor_speed=None)], PAPER) is None
