"""Simulate fitted motors with the recorded commands, for comparison with the measured rotor speeds."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.sysid.rotors.motor_likelihood import undisturbed
from cfb_mjx.sysid.rotors.motor_tracks import gather
from cfb_mjx.sysid.rotors.motors import MotorFit


@dataclass(frozen=True)
class Replay:
    """Simulation of one motor over the piece of its recordings in which the command varies most.

    Attributes:
        motor: number 1 to 4; 0 if not known.
        time: (n,) s from the start of the piece.
        command: (n,) in [0, 1].
        measured: (n,) rotor speed, rad/s; NaN where missing.
        simulated: (n,) rotor speed from the commands alone, rad/s.
        rms: of measured minus simulated speed over all recordings of the motor, rad/s.
    """

    motor: int
    time: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray
    rms: float


def replay(fit: MotorFit) -> list[Replay]:
    """Simulate every motor from its commands, with its own constants if it was fitted separately."""
    found = []
    for number in sorted({n for record in fit.records for n in record.motors}):
        data = gather(fit.records, number)
        if data is None:
            continue
        tracks = data.tracks
        vector = fit.motors.get(number, fit.common).optimum.vector
        simulated = np.asarray(undisturbed(jnp.asarray(vector), jax.tree.map(jnp.asarray, tracks)).rotor_speed)
        judged = tracks.judged > 0
        error = (tracks.rotor_speed - simulated)[judged]
        # Do not show a piece that is much shorter than the others, even if the command varies a lot in it.
        enough = judged.sum(axis=1) >= 0.5 * judged.sum(axis=1).max()
        moves = [float(np.std(c[j])) if ok else -1.0 for c, j, ok in zip(tracks.command, judged, enough, strict=True)]
        shown = int(np.argmax(moves))
        rows = slice(0, int(np.flatnonzero(judged[shown])[-1]) + 1)
        measured = np.where(tracks.measured[shown] > 0, tracks.rotor_speed[shown], np.nan)
        columns = (tracks.time[shown], tracks.command[shown], measured, simulated[shown])
        time, command, measured, alone = (np.asarray(column)[rows] for column in columns)
        found.append(Replay(number, time, command, measured, alone, float(np.sqrt(np.mean(error**2)))))
    return found
