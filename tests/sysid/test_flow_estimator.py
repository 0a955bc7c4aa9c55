"""An estimator at odds with its flow deck, told from attitude, gyro and accelerometer alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.sysid.flow_estimator import fit_flow_estimator

GRAVITY, DRAG = 9.81, 0.45
STEP, ROW = 0.002, 5
BIAS = np.array([0.004, -0.003, 0.002])


def flown(scale: float, ignored: float, seed: int = 0, seconds: float = 30.0) -> FlightLog:
    """A log of an estimator as SciPy's rotations and small Euler steps make it: drag, thrust that holds the height, a
    gyro with a bias, gains of 1.6 rad/s per m/s and 9 / s."""
    rng = np.random.default_rng(seed)
    count = round(seconds / STEP)
    time = np.arange(count) * STEP
    frequency, phase = rng.uniform(0.1, 0.7, (2, 4)), rng.uniform(0, 2 * np.pi, (2, 4))
    waves = np.sin(2 * np.pi * frequency[..., None] * time + phase[..., None])
    roll, pitch = 0.09 * waves.sum(axis=1)
    true = Rotation.from_euler("ZYX", np.stack([0.3 * np.sin(0.2 * time), pitch, roll], axis=1))
    rate = (true[:-1].inv() * true[1:]).as_rotvec() / STEP
    up = true.apply([0.0, 0.0, 1.0])
    velocity, felt = np.zeros((count, 3)), np.zeros((count, 3))
    for i in range(count - 1):
        push = GRAVITY / up[i, 2] * up[i] - DRAG * velocity[i] * [1, 1, 0]
        felt[i] = true[i].apply(push, inverse=True)
        velocity[i + 1] = velocity[i] + STEP * (push - [0, 0, GRAVITY])
    felt[-1] = felt[-2]
    attitude, speed = true[0], velocity[0] * scale
    quaternion = np.zeros((count, 4))
    for i in range(count):
        quaternion[i] = attitude.as_quat()
        known = felt[i] * [1 - ignored, 1 - ignored, 1.0]
        off = speed - scale * velocity[i]
        speed = speed + STEP * ((attitude.apply(known) - [0, 0, GRAVITY]) - 9.0 * off) * [1, 1, 0]
        # To lean against the error along x, turn about y; along y, about -x.
        turn = STEP * 1.6 * np.array([off[1], -off[0], 0.0])
        attitude = Rotation.from_rotvec(turn) * attitude * Rotation.from_rotvec(STEP * rate[min(i, count - 2)])
    rows = slice(0, count, ROW)
    path = np.cumsum(velocity, axis=0) * STEP
    return FlightLog(
        time=time[rows],
        position=path[rows],
        velocity=scale * velocity[rows],
        quaternion=np.roll(quaternion[rows], 1, axis=1),
        body_rate=0.5 * (np.concatenate([rate[:1], rate]) + np.concatenate([rate, rate[-1:]]))[rows] + BIAS,
        specific_force=felt[rows],
        command=np.full((len(time[rows]), 4), 0.5),
        metadata={"name": f"flown{seed}", "source": "simulated", "format": "made", "observation_delay": 0.0},
    )


@pytest.mark.parametrize("scale", [1.0, 1.09])
def test_ignored_drag_comes_back_with_the_corrections_it_causes(scale):
    found = fit_flow_estimator([flown(scale, 1.0), flown(scale, 1.0, seed=1)], scale)
    assert found.ignored == pytest.approx(1.0, abs=0.03)
    assert found.natural_frequency == pytest.approx(np.sqrt(1.6 * scale * GRAVITY), rel=0.1)
    assert found.damping_ratio == pytest.approx(9.0 / (2 * np.sqrt(1.6 * scale * GRAVITY)), rel=0.1)
    assert found.explained > 0.99
    assert 0.005 < found.corrected < 0.05


def test_a_stretched_flow_is_told_from_ignored_drag():
    logs = [flown(1.09, 0.0)]
    stretched, ignoring = fit_flow_estimator(logs, 1.09, 0.0), fit_flow_estimator(logs, 1.0, 1.0)
    assert stretched.explained > 0.99
    assert ignoring.explained < 0.8


def test_an_attitude_that_follows_the_gyro_has_nothing_to_correct():
    assert fit_flow_estimator([flown(1.0, 0.0)]).corrected < 2e-4


def test_what_is_too_short_is_refused():
    log = flown(1.0, 0.0, seconds=2.0)
    with pytest.raises(CfbError, match=rf"{log.name}: too little flight"):
        fit_flow_estimator([log])
    with pytest.raises(CfbError, match=rf"{log.name}: too little flight"):
        fit_flow_estimator([log.rows(slice(0, 2))])
    with pytest.raises(CfbError, match="no logs"):
        fit_flow_estimator([])
