"""Flights of a controller as figure, recording, film or log (`write_flights`).

The recording has drones and paths in 3D, set-point, thrust, commands and rates.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.logs import write_mcap
from cfb_mjx.model import Quadrotor, rotors
from cfb_mjx.train.flight import Flight, flight_log, steps_flown
from cfb_mjx.train.flips import FLOOR_M
from cfb_mjx.train.measuring import TRACKED
from cfb_mjx.view.film import Path3D, write_film
from cfb_mjx.view.flight_figures import flight_figure, flip_figure, land_figure, track_figure
from cfb_mjx.view.recorder import Plot, Tab, recording
from cfb_mjx.view.style import COLOURS

DRONES = 40
"""Largest number of drones in a recording."""
_MOTORS = ("M1", "M2", "M3", "M4")


def write_flight_recording(path: str | Path, flown, dt: float, thrust=None, target=None) -> None:
    """Write a recording that `rerun` opens.

    Every drone has its pose and path under ``world/<number>``; the set-point is ``world/set-point``. Commands, body
    rates and velocities of the first drone are under ``signal``.

    Args:
        path: file to write, ``.rrd``.
        flown: a `cfb_mjx.train.flight.Flight` with axes (drones, steps).
        dt: time between two commands, s.
        thrust: (drones, steps, 4) N, drawn as arrows on the first drone; None: no arrows.
        target: (steps, 3) m, a target that moves; None: the origin.

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
        times, places = (time[:1], np.zeros((1, 3))) if target is None else (time, target)
        recorder.point("world/set-point", times, places, COLOURS["commands_in"])
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


HEIGHT_M = 1.0
"""Height of the target above the floor of a film, m; flips are shown `FLOOR_M` above it, landings at 0."""


def write_flights(
    flown: Flight,
    dt: float,
    nominal: Quadrotor,
    title: str = "",
    kind: str = "hover",
    figure: Path | None = None,
    recording: Path | None = None,
    video: Path | None = None,
    log: Path | None = None,
) -> None:
    """Write the requested files.

    Args:
        flown: flights, axes (drones, steps).
        dt: time between two commands, s.
        nominal: model whose thrust curve gives the thrust arrows.
        title: title of the figure.
        kind: what was flown: ``flip``, ``land`` and those in `TRACKED` have figures of their own.
        figure: file of the figure; None writes none.
        recording: file of the rerun recording; None writes none.
        video: file of a film of the first flight; None writes none.
        log: file of a flight log of the first flight; None writes none.

    Raises:
        CfbError: a file cannot be written, or a program or library for it is not installed.
    """
    parameters = nominal.changed_parameters()
    if figure is not None:
        draw = {"flip": flip_figure, "land": land_figure}.get(kind, track_figure if kind in TRACKED else flight_figure)
        draw(flown, dt, figure, title)
    if recording is not None:
        thrust = np.asarray(rotors.thrust(parameters, flown.rotor_speed[:1]))
        moving = kind == "land" or kind in TRACKED
        write_flight_recording(recording, flown, dt, thrust, np.asarray(flown.watched)[0] if moving else None)
    if video is not None:
        thrust = np.asarray(rotors.thrust(parameters, flown.rotor_speed[0]))
        write_film(video, _first(flown, dt, thrust, {"flip": FLOOR_M, "land": 0.0}.get(kind, HEIGHT_M)))
    if log is not None:
        write_mcap(flight_log(flown, dt, log.stem, float(parameters.gravity)), log)


def _first(flown: Flight, dt: float, thrust: np.ndarray, height_m: float) -> Path3D:
    """The first flight, for a film; if the drone is lost, up to that time."""
    rows = slice(steps_flown(flown))
    position = np.asarray(flown.position[0], float) + np.array([0.0, 0.0, height_m])
    time = dt * (1 + np.arange(len(position)))
    return Path3D(time[rows], position[rows], np.asarray(flown.quaternion[0])[rows], thrust[rows])
