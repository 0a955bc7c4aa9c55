"""Write the flights of a controller as figure, recording, film or log."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.logs import write_mcap
from cfb_mjx.model import Quadrotor, rotors
from cfb_mjx.train.flight_logs import flight_log
from cfb_mjx.train.flips import FLOOR_M
from cfb_mjx.train.flying import Flight, steps_flown
from cfb_mjx.view.film import Path3D, write_film
from cfb_mjx.view.flight import flight_figure
from cfb_mjx.view.flight_recording import write_flight_recording
from cfb_mjx.view.flip import flip_figure

HEIGHT_M = 1.0
"""Height of the target above the floor of a film, m; flips are shown `FLOOR_M` above it."""


def write_flights(
    flown: Flight,
    dt: float,
    nominal: Quadrotor,
    title: str = "",
    flips: bool = False,
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
        flips: whether the flights are flips.
        figure: file of the figure; None writes none.
        recording: file of the rerun recording; None writes none.
        video: file of a film of the first flight; None writes none.
        log: file of a flight log of the first flight; None writes none.

    Raises:
        CfbError: a file cannot be written, or a program or library for it is not installed.
    """
    parameters = nominal.changed_parameters()
    if figure is not None:
        (flip_figure if flips else flight_figure)(flown, dt, figure, title)
    if recording is not None:
        thrust = np.asarray(rotors.thrust(parameters, flown.rotor_speed[:1]))
        write_flight_recording(recording, flown, dt, thrust)
    if video is not None:
        thrust = np.asarray(rotors.thrust(parameters, flown.rotor_speed[0]))
        write_film(video, _first(flown, dt, thrust, FLOOR_M if flips else HEIGHT_M))
    if log is not None:
        write_mcap(flight_log(flown, dt, log.stem, float(parameters.gravity)), log)


def _first(flown: Flight, dt: float, thrust: np.ndarray, height_m: float) -> Path3D:
    """The first flight, for a film; if the drone is lost, up to that time."""
    rows = slice(steps_flown(flown))
    position = np.asarray(flown.position[0], float) + np.array([0.0, 0.0, height_m])
    time = dt * (1 + np.arange(len(position)))
    return Path3D(time[rows], position[rows], np.asarray(flown.quaternion[0])[rows], thrust[rows])
