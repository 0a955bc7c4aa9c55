"""Ways in which a log's signals come to contradict each other, the advice that is right, and what must move."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cfb_mjx.logs import FlightLog, rotation

THRUST = (-0.23, 0.562, -0.043, 0.0)  # N of a rotor at a share of 2900 rad/s
X, Y, Z = "xyz"


@dataclass(frozen=True)
class Contradiction:
    """A fault of a log.

    Attributes:
        change: what is done to a good log.
        advice: fragments of which one must be in the message: the right remedy.
        moves: relations of the good log (name, axis) of which one must move, for the fault to show; ``motors`` where
            the motors must tell.
        differs: field that must become another one; empty where that is certain.
    """

    change: Callable[[FlightLog], FlightLog]
    advice: tuple[str, ...]
    moves: tuple[tuple[str, str], ...] = ()
    differs: str = ""


def vector(field, function):
    return lambda log: log.replace(**{field: function(getattr(log, field))})


def axes(field, order=(0, 1, 2), signs=(1, 1, 1)):
    return vector(field, lambda v: v[:, list(order)] * signs)


def body(log):
    return log.replace(velocity=rotation.to_body(rotation.tidy(log.quaternion), log.velocity))


def without_gravity(log):
    up = np.broadcast_to([0.0, 0.0, 9.81], log.specific_force.shape)
    return log.replace(specific_force=log.specific_force - rotation.to_body(rotation.tidy(log.quaternion), up))


def in_world(log):
    return log.replace(specific_force=rotation.to_world(rotation.tidy(log.quaternion), log.specific_force))


def rate_in_world(log):
    return log.replace(body_rate=rotation.to_world(rotation.tidy(log.quaternion), log.body_rate))


def all_ned(log):
    flip = np.array([1.0, -1.0, -1.0])
    names = ("position", "velocity", "body_rate", "specific_force")
    return log.replace(**{n: getattr(log, n) * flip for n in names}, quaternion=log.quaternion * [1, 1, -1, -1])


def mirrored(log):
    mirror = np.array([1.0, -1.0, 1.0])
    return log.replace(
        position=log.position * mirror,
        velocity=log.velocity * mirror,
        specific_force=log.specific_force * mirror,
        body_rate=log.body_rate * -mirror,
        quaternion=log.quaternion * [1.0, -1.0, 1.0, -1.0],
    )


def motors(order):
    def change(log):
        speed = None if log.rotor_speed is None else log.rotor_speed[:, order]
        return log.replace(command=log.command[:, order], rotor_speed=speed)

    return change


def reverse(log):
    return log.rows(slice(None, None, -1)).replace(time=log.time)


def shuffle(log):
    return log.rows(np.random.default_rng(0).permutation(len(log))).replace(time=log.time)


def repeat(log):
    n, step = len(log), log.nominal_interval
    rows = np.r_[0 : n // 2, n // 4 : n]
    time = np.concatenate([log.time[: n // 2], log.time[n // 4 :] + log.time[n // 2 - 1] + step - log.time[n // 4]])
    return log.rows(rows).replace(time=time)


def rotors(factor):
    return lambda log: log.replace(rotor_speed=None if log.rotor_speed is None else log.rotor_speed * factor)


MOVING = tuple((name, axis) for name in ("displacement", "velocity") for axis in (X, Y))
TURNING = (("attitude", X), ("attitude", Y))
SHOVED = (("velocity", X), ("velocity", Y))
CONTRADICTIONS: dict[str, Contradiction] = {
    "velocity negated": Contradiction(
        axes("velocity", signs=(-1, -1, -1)),
        ("velocity-axes=-x,-y", "velocity-axes=x,-y", "velocity-axes=-x,y"),
        MOVING,
    ),
    "velocity y negated": Contradiction(
        axes("velocity", signs=(1, -1, 1)), ("velocity-axes=x,-y,z",), (("displacement", Y), ("velocity", Y))
    ),
    "velocity x and y swapped": Contradiction(
        axes("velocity", (1, 0, 2)), ("velocity-axes=y,x,z",), MOVING, "velocity"
    ),
    "velocity with z down": Contradiction(
        axes("velocity", signs=(1, 1, -1)), ("velocity-axes=x,y,-z",), (("displacement", Z), ("velocity", Z))
    ),
    "velocity in body axes": Contradiction(body, ("velocity-frame=body",), MOVING, "velocity"),
    "velocity in km/h": Contradiction(vector("velocity", lambda v: 3.6 * v), ("velocity-unit=km/h",), MOVING),
    "velocity in cm/s": Contradiction(vector("velocity", lambda v: 100 * v), ("velocity-unit=cm/s",), MOVING),
    "velocity in feet/s": Contradiction(vector("velocity", lambda v: v / 0.3048), ("velocity-unit=ft/s",), MOVING),
    "position y negated": Contradiction(
        axes("position", signs=(1, -1, 1)), ("position-axes=x,-y,z",), (("displacement", Y),)
    ),
    "position x and y swapped": Contradiction(
        axes("position", (1, 0, 2)), ("position-axes=y,x,z",), (("displacement", X), ("displacement", Y)), "position"
    ),
    "position with z down": Contradiction(
        axes("position", signs=(1, 1, -1)), ("position-axes=x,y,-z",), (("displacement", Z),)
    ),
    "position in mm": Contradiction(vector("position", lambda v: 1e3 * v), ("position-unit=mm",), MOVING),
    "position in cm": Contradiction(vector("position", lambda v: 1e2 * v), ("position-unit=cm",), MOVING),
    "position in feet": Contradiction(vector("position", lambda v: v / 0.3048), ("position-unit=ft",), MOVING),
    "quaternion scalar last": Contradiction(
        vector("quaternion", lambda q: q[:, [1, 2, 3, 0]]), ("quaternion=xyzw",), TURNING
    ),
    "quaternion scalar first taken for last": Contradiction(
        vector("quaternion", lambda q: q[:, [3, 0, 1, 2]]), ("quaternion=wxyz",), TURNING
    ),
    "quaternion world to body": Contradiction(
        vector("quaternion", rotation.conjugate), ("quaternion=inverse",), TURNING
    ),
    "quaternion scalar last, world to body": Contradiction(
        vector("quaternion", lambda q: rotation.conjugate(q)[:, [1, 2, 3, 0]]), ("quaternion=xyzw-inverse",), TURNING
    ),
    "quaternion with z down": Contradiction(
        vector("quaternion", lambda q: q * [1, 1, -1, -1]), ("quaternion=ned",), (("attitude", Y),)
    ),
    "gyro in deg/s": Contradiction(vector("body_rate", np.rad2deg), ("gyro-unit=deg/s",), TURNING),
    "gyro divided by 57 twice": Contradiction(vector("body_rate", np.deg2rad), ("gyro-unit=rad/s",), TURNING),
    "gyro y negated": Contradiction(axes("body_rate", signs=(1, -1, 1)), ("gyro-axes=x,-y,z",), (("attitude", Y),)),
    "gyro x and y swapped": Contradiction(axes("body_rate", (1, 0, 2)), ("gyro-axes=y,x,z",), TURNING, "body_rate"),
    "gyro z negated": Contradiction(axes("body_rate", signs=(1, 1, -1)), ("gyro-axes=x,y,-z",), (("attitude", Z),)),
    "accelerometer in g": Contradiction(vector("specific_force", lambda f: f / 9.81), ("accelerometer-unit=g",)),
    "accelerometer negated": Contradiction(
        vector("specific_force", lambda f: -f), ("accelerometer-axes=-x,-y,-z", "accelerometer-axes=x,y,-z")
    ),
    "accelerometer z negated": Contradiction(
        axes("specific_force", signs=(1, 1, -1)), ("accelerometer-axes=x,y,-z", "accelerometer-axes=-x,-y,-z")
    ),
    "accelerometer y negated": Contradiction(
        axes("specific_force", signs=(1, -1, 1)), ("accelerometer-axes=x,-y,z",), (("drag", Y),)
    ),
    "accelerometer x and y swapped": Contradiction(
        axes("specific_force", (1, 0, 2)), ("accelerometer-axes=y,x,z",), (("drag", X), ("drag", Y)), "specific_force"
    ),
    "gravity subtracted": Contradiction(without_gravity, ("accelerometer-gravity=subtracted",)),
    "accelerometer in world axes": Contradiction(in_world, ("accelerometer-frame=world",), SHOVED),
    "gyro in world axes": Contradiction(rate_in_world, ("gyro-frame=world",), TURNING, "body_rate"),
    "all with z down": Contradiction(all_ned, ("frame=ned",)),
    "position left-handed": Contradiction(
        axes("position", signs=(-1, 1, 1)), ("position-axes=-x,y,z",), (("displacement", X),)
    ),
    "time times 10": Contradiction(vector("time", lambda t: 10 * t), ("time-scale=0.1",), MOVING),
    "time times 2": Contradiction(vector("time", lambda t: 2 * t), ("time-scale=0.5",), MOVING),
    "time times 0.1": Contradiction(
        vector("time", lambda t: 0.1 * t), ("time-scale=10", "faster than any log"), MOVING
    ),
    "time in minutes": Contradiction(vector("time", lambda t: t / 60), ("time-unit=min",)),
    "time in ms": Contradiction(vector("time", lambda t: 1e3 * t), ("time-unit=ms",)),
    "rows in reverse": Contradiction(reverse, ("rows=reversed",), MOVING),
    "rows shuffled": Contradiction(shuffle, ("order of time",), MOVING),
    "a part pasted twice": Contradiction(repeat, ("delete the copy",)),
    "motors 2 1 4 3": Contradiction(motors([1, 0, 3, 2]), ("motors=2,1,4,3",), (("motors", ""),)),
    "motors 4 1 2 3": Contradiction(motors([3, 0, 1, 2]), ("motors=2,3,4,1",), (("motors", ""),)),
    "motors M1 and M3 swapped": Contradiction(motors([2, 1, 0, 3]), ("motors=3,2,1,4",), (("motors", ""),)),
    "commands 1 - u": Contradiction(vector("command", lambda u: 1 - u), ("motors=inverted",), (("motors", ""),)),
    "commands in percent": Contradiction(vector("command", lambda u: 100 * u), ("command-unit=percent",)),
    "commands in 16 bits": Contradiction(vector("command", lambda u: 65535 * u), ("command-unit=pwm16",)),
    "commands in DSHOT": Contradiction(vector("command", lambda u: np.round(47 + 2000 * u)), ("command-unit=dshot",)),
    "commands in us": Contradiction(vector("command", lambda u: np.round(1000 + 1000 * u)), ("command-unit=us",)),
    "commands in 8 bits": Contradiction(vector("command", lambda u: np.round(255 * u)), ("command-unit=0-255",)),
    "commands as thrust in N": Contradiction(
        vector("command", lambda u: np.clip(np.polyval(THRUST, u), 0, None)), ("thrust in newtons",)
    ),
    "commands as thrust in g": Contradiction(
        vector("command", lambda u: np.clip(np.polyval(THRUST, u), 0, None) / 9.81e-3), ("thrust in grams",)
    ),
    "rotor speed in rpm": Contradiction(rotors(30 / np.pi), ("rpm",), (("rotors", ""),)),
    "rotor speed in Hz": Contradiction(rotors(0.5 / np.pi), ("turns per second",), (("rotors", ""),)),
    "battery in mV": Contradiction(
        lambda log: log.replace(battery_voltage=None if log.battery_voltage is None else 1e3 * log.battery_voltage),
        ("millivolts",),
        (("battery", ""),),
    ),
}


def shows(log: FlightLog, contradiction: Contradiction) -> bool:
    """Whether the good log moves enough for the fault to be seen."""
    from cfb_mjx.logs.gate import judge

    verdict = judge(log)
    moving = {(r.name, r.axis) for r in verdict.relations if r.moves}
    if max(verdict.agreement.values(), default=0.0) > 0.6:
        moving.add(("motors", ""))
    if log.rotor_speed is not None:
        moving.add(("rotors", ""))
    if log.battery_voltage is not None:
        moving.add(("battery", ""))
    whole = [pair for pair in contradiction.moves if pair[0] in ("motors", "rotors", "battery")]
    parts = [pair for pair in contradiction.moves if pair not in whole]
    if not all(pair in moving for pair in whole) or (parts and not any(pair in moving for pair in parts)):
        return False
    return not contradiction.differs or _differs(log, contradiction)


def _differs(log: FlightLog, contradiction: Contradiction) -> bool:
    """Whether the changed signal is another one at all: x and y swapped is nothing in a flight along the diagonal."""
    changed, field = contradiction.change(log), contradiction.differs
    before, after = (getattr(x, field) - np.median(getattr(x, field), axis=0) for x in (log, changed))
    return bool(np.sqrt(np.mean((after - before) ** 2)) > 0.5 * np.sqrt(np.mean(before**2)))
