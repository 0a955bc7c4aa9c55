"""Changes of a log's conventions (unit, axes, frame, order) that a user can request: ``--fix velocity-frame=body``."""

from __future__ import annotations

import dataclasses
import difflib
import itertools
import math
from collections.abc import Callable, Iterable

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import rotation
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.optional import not_none

_G = 9.81
_VECTORS = {
    "position": ("position", "the position px py pz"),
    "velocity": ("velocity", "the velocity vx vy vz"),
    "gyro": ("body_rate", "the gyro wx wy wz"),
    "accelerometer": ("specific_force", "the specific force ax ay az"),
}
_UNITS = {
    "position": {"mm": 1e-3, "cm": 1e-2, "ft": 0.3048, "in": 0.0254, "km": 1e3},
    "velocity": {"mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6, "ft/s": 0.3048, "mph": 0.44704, "knots": 0.514444},
    "gyro": {
        "deg/s": math.pi / 180,
        "mrad/s": 1e-3,
        "rpm": math.pi / 30,
        "rev/s": 2 * math.pi,
        "centideg/s": math.pi / 18000,
    },
    "accelerometer": {"g": _G, "mg": _G / 1e3, "mm/s^2": 1e-3, "cm/s^2": 1e-2, "ft/s^2": 0.3048},
}
_UNIT_WORDS = {
    "mm": "millimetres",
    "cm": "centimetres",
    "ft": "feet",
    "in": "inches",
    "deg/s": "degrees per second",
    "mrad/s": "milliradians per second",
}
# Undo a conversion that was applied to numbers that were already in the target unit.
_UNDONE = {"gyro": {"rad/s": 180 / math.pi}, "accelerometer": {"m/s^2": 1 / _G}}
TIMES = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_SCALES = (0.1, 0.5, 2.0, 10.0, 0.01, 100.0)
_QUATERNIONS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "xyzw": (
        "reading the quaternion as scalar-last [x, y, z, w]; reorder the columns to [w, x, y, z]",
        lambda q: q[:, [3, 0, 1, 2]],
    ),
    "wxyz": (
        "reading the quaternion as scalar-first [w, x, y, z], which was read as scalar-last",
        lambda q: q[:, [1, 2, 3, 0]],
    ),
    "inverse": (
        "inverting the quaternion, which is world to body; negate qx qy qz to get body to world",
        rotation.conjugate,
    ),
    "xyzw-inverse": (
        "reading the quaternion as scalar-last and world to body; reorder the columns to [w, x, y, z] and "
        "negate qx qy qz",
        lambda q: rotation.conjugate(q[:, [3, 0, 1, 2]]),
    ),
    "ned": (
        "reading the quaternion in axes with z down (north, east, down; forward, right, down); negate qy qz",
        lambda q: q * [1.0, 1.0, -1.0, -1.0],
    ),
    "z-down-world": (
        "reading the quaternion as from body axes with z up to a world with z down; rotate it by 180 degrees about x",
        lambda q: rotation.multiply(np.broadcast_to([0.0, 1.0, 0.0, 0.0], q.shape), q),
    ),
    "z-down-body": (
        "reading the quaternion as from body axes with z down to a world with z up; rotate it by 180 degrees about x",
        lambda q: rotation.multiply(q, np.broadcast_to([0.0, 1.0, 0.0, 0.0], q.shape)),
    ),
    "pitch-inverted": ("reading the pitch with the opposite sign; negate it", lambda q: _repitched(q)),
    "left-handed": (
        "reading the quaternion in left-handed axes (y to the right); negate qx qz",
        lambda q: q * [1, -1, 1, -1],
    ),
    "zxyw": ("reading the quaternion as [z, x, y, w]", lambda q: q[:, [3, 1, 2, 0]]),
}
COMMAND_UNITS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "percent": ("look like percent; divide the commands by 100", lambda u: u / 100.0),
    "pwm16": ("look like raw PWM in 0..65535; divide the commands by 65535", lambda u: u / 65535.0),
    "dshot": (
        # 0 to 47 are special commands to the ESC, not throttle; the motor stands still.
        "look like DSHOT values of 48 to 2047; subtract 47 and divide the commands by 2000",
        lambda u: np.clip((u - 47.0) / 2000.0, 0.0, None),
    ),
    "us": (
        "look like servo pulses of 1000 to 2000 us; subtract 1000 and divide the commands by 1000",
        lambda u: (u - 1000.0) / 1000.0,
    ),
    "0-255": ("look like 8-bit values in 0..255; divide the commands by 255", lambda u: u / 255.0),
    "0-1000": ("look like per mille; divide the commands by 1000", lambda u: u / 1000.0),
    "1023": ("look like 10-bit values in 0..1023; divide the commands by 1023", lambda u: u / 1023.0),
}
"""Units of commands other than duty: the words of a message, with the remedy, and the conversion to duty."""


@dataclasses.dataclass(frozen=True)
class Fix:
    """A change of convention.

    Attributes:
        name: argument of ``--fix``.
        words: what it does, as a phrase for messages ("reading the velocity in body axes").
        apply: function that returns the changed log.
    """

    name: str
    words: str
    apply: Callable[[FlightLog], FlightLog]


