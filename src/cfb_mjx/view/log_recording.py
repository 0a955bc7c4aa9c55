"""Film and rerun recording of flight logs, with thrust, predictions and residuals of a model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor, rotors
from cfb_mjx.sysid.evaluation import Evaluation, LogEvaluation
from cfb_mjx.sysid.tracing.residuals import Residuals
from cfb_mjx.view.closing import record_flight, record_predictions, record_residuals, tab
from cfb_mjx.view.film import Path3D, write_film
from cfb_mjx.view.recorder import AXES, Plot, Recorder, part, recording
from cfb_mjx.view.style import COLOURS

RATE = 100.0
"""Largest number of rows per second in a recording."""
_MOTORS = ("M1", "M2", "M3", "M4")


def write_log_recording(
    path: str | Path,
    model: Quadrotor,
    evaluation: Evaluation,
    residuals: Sequence[tuple[Residuals, np.ndarray]],
) -> None:
    """Write a recording of flights with a model's predictions and residuals.

    For each flight, under its name: in 3D the measured path and the drone with the thrust of each rotor, and
    predictions of half a second from every window; commands, rotor speeds, body rates and voltage under ``signal``;
    residuals under ``residual``.

    Args:
        path: file to write, ``.rrd``.
        model: the model.
        evaluation: evaluation of the model on the flights.
        residuals: residuals of each flight, with the rotor speeds (rows, 4) [rad/s] that drove the model.

    Raises:
        CfbError: rerun is not installed, or the file cannot be written.
    """
    roots = [part(one.log.name) for one in evaluation.logs]
    tabs = [
        tab(one.log, root, (Plot("command", (f"{root}/signal/command/**",)),))
        for one, root in zip(evaluation.logs, roots, strict=True)
    ]
    with recording("cfb_view", tabs, path) as recorder:
        for one, root, (missed, driven) in zip(evaluation.logs, roots, residuals, strict=True):
            thrust = _thrust(model, driven)
            record_flight(recorder, root, one, RATE, thrust)
            record_predictions(recorder, f"{root}/world/prediction", one, COLOURS["commands_in"])
            record_residuals(recorder, root, {"missed": (missed, None)}, RATE)
            _signals(recorder, root, one, driven)


def write_log_film(path: str | Path, model: Quadrotor, log: FlightLog, driven: np.ndarray, slow: float = 1.0) -> None:
    """Film a flight.

    Args:
        path: file to write, ``.mp4`` or ``.gif``.
        model: model of the rotors, for the thrust arrows.
        log: the flight.
        driven: rotor speeds (rows, 4) [rad/s] that drove the model.
        slow: slow-motion factor; 2 plays at half speed.

    Raises:
        CfbError: a program or library for films is missing, or the file cannot be written.
    """
    # A log's z may be negative; raise the flight so that all of it is above the floor.
    lift = np.array([0.0, 0.0, max(0.0, 0.1 - float(log.position[:, 2].min()))])
    flight = Path3D(log.time, log.position + lift, log.quaternion, _thrust(model, driven))
    write_film(path, flight, speed=1 / slow)


def _thrust(model: Quadrotor, driven: np.ndarray) -> np.ndarray:
    return np.asarray(rotors.thrust(model.changed_parameters(), jnp.asarray(driven)))


def _signals(recorder: Recorder, root: str, evaluated: LogEvaluation, driven: np.ndarray) -> None:
    """Record commands, rotor speeds, body rates and battery voltage."""
    log: FlightLog = evaluated.log
    step = max(1, round(1 / (RATE * max(log.nominal_interval, 1e-4))))
    rows = slice(None, None, step)
    for i, motor in enumerate(_MOTORS):
        recorder.series(f"{root}/signal/command/{motor}", log.time[rows], log.command[rows, i], motor)
        recorder.series(f"{root}/signal/rotor_speed/{motor}", log.time[rows], driven[rows, i], f"{motor}, rad/s")
    for i, axis in enumerate("xyz"):
        degrees = np.degrees(log.body_rate[rows, i])
        recorder.series(f"{root}/signal/body_rate/{axis}", log.time[rows], degrees, f"{axis}, deg/s", AXES[axis])
    if log.battery_voltage is not None:
        recorder.series(f"{root}/signal/battery", log.time[rows], log.battery_voltage[rows], "battery, V")
