"""What ``cfb fly`` writes of flights beside numbers: figure, recording, film, log."""

from __future__ import annotations

import numpy as np

from cfb_mjx.cli.flying import Outputs
from cfb_mjx.model import Quadrotor, rotors
from cfb_mjx.train.flips import FLOOR_M
from cfb_mjx.train.flying import Flight, steps_flown

HEIGHT_M = 1.0
"""Of the target above the floor of a film; flips are flown `FLOOR_M` above it."""


def write_flights(outputs: Outputs, flown: Flight, dt: float, nominal: Quadrotor, title: str, turning: bool) -> None:
    """Write what was asked for.

    Args:
        outputs: which files.
        flown: flights, axes (drones, steps).
        dt: time between two commands, s.
        nominal: the model, whose thrust curve the arrows have.
        title: of the figure.
        turning: whether these are flips.

    Raises:
        CfbError: a file cannot be written, or what it needs is not installed.
    """
    parameters = nominal.changed_parameters()
    if outputs.figure is not None:
        from cfb_mjx.view.flight import flight_figure
        from cfb_mjx.view.flip import flip_figure

        (flip_figure if turning else flight_figure)(flown, dt, outputs.figure, title)
    if outputs.recording is not None:
        from cfb_mjx.view.flight_recording import write_flight_recording

        thrust = np.asarray(rotors.thrust(parameters, flown.rotor_speed[:1]))
        write_flight_recording(outputs.recording, flown, dt, thrust)
    if outputs.video is not None:
        from cfb_mjx.view.film import Path3D, write_film

        position = np.asarray(flown.position[0], float)
        # A drone that is lost is filmed until then.
        rows = slice(steps_flown(flown))
        above = np.array([0.0, 0.0, FLOOR_M if turning else HEIGHT_M])
        thrust = np.asarray(rotors.thrust(parameters, flown.rotor_speed[0]))
        time = dt * (1 + np.arange(len(position)))
        flight = Path3D(time[rows], position[rows] + above, np.asarray(flown.quaternion[0])[rows], thrust[rows])
        write_film(outputs.video, flight)
    if outputs.log is not None:
        from cfb_mjx.logs import write_mcap
        from cfb_mjx.train.flight_logs import flight_log

        log = flight_log(flown, dt, outputs.log.stem, float(parameters.gravity))
        write_mcap(log, outputs.log)