def fix_of(name: str) -> Fix:
    """The change with a name of the form ``NAME=VALUE``.

    Raises:
        CfbError: there is no change with this name. The message lists similar names.
    """
    key, _, value = name.partition("=")
    part, _, kind = key.partition("-")
    made = None
    if kind == "axes" and part in _VECTORS:
        made = _axes(part, value)
    elif key == "motors":
        made = _inverted() if value == "inverted" else _order(value)
    elif key in _PARTS:
        made = _order(value, key)
    elif key == "time-scale":
        made = _time(value)
    else:
        made = next((f for f in _named() if f.name == name), None)
    if made is None:
        near = difflib.get_close_matches(name, [f.name for f in _named()], n=4, cutoff=0.3)
        raise CfbError(
            f"--fix {name}: there is no such change; "
            f"{'similar names are ' + ', '.join(near) + '; ' if near else ''}others are "
            "PART-axes=x,-y,z and PART-unit=UNIT for PART position, velocity, gyro or accelerometer, motors=2,1,3,4, "
            "motors=inverted, time-scale=0.1 (docs/logs.md lists all)."
        )
    return made


def candidates() -> Iterable[Fix]:
    """All changes except those of the motors, the most likely first."""
    yield from _named()
    yield from (not_none(_time(str(scale))) for scale in _SCALES)
    for part in _VECTORS:
        for order in itertools.permutations("xyz"):
            for signs in itertools.product(("", "-"), repeat=3):
                spec = ",".join(s + a for s, a in zip(signs, order, strict=True))
                if spec != "x,y,z":
                    yield not_none(_axes(part, spec))


def motor_fixes(order: tuple[int, ...], sign: int = 1, key: str = "motors") -> tuple[Fix, ...]:
    """The changes that reorder the motor columns and, if requested, invert the commands.

    Args:
        order: the column of each of M1 to M4, counted from 0.
        sign: -1 if the commands are one minus the duty.
        key: ``motors`` for commands and rotor speeds, ``command-order`` or ``rotor-order`` for one of the two.
    """
    spec = ",".join(str(column + 1) for column in order)
    ordered = () if order == (0, 1, 2, 3) else (not_none(_order(spec, key)),)
    return ordered if sign > 0 else (*ordered, _inverted())


def command_fixes() -> list[Fix]:
    """The changes of unit for commands that are not duty."""
    return [
        Fix(f"command-unit={unit}", words, lambda log, f=f: log.replace(command=f(log.command)))
        for unit, (words, f) in COMMAND_UNITS.items()
    ]


def _named() -> list[Fix]:
    found = [
        Fix("velocity-frame=body", "reading the velocity in body axes", _velocity_from_body),
        Fix("gyro-frame=world", "reading the gyro in world axes", _rate_from_world),
        Fix("accelerometer-frame=world", "reading the specific force in world axes", _force_from_world),
        Fix(
            "accelerometer-gravity=subtracted",
            "adding gravity to the specific force, from which it was subtracted (give the accelerometer's reading, "
            "gravity included)",
            lambda log: _with_gravity(log, in_world=False),
        ),
        Fix(
            "accelerometer-gravity=subtracted-world",
            "reading the specific force as the acceleration in world axes, without gravity",
            lambda log: _with_gravity(log, in_world=True),
        ),
        Fix("frame=ned", "reading all of it in axes with z down (north, east, down; forward, right, down)", _from_ned),
        Fix("world=ned", "reading position, velocity and attitude in a world with z down", _world_from_ned),
        Fix("body=frd", "reading gyro, specific force and attitude in body axes forward, right, down", _body_from_frd),
        Fix("frame=left-handed", "reading all of it in left-handed axes (y to the right)", _from_left_handed),
        Fix("rows=reversed", "reading the rows in reverse order of time", _reversed),
    ]
    for value, (words, turn) in _QUATERNIONS.items():
        found.append(Fix(f"quaternion={value}", words, lambda log, f=turn: log.replace(quaternion=f(log.quaternion))))
    for part, units in _UNITS.items():
        field, name = _VECTORS[part]
        for unit, factor in (units | _UNDONE.get(part, {})).items():
            said = _UNIT_WORDS.get(unit, unit)
            verb = (
                f"multiply it by {_factor(unit, factor)}"
                if factor > 1 or unit == "deg/s"
                else f"divide it by {1 / factor:.4g}"
            )
            found.append(
                Fix(
                    f"{part}-unit={unit}",
                    f"reading {name} in {said}; {verb}",
                    lambda log, f=field, s=factor: log.replace(**{f: getattr(log, f) * s}),
                )
            )
    found += [
        Fix(f"time-unit={unit}", f"reading the time in {unit}", lambda log, s=scale: _rescaled(log, s))
        for unit, scale in TIMES.items()
    ]
    return found + command_fixes()


