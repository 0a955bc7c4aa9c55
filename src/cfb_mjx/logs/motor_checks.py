"""Checks of motor columns: each rotor follows its own command, more thrust lifts, and the thrust fits a Crazyflie."""

from __future__ import annotations

import numpy as np

from cfb_mjx.logs import consistency
from cfb_mjx.logs.alignment import GAIN, nominal_speeds, nominal_thrust
from cfb_mjx.logs.consistency import ORDER
from cfb_mjx.logs.fixes import COMMAND_UNITS, Fix, motor_fixes
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.optional import not_none

_GAIN = (1100.0, 6500.0)  # rad/s per unit of command: range for brushed and brushless rotors
_OFF = 0.03  # command below which the motors count as off
BETTER = 0.25
"""By how much the correlation of another motor order must be larger for that order to be reported."""
_FOLLOWS, _HEAVES = 0.6, 0.2  # correlations of a rotor with its command, and of thrust with specific force
_MASSES = (0.012, 0.16)  # kg: plausible masses carried by four rotors, by the nominal thrust curve


def implausible(log: FlightLog) -> str | None:
    """The problem, if rotor speeds do not fit the commands or the thrust does not fit a Crazyflie; else None."""
    return _gain(log) or _carried(log)


def heaves_against(log: FlightLog, source: str) -> bool:
    """Whether more thrust of all motors pushes the drone down, which means that commands are one minus the duty."""
    return _heave(log, source) < -_HEAVES


def _heave(log: FlightLog, source: str) -> float:
    """Correlation of the sum over all motors with the specific force along z, both high-pass filtered."""
    thrust = not_none(log.rotor_speed) if source == "rotor_speed" else nominal_speeds(log)
    both = _swings(log, np.stack([np.nansum(thrust, axis=1), log.specific_force[:, 2]], axis=1))
    size = float(np.sqrt(np.mean(both[:, 0] ** 2) * np.mean(both[:, 1] ** 2)))
    return float(np.mean(both[:, 0] * both[:, 1])) / size if size > 0 else 0.0


def followed(log: FlightLog) -> tuple[str, tuple[Fix, ...]] | None:
    """Check that each rotor follows its own command; the problem and the remedy, or None.

    If commands and speeds are in different orders, the order that agrees with roll and pitch is taken as right.
    """
    if log.rotor_speed is None or log.duration < 1.0:
        return None
    known = np.isfinite(log.rotor_speed).all(axis=1)
    if known.mean() < 0.5:
        return None
    expected, speed = _swings(log, nominal_speeds(log))[known], _swings(log, log.rotor_speed)[known]
    size_e, size_s = (np.sqrt(np.mean(x**2, axis=0)) for x in (expected, speed))
    if (size_e < 5.0).any() or (size_s < 5.0).any():
        return None
    matrix = expected.T @ speed / len(speed) / np.outer(size_e, size_s)
    own = np.diag(matrix)
    if (own < -_FOLLOWS).all():
        return "every rotor slows down when its command rises", motor_fixes(ORDER, -1)
    order = np.argmax(matrix, axis=1)
    best = matrix[np.arange(4), order]
    if sorted(order) == [0, 1, 2, 3] and (best > _FOLLOWS).all() and np.max(best - own) > BETTER:
        follow = tuple(int(i) for i in order)  # command i drives the rotor in this column
        problem = "rotor speeds do not follow the commands of their own motors, but those of other motors"
        turns = {s: consistency.agreement(log, s).get((ORDER, 1), 0.0) for s in ("rotor_speed", "command")}
        if turns["command"] > turns["rotor_speed"]:
            return problem, motor_fixes(follow, key="rotor-order")
        return problem, motor_fixes(tuple(follow.index(i) for i in range(4)), key="command-order")
    return None


def _gain(log: FlightLog) -> str | None:
    """Check the ratio of rotor speeds to commands."""
    if log.rotor_speed is None or not np.isfinite(log.rotor_speed).any():
        return None
    speed, command = float(np.nanmedian(log.rotor_speed)), float(np.median(log.command))
    low, high = _GAIN
    if speed < 200.0 or command <= 0 or low < speed / command < high:
        return None
    force = float(np.median(log.specific_force[:, 2]))
    total = float(np.sum(np.median(log.command, axis=0)))
    text = f"rotors turn at {speed:.0f} rad/s under commands of {command:.3g}, which does not fit a Crazyflie"
    if force > 4.0 and _MASSES[0] < total / force < _MASSES[1] and speed / command > high:
        return f"{text}: the commands look like thrust in newtons; give the duty, motor.m1..m4 over 65535"
    if low < speed * 2 * np.pi / command < high:
        return f"{text}: the speeds look like turns per second; multiply omega1..omega4 by 2 pi"
    return f"{text}; give rotor speeds in rad/s and the duty in [0, 1]"


