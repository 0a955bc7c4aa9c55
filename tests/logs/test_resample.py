import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_logs import make_flight, same_data

from cfb_mjx.logs import resample, rotation, validate


def test_its_own_grid_changes_nothing(flight):
    assert same_data(resample(flight, 250.0), flight)


def test_finer_grid_interpolates(flight):
    fine = resample(flight, 1000.0)
    truth = make_flight(rate=1000.0)
    n = len(fine)
    assert np.diff(fine.time) == pytest.approx(0.001)
    assert np.abs(fine.position - truth.position[:n]).max() < 1e-4
    assert np.abs(fine.body_rate - truth.body_rate[:n]).max() < 0.02
    error = rotation.rotation_vector(rotation.multiply(rotation.conjugate(truth.quaternion[:n]), fine.quaternion))
    assert np.abs(error).max() < 2e-4
    assert fine.metadata["resampled_hz"] == 1000.0


def test_commands_are_held(flight):
    fine = resample(flight, 1000.0)
    assert np.array_equal(fine.command[:8], np.repeat(flight.command[:2], 4, axis=0))


def test_gaps_stay_gaps():
    log = make_flight(duration=4.0, jitter=0.5, drop=[(1.0, 1.1), (2.0, 2.5)])
    for rate in (100.0, 250.0, 400.0):
        out = resample(log, rate)
        edges = np.column_stack([log.time[log.gaps()], log.time[log.gaps() + 1]])
        for start, stop in edges:
            assert not ((out.time > start + 1e-6) & (out.time < stop - 1e-6)).any()
        assert len(out.gaps()) == 2
        validate(out, "x")


def test_invalid_rotor_speeds_do_not_spread(flight):
    speed = flight.rotor_speed.copy()
    speed[10, 0] = np.nan
    log = flight.replace(rotor_speed=speed)
    assert np.isnan(resample(log, 250.0).rotor_speed).sum() == 1
    assert np.isnan(resample(log, 500.0).rotor_speed).sum() == 3


def test_double_cover_takes_the_shorter_way(flight):
    flipped = flight.replace(quaternion=flight.quaternion * np.where(np.arange(len(flight)) % 2, -1.0, 1.0)[:, None])
    assert np.allclose(resample(flipped, 700.0).quaternion, resample(flight, 700.0).quaternion, atol=1e-12)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_rate(flight, rate):
    with pytest.raises(ValueError, match="rate must be positive"):
        resample(flight, rate)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(rate=st.floats(20.0, 2000.0), jitter=st.floats(0.0, 0.9), seed=st.integers(0, 3))
def test_invariants(rate, jitter, seed):
    log = make_flight(1.0, 200.0, seed, jitter=jitter)
    out = resample(log, rate)
    assert np.allclose(np.diff(out.time) * rate, 1.0, atol=1e-4)
    assert out.time[0] == log.time[0]
    assert log.time[-1] - out.time[-1] < 1.0 / rate + 1e-6
    assert np.allclose(np.linalg.norm(out.quaternion, axis=1), 1.0, atol=1e-12)
    for field in ("position", "velocity", "body_rate", "specific_force", "command", "rotor_speed"):
        old, new = getattr(log, field), getattr(out, field)
        assert (new >= old.min(axis=0) - 1e-9).all()
        assert (new <= old.max(axis=0) + 1e-9).all()
