"""Files every command-line test needs: a good log, and a way to run the command as a user does."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cfb_mjx.logs import FlightLog, write_mcap, write_tabular

CFB = str(Path(sys.executable).with_name("cfb"))


@pytest.fixture(scope="session")
def cfb():
    """Run ``cfb ARGUMENTS`` in a process of its own."""

    def run(*arguments, **options):
        options = {"capture_output": True, "text": True, "timeout": 240} | options
        return subprocess.run([CFB, *map(str, arguments)], check=False, **options)

    return run


@pytest.fixture(scope="session")
def flight() -> FlightLog:
    """Two and a half seconds of near-hover with consistent pose, velocity and gyro."""
    rng = np.random.default_rng(0)
    time = np.arange(0, 2.5, 0.004)
    n = len(time)
    roll = 0.2 * np.sin(4 * time)
    zero = np.zeros(n)
    # Thrust that carries the drone, tilted by the roll.
    sideways = np.cumsum(-9.81 * np.tan(roll)) * 0.004 + 0.49
    return FlightLog(
        time=time,
        position=np.stack([zero, np.cumsum(sideways) * 0.004, 1 + zero], axis=1),
        velocity=np.stack([zero, sideways, zero], axis=1),
        quaternion=np.stack([np.cos(roll / 2), np.sin(roll / 2), zero, zero], axis=1),
        body_rate=np.stack([0.8 * np.cos(4 * time), zero, zero], axis=1) + 0.01 * rng.normal(size=(n, 3)),
        specific_force=np.stack([zero, zero, 9.81 / np.cos(roll)], axis=1) + 0.05 * rng.normal(size=(n, 3)),
        command=np.full((n, 4), 0.55) + 0.01 * rng.normal(size=(n, 4)),
        rotor_speed=None,
        battery_voltage=np.linspace(4.0, 3.9, n),
        metadata={"name": "flight", "source": "flight.csv", "format": "tabular", "observation_delay": None},
    )


@pytest.fixture(scope="session")
def files(flight, tmp_path_factory) -> Path:
    """A folder with the flight as flight.mcap, flight.parquet and flight.csv."""
    folder = tmp_path_factory.mktemp("flight")
    write_mcap(flight, folder / "flight.mcap")
    write_tabular(flight, folder / "flight.parquet")
    write_tabular(flight, folder / "flight.csv")
    return folder