def _swings(log: FlightLog, values: np.ndarray) -> np.ndarray:
    """High-pass filter: subtract the moving average over half a second."""
    width = max(3, round(0.5 / log.nominal_interval) | 1)
    filled = np.where(np.isfinite(values), values, np.nanmean(values, axis=0))
    sums = np.cumsum(np.pad(filled, ((width // 2 + 1, width // 2), (0, 0)), mode="edge"), axis=0)
    return filled - (sums[width:] - sums[:-width]) / width


def _carried(log: FlightLog) -> str | None:
    """Check that the thrust carries the mass of a Crazyflie."""
    force = float(np.median(log.specific_force[:, 2]))
    if log.duration < 1.0 or force < 4.0 or np.median(log.command) < _OFF:
        return None
    low, high = _MASSES
    if log.rotor_speed is not None and np.isfinite(log.rotor_speed).any():
        mass = carried_mass(np.nanmedian(log.rotor_speed, axis=0), force)
        if not low < mass < high:
            hint = (
                " (they look like turns per second; multiply by 2 pi)"
                if low < carried_mass(np.nanmedian(log.rotor_speed, axis=0) * 2 * np.pi, force) < high
                else ""
            )
            return (
                f"rotors at {np.nanmedian(log.rotor_speed):.0f} rad/s carry {mass * 1e3:.3g} g, which does not fit a "
                f"Crazyflie{hint}; give omega1..omega4 in rad/s"
            )
        return None
    return carried_by_commands(log.command, force)


def carried_by_commands(command: np.ndarray, force: float) -> str | None:
    """The problem, if the thrust of commands within [0, 1] does not fit the mass of a Crazyflie; None if it does.

    Args:
        command: (n, 4) duty.
        force: specific force in flight, m/s^2.
    """
    low, high = _MASSES
    typical = np.median(command, axis=0)
    mass = carried_mass(GAIN * typical, force)
    if low < mass < high:
        return None
    if low < float(np.sum(typical)) / force < high:
        return (
            f"the commands (median {np.median(command):.3g}) look like thrust in newtons; give the duty, motor.m1..m4 "
            "over 65535"
        )
    return (
        f"commands of {np.median(command):.3g} carry {mass * 1e3:.3g} g, which does not fit a Crazyflie; give the duty "
        "in [0, 1]"
    )


def carried_mass(rotor_speed: np.ndarray, force: float) -> float:
    """Mass, kg, that four rotors at these speeds (rad/s) carry at a specific force (m/s^2), by the nominal curve."""
    return float(np.sum(nominal_thrust(rotor_speed))) / force


def command_unit(command: np.ndarray, force: float) -> str | None:
    """Likely unit of commands outside [0, 1], with the remedy, as words of a message; None if no unit fits.

    Args:
        command: (n, 4) as logged.
        force: specific force in flight, m/s^2.
    """
    low, high = _MASSES
    for unit in _by_range(command):
        words, to_duty = COMMAND_UNITS[unit]
        duty = to_duty(command)
        mass = carried_mass(GAIN * np.median(duty, axis=0), force)
        if duty.min() > -0.05 and duty.max() < 1.02 and low < mass < high:
            return f"{words} (--fix command-unit={unit})"
    total = float(np.sum(np.median(command, axis=0)))
    for unit, newton in (("grams", 9.81e-3), ("millinewtons", 1e-3)):
        if low < total * newton / force < high:
            return f"look like thrust in {unit}, which is not a duty; give the duty, motor.m1..m4 over 65535"
    return None


_TOPS = {
    "percent": 100.5,
    "0-255": 255.5,
    "0-1000": 1000.5,
    "1023": 1023.5,
    "us": 2100.0,
    "dshot": 2047.5,
    "pwm16": 65535.5,
}


def _by_range(command: np.ndarray) -> list[str]:
    """Units whose range includes all values, the narrowest range first."""
    top, bottom = float(command.max()), float(command[command > 0].min(initial=np.inf))
    order = [unit for unit, limit in sorted(_TOPS.items(), key=lambda t: t[1]) if top <= limit]
    likely = "us" if bottom >= 900.0 and top <= 2100.0 else "dshot" if 255.5 < top <= 2047.5 else ""
    return sorted(order, key=lambda unit: unit != likely)
