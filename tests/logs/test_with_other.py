"""Two drones that flew at the same time, on one clock."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cfb_mjx import cli
from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.logs import FlightLog, with_other, write_tabular


def flight(start: float = 0.0, seconds: float = 4.0, height: float = 1.0, name: str = "a", **more) -> FlightLog:
    time = start + np.arange(0.0, seconds, 0.004)
    n = len(time)
    position = np.stack([np.sin(time), 0.5 * time, np.full(n, height)], axis=1)
    velocity = np.stack([np.cos(time), np.full(n, 0.5), np.zeros(n)], axis=1)
    fields = {
        "position": position,
        "velocity": velocity,
        "quaternion": np.tile([np.cos(0.1), np.sin(0.1), 0.0, 0.0], (n, 1)),
        "body_rate": np.zeros((n, 3)),
        "specific_force": np.tile([0.0, 0.0, 9.81], (n, 1)),
        "command": np.full((n, 4), 0.6),
        "metadata": {"name": name, "observation_delay": 0.008},
    }
    return FlightLog(time=time, **fields | more)


def test_the_other_drone_is_where_it_was():
    log, other = flight(0.5, 3.0), flight(0.0, 4.0, height=1.7, name="b")
    found = with_other(log, other).other
    # Its pose was 8 ms old when its rows were written.
    at = log.time + 0.008
    np.testing.assert_allclose(found[:, :3], np.stack([np.sin(at), 0.5 * at, np.full(len(at), 1.7)], axis=1), atol=1e-4)
    np.testing.assert_allclose(found[:, 3], np.cos(at), atol=1e-4)
    # Rolled by 0.2 rad, its thrust points to negative y.
    np.testing.assert_allclose(
        found[:, 6:], np.tile([0.0, -9.81 * np.sin(0.2), 9.81 * np.cos(0.2)], (len(at), 1)), atol=1e-9
    )


def test_rows_gaps_and_standing_rotors():
    log = flight()
    later = flight(1.0, 4.0, name="b")
    with pytest.warns(CfbWarning, match="b: covers 75% of a; elsewhere no other drone is assumed"):
        found = with_other(log, later)
    assert np.isnan(found.other[log.time < 1.0]).all()
    assert np.isfinite(found.other[log.time > 1.01]).all()
    assert found.rows(slice(10)).other.shape == (10, 9)
    assert not with_other(log, flight(name="b", command=np.zeros((len(log), 4)))).other[:, 6:].any()


def test_a_flight_of_another_time_is_refused():
    with pytest.raises(CfbError, match="flew at the same time"):
        with_other(flight(), flight(100.0, name="b"))


def test_each_log_needs_one_of_the_other_drone(tmp_path, capsys):
    for name in ("a", "b", "c"):
        write_tabular(dataclasses.replace(flight(seconds=12.0), metadata={"name": name}), tmp_path / f"{name}.csv")
    words = ["--fit", tmp_path / "a.csv", "--held-out", tmp_path / "b.csv", "--with", tmp_path / "c.csv"]
    assert cli.main([*map(str, ["close-loop", *words, "-o", tmp_path / "out"])]) == 2
    assert "--with: 1 logs of another drone for 2 logs" in capsys.readouterr().err
