"""A velocity column stretched in a band of frequencies: undone, done again, and told from one stretched alike."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lsim

from cfb_mjx.errors import CfbError
from cfb_mjx.model import State
from cfb_mjx.reference_simulator import Case, fly_campaigns
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.velocity_band import with_band
from cfb_mjx.sysid.velocity_stretch import VelocityStretch
from cfb_mjx.sysid.windows import find_windows

pytestmark = pytest.mark.xdist_group("stretch")

RISE, FADE, SHARE = 0.3, 0.7, 0.14
BAND = SensorFaults(velocity_scale=1 / (1 - SHARE), vertical_scale=1.0, velocity_rise=RISE, velocity_fade=FADE)


def logged_by_estimator(time, true):
    """Of true velocities (N, k): true / (1 - share H), H = fade s / ((1 + rise s) (1 + fade s)), by SciPy."""
    numerator = [RISE * FADE, RISE + FADE, 1.0]
    denominator = np.polysub(numerator, [SHARE * FADE, 0.0])
    begin = true[0]
    return np.stack(
        [lsim((numerator, denominator), u - b, time)[1] + b for u, b in zip(true.T, begin, strict=True)], axis=1
    )


def perfectly(windows):
    """What a perfect model predicts."""
    truth = (getattr(windows, f"true_{name}") for name in ("position", "velocity", "quaternion", "body_rate"))
    return State(*truth, jnp.zeros((*windows.true_position.shape[:2], 4)))


@pytest.fixture(scope="module")
def flights():
    return fly_campaigns([Case("clean", 9100, ())])[0].fit


@pytest.fixture(scope="module")
def stretched(flights):
    """The same flights; on an even grid, for SciPy's simulation wants one."""
    found = []
    for log in flights:
        grid = np.arange(log.time[0], log.time[-1] + 0.001, 0.001)
        fine = np.stack([np.interp(grid, log.time, v) for v in log.velocity.T], axis=1)
        across = logged_by_estimator(grid, fine[:, :2])
        rows = [np.interp(log.time, grid, v) for v in across.T]
        found.append(log.replace(velocity=np.stack([*rows, log.velocity[:, 2]], axis=1)))
    return found


def test_a_band_is_undone_as_an_independent_simulation_makes_it(flights, stretched):
    offs = [np.abs(bad.velocity - log.velocity).max() for log, bad in zip(flights, stretched, strict=True)]
    assert max(offs) > 0.1
    for log, bad, off in zip(flights, stretched, offs, strict=True):
        # SciPy sees the velocity between rows of this log, the repair its rows: gaps are the coarsest.
        np.testing.assert_allclose(BAND.repaired(bad).velocity, log.velocity, atol=0.1 * off)


def test_undoing_rests_on_no_later_row(stretched):
    log = stretched[0]
    spoilt = log.velocity.copy()
    spoilt[500:] += 3.0
    one, other = (BAND.stretch.undone(log.time, v) for v in (log.velocity, spoilt))
    np.testing.assert_array_equal(one[:500], other[:500])
    assert np.abs(one[500:] - other[500:]).min() > 1.0


@pytest.mark.parametrize("fade", [FADE, None])
@pytest.mark.parametrize("rise", [RISE, 0.0])
def test_done_again_is_what_was_undone(rise, fade):
    rng = np.random.default_rng(7)
    step = rng.uniform(0.002, 0.02, 300)
    time = np.concatenate([[0.0], np.cumsum(step)])
    logged = np.cumsum(rng.normal(size=(301, 3)), axis=0)
    stretch = VelocityStretch(np.array([1.2, 0.9, 1.0]), rise, fade)
    true, carried = stretch.undone(time, logged), stretch.memory(time, logged)
    again = stretch.done(carried[[20]], step[20:], true[None, 20:])
    np.testing.assert_allclose(again[0], logged[20:], atol=1e-9)
    assert stretch.constant == (rise == 0.0 and fade is None)


@pytest.mark.parametrize("fade", [FADE, None])
@pytest.mark.parametrize("rise", [RISE, 0.0])
def test_a_position_in_step_moves_as_the_logged_velocity_says(rise, fade):
    """Against the integral of the velocity, by the trapezium rule."""
    time = np.arange(0.0, 20.0, 0.002)
    true = np.stack([np.sin(1.3 * time), np.cos(0.4 * time) - 1.0, 0.3 * np.sin(5.0 * time)], axis=1)
    stretch = VelocityStretch(np.array([1.2, 0.9, 1.0]), rise, fade)
    begin = np.zeros((1, 2, 3))
    logged = stretch.done(begin, np.diff(time), true[None])[0]
    carried = stretch.carried(begin, np.diff(time), logged[None])[0]
    position, there = (
        np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (v[1:] + v[:-1]) * 0.002, axis=0)]) for v in (true, logged)
    )
    followed = stretch.followed(position, carried)
    np.testing.assert_allclose(followed - followed[0], there, atol=2e-4)
    np.testing.assert_allclose(stretch.left(followed, carried), position, atol=1e-12)


