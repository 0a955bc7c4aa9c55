"""Prediction windows follow the protocol: starts, gaps, delay, what is held and what is interpolated."""

from dataclasses import replace

import numpy as np
import pytest

from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.flight import prepare_flight
from cfb_mjx.sysid.windows import find_starts, find_windows

HORIZONS = (0.05, 0.1, 0.2, 0.5)


def make_log(time, rotor_speed=None, **metadata):
    n = len(time)
    ramp = np.asarray(time, dtype=float)
    return FlightLog(
        time=ramp,
        position=np.stack([ramp, 2 * ramp, 0 * ramp], axis=1),
        velocity=np.tile([1.0, 2.0, 0.0], (n, 1)),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        body_rate=np.stack([ramp, 0 * ramp, 0 * ramp], axis=1),
        specific_force=np.tile([0.0, 0.0, 9.81], (n, 1)),
        command=np.tile(np.arange(n)[:, None] / n, (1, 4)),
        rotor_speed=rotor_speed,
        battery_voltage=None,
        metadata={"name": "made", "source": "made.csv", "format": "tabular", "observation_delay": None, **metadata},
    )


def test_starts_are_every_fifth_of_a_second_from_six_tenths():
    starts = find_starts(make_log(np.arange(0, 2.0001, 0.004)), HORIZONS, 0.008, 0.0)
    # 1.4 + 0.53 lies inside 2.0, 1.6 + 0.53 does not.
    np.testing.assert_allclose(starts, [0.6, 0.8, 1.0, 1.2, 1.4])


def test_a_first_sample_a_little_late_does_not_shift_the_windows():
    starts = find_starts(make_log(0.0039 + np.arange(0, 2.0, 0.004)), HORIZONS, 0.008, 0.0)
    assert starts[0] == 0.6


def test_a_log_that_starts_elsewhere_counts_from_its_first_row():
    starts = find_starts(make_log(1000.0 + np.arange(0, 2.0001, 0.004)), HORIZONS, 0.008, 0.0)
    np.testing.assert_allclose(starts[0], 1000.6)


def test_too_short_a_log_has_no_window():
    log = make_log(np.arange(0, 1.0, 0.004))
    assert len(find_starts(log, HORIZONS, 0.008, 0.0)) == 0
    assert len(find_windows(log, HORIZONS, 0.008, 0.0)) == 0


@pytest.mark.parametrize(
    ("gap_begin", "gap_end", "lost"),
    [
        (2.0, 2.1, [1.6, 1.8, 2.0, 2.2]),  # begins in [t0 - 0.3, t0 + 0.5]
        (2.104, 2.150, [1.8, 2.0, 2.2, 2.4]),  # 1.6 + 0.508 = 2.108 falls in the gap too
        (2.0, 2.012, []),  # three missing intervals are no gap
        (2.0, 2.5, [1.6, 1.8, 2.0, 2.2, 2.4]),  # 2.4 starts inside the gap
        (2.0, 2.404, [1.6, 1.8, 2.0, 2.2, 2.4]),  # its gyro does, its late pose does not
    ],
)
def test_gaps_end_windows(gap_begin, gap_end, lost):
    time = np.arange(0, 4.0001, 0.004)
    time = time[(time < gap_begin + 1e-9) | (time > gap_end - 1e-9)]
    starts = find_starts(make_log(time), HORIZONS, 0.008, 0.0)
    every = 0.6 + 0.2 * np.arange(15)
    missing = [round(t, 3) for t in every if not np.any(np.abs(starts - t) < 1e-9)]
    if gap_begin == 2.104:
        lost = [1.6, *lost]
    assert missing == lost


def with_step(begin, step, interval=0.004, end=4.0):
    """Rows every ``interval``, but for one step, which begins at ``begin``."""
    before = np.append(np.arange(0, begin - 1e-9, interval), begin)
    return np.concatenate([before, np.arange(begin + step, end + 1e-9, interval)])


@pytest.mark.parametrize("interval", [0.002, 0.004, 0.01])
def test_a_gap_is_longer_than_three_intervals_and_half_a_millisecond(interval):
    longest = 3 * interval + 0.5e-3
    whole = find_starts(make_log(np.arange(0, 4.0001, interval)), HORIZONS, 0.008, 0.0)
    for step, lost in ((longest - 1e-5, 0), (longest + 1e-5, 4)):
        # 2.15 lies within [t0 - 0.3, t0 + 0.5] of 1.8, 2.0, 2.2 and 2.4.
        starts = find_starts(make_log(with_step(2.15, step, interval)), HORIZONS, 0.008, 0.0)
        assert len(whole) - len(starts) == lost


def test_a_window_lasts_530_milliseconds():
    """0.5 s of prediction and 30 ms for readings that come late."""
    for last, expected in ((1.93, 1.4), (1.929, 1.2)):
        starts = find_starts(make_log(np.append(np.arange(0, last - 1e-9, 0.004), last)), HORIZONS, 0.008, 0.0)
        assert starts[-1] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("begin", "step", "lost"),
    [
        # 300 ms before 2.4 ...
        (2.099, 0.05, [1.6, 1.8, 2.0, 2.2]),
        (2.1085, 0.05, [1.8, 2.0, 2.2, 2.4]),
        # ... 500 ms after 1.6, though nothing is read within the gap, and after that where a late pose is.
        (2.086, 0.0126, [1.6, 1.8, 2.0, 2.2]),
        (2.1005, 0.0126, [1.6, 1.8, 2.0, 2.2, 2.4]),
    ],
)
def test_gaps_count_from_300_ms_before_a_start_to_500_ms_after(begin, step, lost):
    starts = find_starts(make_log(with_step(begin, step)), HORIZONS, 0.008, 0.0)
    every = 0.6 + 0.2 * np.arange(15)
    assert [round(t, 3) for t in every if not np.any(np.abs(starts - t) < 1e-9)] == lost


