import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_logs import make_flight, same_data

from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.flight_log import from_nanoseconds, quantise_time, to_nanoseconds


def test_arrays_are_read_only_float64_copies(short):
    mine = np.array(short.time, dtype=np.float32)
    log = short.replace(time=mine)
    mine[0] = 99.0
    assert log.time[0] != 99.0
    assert log.time.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        log.position[0, 0] = 1.0


def test_metadata_is_immutable_json(short):
    log = short.replace(metadata={"bad": float("nan"), "array": np.arange(2), "pair": (1, 2.5)})
    assert (log.metadata["bad"], log.metadata["array"], log.metadata["pair"]) == (None, [0, 1], [1, 2.5])
    assert log.name == "synthetic"
    with pytest.raises(TypeError):
        log.metadata["name"] = "other"


def test_wrong_shape_is_refused(short):
    with pytest.raises(ValueError, match="command"):
        short.replace(command=short.command[:, :3])


def test_gaps_follow_the_evaluation_protocol():
    log = make_flight(duration=2.0, rate=100.0, drop=[(0.995, 1.025)])
    assert log.nominal_interval == pytest.approx(0.01)
    assert log.gap_threshold == pytest.approx(0.0305)
    steps = np.diff(log.time)
    (gap,) = log.gaps()
    assert steps[gap] == pytest.approx(0.04)
    assert [s.stop - s.start for s in log.segments()] == [gap + 1, len(log) - gap - 1]
    assert len(make_flight(duration=2.0, rate=100.0, drop=[(0.995, 1.015)]).gaps()) == 0  # 30 ms is not a gap


def test_slice_keeps_times(flight):
    part = flight.slice(1.0, 2.0)
    assert part.time[0] == 1.0
    assert part.time[-1] == 2.0
    assert len(part.rotor_speed) == len(part)
    assert part.name == flight.name
    assert part.duration == 1.0


def test_repr_names_the_essentials(flight):
    assert "synthetic" in repr(flight)
    assert "250 Hz" in repr(flight)


def test_copies(short):
    for other in (pickle.loads(pickle.dumps(short)), copy.deepcopy(short)):
        assert same_data(short, other)
        assert other.metadata == short.metadata


def test_empty_log_has_no_duration(short):
    empty = short.rows(slice(0, 0))
    assert (len(empty), empty.duration, empty.nominal_interval) == (0, 0.0, 0.0)
    assert isinstance(empty, FlightLog)
    assert repr(empty)


@given(st.lists(st.floats(-1e9, 2e9), min_size=1, max_size=20))
def test_time_survives_nanoseconds(values):
    once = quantise_time(np.array(values))
    assert np.abs(once - values).max() <= 0.5e-9 + np.spacing(np.abs(values).max())
    assert quantise_time(once).tobytes() == once.tobytes()
    seconds, nanos = to_nanoseconds(once)
    assert ((nanos >= 0) & (nanos < 1e9)).all()
    assert from_nanoseconds(seconds, nanos).tobytes() == once.tobytes()


def test_import_is_light():
    code = (
        "import sys, cfb_mjx.logs; "
        "heavy = [m for m in ('jax', 'pyarrow', 'mcap', 'google.protobuf', 'scipy') if m in sys.modules]; "
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
