"""The same fit by `mujoco.sysid` (MuJoCo C, finite differences) gives the same parameters.

One drawn drone and seven short manoeuvres; `scripts/compare_mujoco_sysid.py` does it with several drones and with the
library's compiled fits, and writes docs/sysid-comparison.md. Here the library's predictions are minimised by SciPy
instead: compiling the fits takes longer than all the rest.
"""

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from mujoco import sysid
from scipy.optimize import least_squares

if not hasattr(sysid, "ModelSequences"):
    # Without its optional dependencies the module imports, but it is empty.
    pytest.skip("mujoco.sysid needs more packages: pip install 'mujoco[sysid]'", allow_module_level=True)

import mujoco_fit
import open_loop

from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid.identification.unknowns import choose
from cfb_mjx.sysid.prediction import predict, start_of_windows
from cfb_mjx.sysid.windows import Windows, find_windows

NOMINAL = load_model_file("cfb-guards").parameters()
HORIZONS = tuple(0.02 * np.arange(1, 11))


@pytest.fixture(scope="module")
def drone():
    rng = np.random.default_rng(12)
    plant = open_loop.draw_drone(rng)
    return np.array(list(open_loop.truth(plant).values())), open_loop.fly(plant, 1, rng)


def test_known_starts_give_the_drawn_drone(drone):
    truth, logs = drone
    found = mujoco_fit.fit(mujoco_fit.whole_manoeuvres(logs))
    assert np.all(np.abs(found.values - truth) < 4 * found.std)
    assert np.all(found.std < 0.002 * truth)


def test_the_same_windows_have_the_same_minimum(drone):
    truth, logs = drone
    pieces = mujoco_fit.windows(logs)
    independent = mujoco_fit.fit(pieces)
    cut = [find_windows(log, HORIZONS, log.observation_delay, 0.0) for log in logs]
    joined = Windows(**{f.name: np.concatenate([getattr(w, f.name) for w in cut]) for f in dataclasses.fields(Windows)})
    assert len(joined) == len(pieces)
    noise = np.array([piece.noise for piece in pieces])[:, None]
    unknowns = choose(mujoco_fit.NAMES, NOMINAL)

    def residual(vector):
        model = Quadrotor(unknowns.apply(jnp.asarray(vector)), integrator="rk4")
        pairs = zip(logs, cut, strict=True)
        speed = np.concatenate([start_of_windows(model, log, w, 0.008)[0] for log, w in pairs])
        found = predict(model, joined, speed)
        q, p = joined.true_quaternion, found.quaternion
        turn = q[..., :1] * p[..., 1:] - p[..., :1] * q[..., 1:] - np.cross(q[..., 1:], p[..., 1:])
        turn = 2 * turn * np.sign(np.sum(q * p, axis=-1, keepdims=True))
        errors = (
            found.position - joined.true_position,
            found.velocity - joined.true_velocity,
            turn,
            found.body_rate - joined.true_body_rate,
        )
        return (np.concatenate(errors, axis=-1) / noise).ravel()

    ours = least_squares(residual, np.zeros(5), xtol=1e-6)
    values = np.asarray(unknowns.values(jnp.asarray(ours.x)))
    # Two optimisers and two simulators on the same numbers: far closer than the data could tell.
    assert np.all(np.abs(values - independent.values) < 0.2 * independent.std)
    # Starts that carry noise make residuals of a window move together, which these intervals do not know.
    assert np.all(np.abs(values / truth - 1) < 0.05)


def test_the_recorded_comparison_agrees_within_its_uncertainty():
    recorded = json.loads((Path(__file__).parents[2] / "benchmarks" / "sysid_comparison.json").read_text())
    assert len(recorded["drones"]) >= 3
    apart = []
    for estimates in (drone["estimates"] for drone in recorded["drones"]):
        for name in mujoco_fit.NAMES:
            ours, theirs = estimates["shooting_measured_start"][name], estimates["mujoco_windows"][name]
            assert abs(ours["value"] - theirs["value"]) < 0.2 * min(ours["std"], theirs["std"]), name
            theirs = estimates["mujoco_manoeuvres"][name]
            for method in ("shooting", "innovation"):
                ours = estimates[method][name]
                apart.append((ours["value"] - theirs["value"]) / np.hypot(ours["std"], theirs["std"]))
    assert np.max(np.abs(apart)) < 3.5
    assert np.sqrt(np.mean(np.square(apart))) < 1.5
