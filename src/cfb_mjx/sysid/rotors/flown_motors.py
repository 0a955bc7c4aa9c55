"""Motors of a drone from its flights: constants of each motor, dead time, and dependence on the battery voltage.

The thrust in flight is the specific force along the body's z axis, compared with the model's thrust curve.

With known mass, ``m f_z = r T(Omega) + a S v_z + b |v_xy|^2``: r times the model's thrust curve, the thrust lost in a
climb (S: sum of the rotor speeds over 2900 rad/s), and the lift gained in horizontal flight. Accelerometer, rotor
speeds, velocity and attitude are used; motor dynamics and inertia do not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.signal import butter, sosfiltfilt

from cfb_mjx.logs import FlightLog, rotation
from cfb_mjx.logs.bench_tables import MotorRecord, record_of
from cfb_mjx.model import rotors
from cfb_mjx.model.effects import BatterySag, CommandDelay, Effect
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Entry, Parameters
from cfb_mjx.sysid.rotors.motors import ENTRIES
from cfb_mjx.sysid.rotors.supply import SURE, fit_with_sag


@dataclass(frozen=True)
class Told:
    """An effect of the motors that was identified from rotor speeds.

    Attributes:
        effect: with its fitted values.
        std: standard deviations of the values, by field.
        t: significance; standard normal if the effect is absent.
        at_bound: names of parameters at the end of their plausible range.
        without: other effects of the motors, adjusted to compensate for the absence of this one.
        alike: names of effects with parameters strongly correlated with its own.
    """

    effect: Effect
    std: dict[str, Any]
    t: float
    at_bound: tuple[str, ...] = ()
    without: tuple[Effect, ...] = ()
    alike: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name

    @classmethod
    def of(cls, effect: Effect, number: str, std: float) -> Told:
        """An effect with one fitted parameter, ``number``, and its standard deviation."""
        value = float(getattr(effect, number))
        at = (f"{effect.name}.{number}",) if value in effect.prior[number] else ()
        return cls(effect, {number: std}, value / std, at)


@dataclass(frozen=True)
class Motors:
    """Motors identified from commands and measured rotor speeds.

    Attributes:
        entries: refitted constants, as entries of a model file.
        effects: effects of the motors.
        known: whether rotor speeds were measured.
    """

    entries: dict[str, Entry] = field(default_factory=dict)
    effects: tuple[Told, ...] = ()
    known: bool = False


def flown_motors(logs: Sequence[FlightLog], nominal: Parameters, rows: int, piece: float) -> Motors:
    """Fit the constants of each motor, their common dead time, and their dependence on the battery voltage.

    The result is empty if no flight has measured rotor speeds.

    Args:
        logs: flights; the middle part of each is used.
        nominal: parameters to start from.
        rows: approximate number of rows to fit.
        piece: minimum duration of the part used of a flight, s. It limits the number of flights, which are evenly
            spread over ``logs``.
    """
    flown = [log for log in logs if log.rotor_speed is not None]
    if not flown:
        return Motors()
    least = piece / float(np.median([log.nominal_interval for log in flown]))
    count = min(len(flown), max(1, round(rows / least)))
    records = [_middle(log, rows // count) for log in evenly_spread(flown, count)]
    fit, sag = fit_with_sag(records, nominal, offset=True)
    values = {name: fit.values(name) for name in ENTRIES}
    effects = []
    if "dead_time" in fit.common.extras and "asymmetric" not in fit.common.extras:
        # The dead time becomes an effect of its own, so the lag is that of the motors alone, not the single lag that
        # is closest to lag and dead time together.
        lag = "motor_time_constant"
        each = [fit.motors[number].optimum for number in sorted(fit.motors)]
        values[lag] = np.array([o.value(lag) for o in each]), np.array([o.std(lag) for o in each])
        late, best = "dead_time", fit.common.optimum
        most = CommandDelay.prior["delay"][1]
        delay, std = float(min(best.value(late), most)), best.std(late)
        if delay > SURE * std:
            effects.append(Told.of(CommandDelay(delay), "delay", std))
    if sag is not None:
        effect = BatterySag(level=0.0, slope=sag.slope, lag=sag.lag)
        effects.append(Told.of(effect, "slope", sag.std))
    source = f"fitted to the rotor speeds of {len(records)} flights"
    entries = {name: Entry(v[0], source, v[1]) for name, v in values.items() if v is not None}
    return Motors(entries, tuple(effects), True)


def evenly_spread(logs: Sequence[FlightLog], count: int) -> list[FlightLog]:
    """Pick ``count`` of the flights, evenly spread from the first to the last."""
    return [logs[i] for i in np.linspace(0, len(logs) - 1, count).round().astype(int)]


def _middle(log: FlightLog, rows: int) -> MotorRecord:
    """Record of the motors in the middle of a flight, with interpolated battery voltage."""
    skipped = max(0, (len(log) - rows) // 2)
    part = log.rows(np.arange(skipped, len(log) - skipped))
    voltage = part.battery_voltage
    if voltage is not None and (known := np.isfinite(voltage)).any():
        voltage = np.interp(part.time, part.time[known], voltage[known])
    return replace(not_none(record_of(part)), battery_voltage=voltage)


_CUT = 4.0  # Hz; at higher frequencies vibration and blade imbalance dominate
_EDGE, _LEAST = 0.3, 2.0  # s; ends of a stretch where the filter is not valid; shortest stretch
_SPEED = 2900.0  # rad/s
_TUNING, _ROUNDS = 1.5, 30  # threshold of the Huber loss, in standard deviations; maximum number of iterations
_BLOCK = 4.0  # s; length of the jackknife blocks
_FLOOR = 1e-3  # least relative standard deviation of the ratio, for slow errors that the scatter does not show


@dataclass(frozen=True)
class ThrustInFlight:
    """Thrust of the rotors in flight relative to a model's curve at the same rotor speeds.

    Attributes:
        ratio: measured thrust over the model's thrust.
        ratio_std: its standard deviation, by the jackknife over parts of the flights; at least a thousandth of it.
        climb: change of thrust per rotor at 2900 rad/s in a climb of 1 m/s, N; negative if a climb costs thrust.
        lift: lift in horizontal flight, N s^2/m^2.
        unexplained: rms of the residual force over the weight.
        mass: assumed mass, kg; the ratio is proportional to it.
    """

    ratio: float
    ratio_std: float
    climb: float
    lift: float
    unexplained: float
    mass: float


def thrust_in_flight(logs: Sequence[FlightLog], parameters: Parameters) -> ThrustInFlight | None:
    """Compare the specific force in flight with the thrust curve at the measured rotor speeds.

    Args:
        logs: flights; flights without rotor speeds and gap-free stretches shorter than 2 s are ignored.
        parameters: the drone, which supplies mass and thrust curve.

    Returns:
        The comparison; None if no stretch is long enough.
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
    """Regressors (n, 3) and force (n,), N, of every part of about `_BLOCK` seconds, low-passed at `_CUT`."""
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
        # The filter needs evenly spaced rows.
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
    """Coefficients (3,) of a least-squares fit with Huber loss, and the rms of its residual."""
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