def test_faults_taken_as_logged_move_the_position_alone(stretched):
    faults = SensorFaults(**{**vars(BAND), "delay": 0.02, "gyro_lag": 0.01}).as_logged
    assert SensorFaults(delay=0.02).as_logged == SensorFaults()
    horizons = (0.05, 0.5)
    for bad in stretched[:3]:
        log = faults.repaired(bad)
        for name in ("time", "velocity", "quaternion", "body_rate", "command"):
            np.testing.assert_array_equal(getattr(log, name), getattr(bad, name))
        recorded = find_windows(bad, horizons, 0.008, 0.0)
        windows = find_windows(log, faults.reached(horizons), 0.008, 0.0, recorded.start)
        told = faults.as_recorded(perfectly(windows), horizons, faults.began(bad, windows, 0.008))
        np.testing.assert_allclose(told.velocity, recorded.true_velocity, atol=1e-12)
        off = log.position - bad.position
        assert np.abs(off).max() > 2e-3
        assert np.abs(told.position - recorded.true_position).max() < 0.1 * np.abs(off).max()


@pytest.mark.parametrize("delay", [0.0, 0.02])
def test_what_is_recorded_of_a_perfect_prediction_is_the_record(stretched, delay):
    horizons = (0.05, 0.1, 0.2, 0.5)
    faults = SensorFaults(**{**vars(BAND), "delay": delay})
    for bad in stretched[:3]:
        recorded = find_windows(bad, horizons, 0.008, 0.0)
        repaired = faults.repaired(bad)
        windows = find_windows(repaired, faults.reached(horizons), 0.008, 0.0, recorded.start)
        told = faults.as_recorded(perfectly(windows), horizons, faults.began(bad, windows, 0.008))
        wrong = np.abs(recorded.true_velocity - told.velocity)
        # Linear between the times a window is followed at, which noise is not; the stretch itself is far larger.
        assert np.sqrt(np.mean(wrong**2)) < 0.004
        assert np.abs(recorded.true_velocity - windows.true_velocity[:, -1:]).mean() > 0.02


def test_a_band_is_told_from_a_stretch_of_all_motion(flights, stretched):
    found = with_band(SensorFaults(velocity_scale=1.05), stretched)
    assert found.stretch.scale[0] == pytest.approx(1 / (1 - SHARE), abs=0.02)
    assert found.velocity_rise == pytest.approx(RISE, abs=0.06)
    assert found.velocity_fade == pytest.approx(FADE, abs=0.2)
    assert found.vertical_scale == 1.05
    alike = [log.replace(velocity=log.velocity * 1.08) for log in flights]
    even = SensorFaults(velocity_scale=1.08)
    assert with_band(even, alike) == even
    assert with_band(SensorFaults(), stretched) == SensorFaults()
    assert with_band(even, stretched[:2]) == even


def test_a_model_file_names_a_band():
    assert SensorFaults.from_mappings(BAND.to_mappings(), "drone.yaml") == BAND
    assert SensorFaults(velocity_rise=RISE, velocity_fade=FADE).to_mappings() == []
    assert SensorFaults.from_mappings(BAND.as_logged.to_mappings(), "drone.yaml") == BAND.as_logged
    for key, value in (("rise", -0.1), ("fade", 0.0), ("rise", "slow"), ("with_attitude", 0.5)):
        item = {"name": "sensor_velocity_scale", "parameters": {"scale": 1.1, key: value}}
        with pytest.raises(CfbError, match=f"drone.yaml: effects.sensor_velocity_scale.parameters.{key}"):
            SensorFaults.from_mappings([item], "drone.yaml")


@pytest.mark.parametrize(("rise", "fade"), [(0.0, None), (0.3, None), (0.3, 0.7)])
def test_a_flights_own_stretch_is_learnt_from_its_past_alone(rise, fade):
    """The flight was stretched otherwise than those the model was fitted to; later rows change nothing before them."""
    rng, time = np.random.default_rng(0), 0.01 * np.arange(1500)
    true = np.stack([np.sin(1.3 * time), np.cos(2.1 * time) - 0.5 * np.sin(0.7 * time), 0.2 * np.sin(time)], axis=1)
    flown = VelocityStretch(np.array([1.4, 1.4, 1.0]), rise, fade)
    believed = VelocityStretch(np.array([1.1, 1.1, 1.0]), rise, fade)
    start = np.zeros((1, 2, 3))
    start[:, 0] = true[0]
    start[:, 1] = 0.0 if fade is None else true[0]
    velocity = flown.done(start, np.diff(time), true[None])[0]
    steps = 0.01 * (true[1:] + true[:-1]) / 2
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]) + 0.001 * rng.normal(size=true.shape)
    found = believed.learned(time, velocity, position)
    assert found[0] == pytest.approx([1.1, 1.1, 1.0])
    assert found[-1] == pytest.approx([1.4, 1.4, 1.0], abs=0.02)
    assert np.all(found[:, 2] == 1.0)
    late = np.arange(1500)[:, None] > 700
    spoilt = believed.learned(time, np.where(late, 5.0, velocity), np.where(late, -3.0, position))
    np.testing.assert_array_equal(spoilt[:701], found[:701])
    assert np.abs(spoilt[-1] - found[-1]).max() > 0.01
