"""Thrust in flight: the specific force along the body's z axis beside what the rotors should pull at their speeds.

With the mass known, ``m f_z = r T(Omega) + a S v_z + b |v_xy|^2``: r times the model's thrust curve, the thrust that a
climb costs (S: sum of the rotor speeds over 2900 rad/s) and the lift that flying forwards adds. Accelerometer and rotor
speeds are enough for it; neither motors nor inertia take part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.signal import butter, sosfiltfilt

from cfb_mjx.logs import FlightLog, rotation
from cfb_mjx.model import rotors
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Parameters

_CUT = 4.0  # Hz: above it vibration and the blades' unevenness outweigh what the drone does
_EDGE, _LEAST = 0.3, 2.0  # s beside the ends of a stretch that a filter spoils; shortest stretch
_SPEED = 2900.0  # rad/s
_TUNING, _ROUNDS = 1.5, 30  # of Huber's loss, in standard deviations
_BLOCK = 4.0  # s: parts of a flight that tell the deviation
_FLOOR = 1e-3  # of the ratio: rotor speeds between rows and slow errors of the accelerometer do not scatter


@dataclass(frozen=True)
class ThrustInFlight:
    """What rotors pull in flight, over a model's curve at the same speeds.

    Attributes:
        ratio: times the model's thrust. ``ratio_std``: its deviation, by leaving out parts of the flights, at least a
            thousandth.
        climb: N of a climb of 1 m/s per rotor at 2900 rad/s, negative where a climb costs thrust.
        lift: N s^2/m^2 of flying forwards.
        unexplained: rms of what is left, over the weight.
        mass: kg that were taken for granted: the ratio is proportional to it.
    """

    ratio: float
    ratio_std: float
    climb: float
    lift: float
    unexplained: float
    mass: float


def thrust_in_flight(logs: Sequence[FlightLog], parameters: Parameters) -> ThrustInFlight | None:
    """Compare specific force and rotor speeds of some flights.

    Args:
        logs: flights; those without rotor speeds, and stretches below 2 s, are passed over.
        parameters: the drone whose mass and thrust curve are compared.

    Returns:
        None where no stretch is long enough.
    """
    parts = [part for log in logs if log.rotor_speed is not None for part in _parts(log, parameters)]
    if len(parts) < 2:
        return None
    values, left = _fitted(parts)
    each = np.array([_fitted(parts[:i] + parts[i + 1 :])[0] for i in range(len(parts))])
    spread = float(np.sqrt((len(parts) - 1) / len(parts) * np.sum((each[:, 0] - each[:, 0].mean()) ** 2)))
    mass = float(parameters.mass)
    weight = mass * float(parameters.gravity)
    deviation = float(np.hypot(spread, _FLOOR * values[0]))
    return ThrustInFlight(float(values[0]), deviation, float(values[1]), float(values[2]), left / weight, mass)


def _parts(log: FlightLog, parameters: Parameters) -> list[tuple[np.ndarray, np.ndarray]]:
    """Columns (n, 3) and force (n,) N of every part of `_BLOCK` s, below `_CUT` Hz."""
    measured = not_none(log.rotor_speed)
    known = np.isfinite(measured).all(axis=1)
    if known.sum() < 2:
        return []
    speed = np.stack([np.interp(log.time, log.time[known], s[known]) for s in measured.T], axis=1)
    velocity = rotation.to_body(rotation.tidy(log.quaternion), log.velocity)
    thrust = np.asarray(rotors.thrust(parameters, jnp.asarray(speed))).sum(axis=1)
    signals = np.stack(
        [
            thrust,
            speed.sum(axis=1) / _SPEED * velocity[:, 2],
            np.sum(velocity[:, :2] ** 2, axis=1),
            float(parameters.mass) * log.specific_force[:, 2],
        ],
        axis=1,
    )
    rate = 1 / log.nominal_interval
    if rate < 4 * _CUT:
        return []
    low_pass = butter(2, _CUT, fs=rate, output="sos")
    found = []
    for stretch in log.segments():
        time = log.time[stretch]
        # Rows of a stretch may lie unevenly: a filter wants them even.
        even = np.arange(time[0], time[-1], 1 / rate)
        if len(even) < _LEAST * rate:
            continue
        here = np.stack([np.interp(even, time, s) for s in signals[stretch].T], axis=1)
        smooth = sosfiltfilt(low_pass, here, axis=0)[round(_EDGE * rate) : -round(_EDGE * rate)]
        smooth = smooth[:: max(1, round(rate / (4 * _CUT)))]
        count = max(1, round(len(smooth) / (4 * _CUT) / _BLOCK))
        found += [(part[:, :3], part[:, 3]) for part in np.array_split(smooth, count)]
    return found


def _fitted(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, float]:
    """Huber's fit, and the rms of what it leaves."""
    columns, force = (np.concatenate(x) for x in zip(*parts, strict=True))
    weight = np.ones(len(force))
    values, left = np.zeros(3), force
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        new = np.linalg.lstsq(columns * root[:, None], force * root, rcond=None)[0]
        left = force - columns @ new
        deviation = 1.4826 * float(np.median(np.abs(left))) + 1e-12
        weight = np.minimum(1.0, _TUNING * deviation / np.maximum(np.abs(left), 1e-12))
        if np.allclose(new, values, rtol=1e-8, atol=1e-12):
            break
        values = new
    return values, float(np.sqrt(np.mean(left**2)))
