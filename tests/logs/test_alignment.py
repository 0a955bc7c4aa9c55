import numpy as np
import pytest
from synthetic_logs import make_flight, same_data

from cfb_mjx.logs import apply_shift, estimate_command_shift


@pytest.mark.parametrize("method", ["rotor_speed", "command"])
@pytest.mark.parametrize("lead_ms", [-20, -7, 0, 4, 11, 30])
def test_known_shift_is_found(lead_ms, method):
    log = make_flight(motor_lead=lead_ms * 1e-3, noise=0.05)
    estimate = estimate_command_shift(log, method)
    assert estimate.shift_s * 1e3 == pytest.approx(lead_ms, abs=1.0)
    assert estimate.reliable
    assert estimate.std_s < 0.001
    assert estimate.gain == pytest.approx(1.0, abs=0.15)


def test_rotor_speed_is_preferred_and_command_the_fallback(flight):
    assert estimate_command_shift(flight).method == "rotor_speed"
    assert estimate_command_shift(flight.replace(rotor_speed=None)).method == "command"
    mostly_invalid = np.where(np.arange(len(flight))[:, None] % 3 == 0, flight.rotor_speed, np.nan)
    assert estimate_command_shift(flight.replace(rotor_speed=mostly_invalid)).method == "command"


@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
def test_irregular_sampling_gaps_and_invalid_samples(rate):
    log = make_flight(
        duration=14.0, rate=rate, jitter=0.7, motor_lead=0.011, noise=0.05, drop=[(3.0, 3.2), (7.5, 7.55), (10.0, 10.4)]
    )
    speed = log.rotor_speed.copy()
    speed[::37, 2] = np.nan
    estimate = estimate_command_shift(log.replace(rotor_speed=speed))
    assert estimate.shift_s == pytest.approx(0.011, abs=0.0015)
    assert estimate.reliable


def test_time_constant_error_hardly_matters():
    """The lag of a wrong motor model must not be mistaken for a shift: 10 ms of time constant, about 1 ms of lag."""
    log = make_flight()
    rise = np.gradient(log.rotor_speed, log.time, axis=0)
    right, slow = (log.replace(command=(log.rotor_speed + tau * rise) / 2900.0) for tau in (0.050, 0.060))
    difference = estimate_command_shift(slow, "command").shift_s - estimate_command_shift(right, "command").shift_s
    assert 0.0002 < abs(difference) < 0.0015


def test_hover_is_reported_as_unreliable():
    log = make_flight(excitation=0.0, noise=0.05)
    assert not estimate_command_shift(log).reliable
    assert not estimate_command_shift(log, "command").reliable


def test_too_short_or_too_slow_is_no_estimate(flight):
    for log in (flight.slice(0, 1), flight.rows(slice(None, None, 10)), flight.rows(slice(0, 2))):
        estimate = estimate_command_shift(log)
        assert (estimate.shift_s, estimate.std_s, estimate.blocks) == (0.0, float("inf"), 0)
        assert not estimate.reliable


def test_estimate_is_deterministic(flight):
    assert estimate_command_shift(flight) == estimate_command_shift(flight)


def test_unknown_method(flight):
    with pytest.raises(ValueError, match="rotor_speed"):
        estimate_command_shift(flight, "guess")


@pytest.mark.parametrize("lead", [0.012, -0.008, 0.0031])
def test_applying_the_estimate_removes_the_shift(lead):
    log = make_flight(motor_lead=lead, rate=500.0)
    aligned = apply_shift(log, estimate_command_shift(log).shift_s)
    assert abs(estimate_command_shift(aligned).shift_s) < 0.0007


@pytest.mark.parametrize("samples", [-3, 1, 5])
def test_whole_samples_move_rows_without_interpolation(flight, samples):
    moved = apply_shift(flight, samples * 0.004)
    kept = slice(samples, None) if samples > 0 else slice(None, samples)
    source = slice(None, -samples) if samples > 0 else slice(-samples, None)
    assert np.array_equal(moved.time, flight.time[kept])
    assert np.array_equal(moved.command, flight.command[source])
    assert np.array_equal(moved.rotor_speed, flight.rotor_speed[source])
    assert np.array_equal(moved.body_rate, flight.body_rate[kept])


def test_zero_shift_changes_nothing(flight):
    assert same_data(apply_shift(flight, 0.0), flight)


def test_gaps_grow_and_are_never_filled():
    log = make_flight(duration=4.0, drop=[(2.0, 2.2)])
    moved = apply_shift(log, 0.02)
    (gap,) = moved.gaps()
    assert moved.time[gap] == pytest.approx(1.996)
    # The first row after the gap whose command was recorded 20 ms earlier.
    assert moved.time[gap + 1] >= log.time[log.gaps()[0] + 1] + 0.02 - 1e-3
    assert set(map(tuple, moved.command)) <= set(map(tuple, log.command))
