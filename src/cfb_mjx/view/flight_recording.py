"""Rerun recording of a controller's flights: drones and paths in 3D, set-point, thrust, commands and rates."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.view.recorder import Plot, Tab, recording
from cfb_mjx.view.style import COLOURS

DRONES = 40
"""Largest number of drones in a recording."""
_MOTORS = ("M1", "M2", "M3", "M4")


def write_flight_recording(path: str | Path, flown, dt: float, thrust=None) -> None:
    """Write a recording that `rerun` opens.

    Every drone has its pose and path under ``world/<number>``; the set-point is ``world/set-point``. Commands, body
    rates and velocities of the first drone are under ``signal``.

    Args:
        path: file to write, ``.rrd``.
        flown: a `cfb_mjx.train.flying.Flight` with axes (drones, steps).
        dt: time between two commands, s.
        thrust: (drones, steps, 4) N, drawn as arrows on the first drone; None: no arrows.

    Raises:
        CfbError: rerun is not installed or the file cannot be written.
    """
    position, quaternion = np.asarray(flown.position), np.asarray(flown.quaternion)
    time = dt * (1 + np.arange(position.shape[1]))
    signals = {
        "command": (np.asarray(flown.command)[0], _MOTORS),
        "body rate": (np.degrees(np.asarray(flown.body_rate)[0]), ("x, deg/s", "y, deg/s", "z, deg/s")),
        "velocity": (np.asarray(flown.velocity)[0], ("x, m/s", "y, m/s", "z, m/s")),
    }
    plots = tuple(Plot(name, (f"signal/{_entity(name)}/**",)) for name in signals)
    # Drones that failed may be far away or have NaN positions.
    well = position[np.isfinite(position).all(axis=-1) & ~np.asarray(flown.failed)]
    seen = np.stack([well.min(axis=0), well.max(axis=0)]) if len(well) else None
    with recording("cfb_fly", [Tab("flight", "world", plots, seen)], path) as recorder:
        recorder.world("world")
        recorder.point("world/set-point", time[:1], np.zeros((1, 3)), COLOURS["commands_in"])
        for i in range(min(DRONES, len(position))):
            there = np.isfinite(position[i]).all(axis=1)
            recorder.line(f"world/{i}/way", position[i][there])
            arrows = None if thrust is None or i else np.asarray(thrust)[0]
            recorder.drone(f"world/{i}/drone", time, position[i], quaternion[i], arrows)
        for name, (values, labels) in signals.items():
            for column, label in zip(values.T, labels, strict=True):
                recorder.series(f"signal/{_entity(name)}/{label[:2].strip(',')}", time, column, label)


def _entity(name: str) -> str:
    return name.replace(" ", "_")