def test_errors_are_taken_after_50_100_200_and_500_ms():
    assert evaluate(Quadrotor.from_file("cfb"), [make_log(np.arange(0, 2.0, 0.004))]).horizons == HORIZONS


def test_pose_is_read_late_by_the_delay_and_gyro_is_not():
    delay, time = 0.0065, np.arange(0, 3.0, 0.004)
    zero = 0 * time
    turning = np.stack([np.cos(time / 2), zero, zero, np.sin(time / 2)], axis=1)
    log = replace(make_log(time), velocity=np.stack([3 * time, zero, zero], axis=1), quaternion=turning)
    windows = find_windows(log, HORIZONS, delay, 0.0)
    for late, velocity, quaternion in (
        (windows.start + delay, windows.velocity, windows.quaternion),
        (windows.start[:, None] + np.array(HORIZONS) + delay, windows.true_velocity, windows.true_quaternion),
    ):
        np.testing.assert_allclose(velocity[..., 0], 3 * late, atol=1e-12)
        np.testing.assert_allclose(2 * np.arctan2(quaternion[..., 3], quaternion[..., 0]), late, atol=1e-6)
    np.testing.assert_allclose(windows.position[:, 0], windows.start + delay, atol=1e-12)
    np.testing.assert_allclose(windows.body_rate[:, 0], windows.start, atol=1e-12)
    ends = windows.start[:, None] + np.array(HORIZONS)
    np.testing.assert_allclose(windows.true_position[..., 0], ends + delay, atol=1e-12)
    np.testing.assert_allclose(windows.true_body_rate[..., 0], ends, atol=1e-12)


def test_a_gyro_that_is_late_is_read_late():
    log = make_log(np.arange(0, 3.0, 0.004))
    windows = find_windows(log, HORIZONS, 0.0065, 0.003)
    ends = windows.start[:, None] + np.array(HORIZONS)
    np.testing.assert_allclose(windows.position[:, 0], windows.start + 0.0065, atol=1e-12)
    np.testing.assert_allclose(windows.body_rate[:, 0], windows.start + 0.003, atol=1e-12)
    np.testing.assert_allclose(windows.true_body_rate[..., 0], ends + 0.003, atol=1e-12)
    np.testing.assert_allclose(prepare_flight(log, 0.0065, 0.003).body_rate[:700, 0], log.time[:700] + 0.003)


@pytest.mark.parametrize("delays", [(0.09, 0.0), (0.008, 0.09)])
def test_no_window_reads_what_comes_after_the_logs_end(delays):
    # The last start without that age, 2.4 s, would reach 2.99 s.
    log = make_log(np.arange(0, 2.9601, 0.004))
    windows = find_windows(log, HORIZONS, *delays)
    assert windows.start[-1] + HORIZONS[-1] + 0.09 <= log.time[-1] < windows.start[-1] + HORIZONS[-1] + 0.09 + 0.2
    ends = windows.start[:, None] + np.array(HORIZONS)
    np.testing.assert_allclose(windows.true_position[..., 0], ends + delays[0], atol=1e-12)


@pytest.mark.parametrize("rate", [250, 100, 48])
def test_steps_reach_every_horizon_and_hold_each_rows_command(rate):
    time = np.arange(0, 3.0, 1 / rate)
    log = make_log(time)
    windows = find_windows(log, HORIZONS, 0.008, 0.0)
    elapsed = np.concatenate([np.zeros((len(windows), 1)), np.cumsum(windows.step, axis=1)], axis=1)
    reached = np.take_along_axis(elapsed, windows.at, axis=1)
    np.testing.assert_allclose(reached, np.tile(HORIZONS, (len(windows), 1)), atol=1e-9)
    assert windows.step.max() <= 0.0051
    # The mean command over the window, computed from the rows alone at 0.1 ms.
    fine = windows.start[0] + np.arange(0, 0.5, 1e-4) + 5e-5
    ticks = np.ceil(time * 1000 - 1e-6) / 1000
    expected = log.command[np.searchsorted(ticks, fine, side="right") - 1, 0].mean()
    used = np.sum(windows.command[0, :, 0] * windows.step[0]) / 0.5
    np.testing.assert_allclose(used, expected, rtol=1e-4)


def test_rotor_speed_is_linear_between_rows_and_missing_where_not_measured():
    time = np.arange(0, 4.0, 0.01)
    speed = np.tile((1000 + 100 * time)[:, None], (1, 4))
    speed[150, 0] = np.nan  # one bad reading is bridged
    speed[250:260, 1] = np.nan  # a run is not
    windows = find_windows(make_log(time, rotor_speed=speed), HORIZONS, 0.008, 0.0)
    measured = np.isfinite(windows.rotor_speed).all(axis=(1, 2))
    touched = (windows.start <= 2.6) & (windows.start + 0.5 >= 2.49)
    assert np.array_equal(measured, ~touched)
    chosen = windows.rotor_speed[measured][:, 0, 0]
    np.testing.assert_allclose(chosen, 1000 + 100 * windows.start[measured], atol=1e-9)