def _factor(unit: str, factor: float) -> str:
    return "pi/180" if unit == "deg/s" else f"{factor:.4g}"


def _axes(part: str, spec: str) -> Fix | None:
    field, name = _VECTORS[part]
    words = [w.strip() for w in spec.split(",")]
    letters = [w.lstrip("-+") for w in words]
    if sorted(letters) != ["x", "y", "z"] or any(len(w) - len(a) > 1 for w, a in zip(words, letters, strict=True)):
        return None
    columns = ["xyz".index(a) for a in letters]
    signs = np.array([-1.0 if w.startswith("-") else 1.0 for w in words])
    return Fix(
        f"{part}-axes={','.join(words)}",
        f"reading the columns of {name} as {', '.join(words)}",
        lambda log: log.replace(**{field: getattr(log, field)[:, columns] * signs}),
    )


_PARTS = {"command-order": ("command",), "rotor-order": ("rotor_speed",), "motors": ("command", "rotor_speed")}


def _order(value: str, key: str = "motors") -> Fix | None:
    try:
        columns = [int(v) - 1 for v in value.split(",")]
    except ValueError:
        return None
    if sorted(columns) != [0, 1, 2, 3]:
        return None

    def apply(log: FlightLog) -> FlightLog:
        there = {name: getattr(log, name) for name in _PARTS[key]}
        return log.replace(**{name: x[:, columns] for name, x in there.items() if x is not None})

    what = {"command-order": "the commands of ", "rotor-order": "the rotor speeds of "}.get(key, "")
    return Fix(f"{key}={value}", f"reading {what}motors M1 to M4 from columns {value}", apply)


def _inverted() -> Fix:
    return Fix(
        "motors=inverted",
        "reading the commands as one minus the duty",
        lambda log: log.replace(command=1.0 - log.command),
    )


def _time(value: str) -> Fix | None:
    try:
        scale = float(value)
    except ValueError:
        return None
    if not (math.isfinite(scale) and scale > 0):
        return None
    return Fix(f"time-scale={scale:g}", f"multiplying the time by {scale:g}", lambda log: _rescaled(log, scale))


def _rescaled(log: FlightLog, scale: float) -> FlightLog:
    return log.replace(time=log.time[0] + (log.time - log.time[0]) * scale)


def _reversed(log: FlightLog) -> FlightLog:
    turned = log.rows(slice(None, None, -1))
    return turned.replace(time=log.time[0] + log.time[-1] - turned.time)


def _velocity_from_body(log: FlightLog) -> FlightLog:
    return log.replace(velocity=rotation.to_world(rotation.tidy(log.quaternion), log.velocity))


def _rate_from_world(log: FlightLog) -> FlightLog:
    return log.replace(body_rate=rotation.to_body(rotation.tidy(log.quaternion), log.body_rate))


def _force_from_world(log: FlightLog) -> FlightLog:
    return log.replace(specific_force=rotation.to_body(rotation.tidy(log.quaternion), log.specific_force))


def _with_gravity(log: FlightLog, in_world: bool) -> FlightLog:
    q = rotation.tidy(log.quaternion)
    up = np.broadcast_to([0.0, 0.0, _G], log.specific_force.shape)
    if in_world:
        return log.replace(specific_force=rotation.to_body(q, log.specific_force + up))
    return log.replace(specific_force=log.specific_force + rotation.to_body(q, up))


_FLIPPED = np.array([1.0, -1.0, -1.0])


def _from_ned(log: FlightLog) -> FlightLog:
    names = ("position", "velocity", "body_rate", "specific_force")
    return log.replace(
        **{n: getattr(log, n) * _FLIPPED for n in names}, quaternion=log.quaternion * [1.0, 1.0, -1.0, -1.0]
    )


def _world_from_ned(log: FlightLog) -> FlightLog:
    turned = _QUATERNIONS["z-down-world"][1](log.quaternion)
    return log.replace(position=log.position * _FLIPPED, velocity=log.velocity * _FLIPPED, quaternion=turned)


def _body_from_frd(log: FlightLog) -> FlightLog:
    turned = _QUATERNIONS["z-down-body"][1](log.quaternion)
    return log.replace(
        body_rate=log.body_rate * _FLIPPED, specific_force=log.specific_force * _FLIPPED, quaternion=turned
    )


def _from_left_handed(log: FlightLog) -> FlightLog:
    mirror = np.array([1.0, -1.0, 1.0])
    return log.replace(
        position=log.position * mirror,
        velocity=log.velocity * mirror,
        specific_force=log.specific_force * mirror,
        # A rate is an axial vector: a reflection reverses its components within the mirror plane.
        body_rate=log.body_rate * -mirror,
        quaternion=log.quaternion * [1.0, -1.0, 1.0, -1.0],
    )


def _repitched(q: np.ndarray) -> np.ndarray:
    """Negate the pitch and keep roll and yaw (rotation R_z(yaw) R_y(pitch) R_x(roll))."""
    w, x, y, z = rotation.tidy(q).T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return rotation.from_euler(np.stack([roll, -pitch, yaw], axis=1))
