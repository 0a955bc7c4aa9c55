"""What the report of a closed loop says in words: verdicts, numbers with units, and flights that would tell more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cfb_mjx.model.effects import CATALOGUE, SENSOR_FAULTS
from cfb_mjx.sysid.tracing.outcome import Outcome, Reported

MEANING = {
    "thrust_scale": "all rotors lift more or less than the declared thrust curve says",
    "torque_scale": "the rotors' reaction torque differs from the declared torque curve",
    "inertia": "the moments of inertia differ from the declared ones",
    "cog_offset": "the centre of gravity does not lie in the middle of the rotors",
    "payload": "the drone carries mass that was not declared",
    "motor_gain_mismatch": "single motors turn faster or slower than their command says",
    "motor_time_constant": "the motors answer slower or faster than declared",
    "motor_asymmetry": "the motors spin up and down at different speed",
    "motor_second_order": "the motors answer with a second lag",
    "motor_thermal_drift": "the motors slow down as they warm up",
    "battery_sag": "rotor speed follows the battery's voltage",
    "command_delay": "commands reach the motors late",
    "esc_rate_limit": "the motor controllers limit how fast a command, or the rotor, may change",
    "inflow_thrust": "thrust falls in climb and grows in descent",
    "ground_effect": "thrust grows near the ground",
    "gyroscopic": "the spinning rotors resist being turned",
    "thrust_tilt": "the thrust does not point along the body's z axis",
    "rotor_drag": "the rotors drag against sideways motion, in proportion to speed",
    "parasitic_drag": "the body drags against motion, with the square of speed",
    "blade_flapping": "sideways motion tilts the rotor discs and turns the body",
    "wind": "the air moves",
    "gust": "the air wanders about its mean",
    "jet": "a fan blows",
    "position_moment": "a torque hangs on the position, as in air that moves towards the middle of a room",
    "payload_swing": "a load swings below the drone",
    "sensor_delay": "pose and velocity are older than the log declares",
    "sensor_velocity_scale": "logged velocity is not in scale with logged position",
    "sensor_gyro_lowpass": "the gyro is filtered and lags",
    "sensor_time_shift": "command and rotor-speed columns are late or early against all others",
}
MOTORS = "cfb excite single-motor: steps of one motor at a time, rotor speed logged"
TURNS = "cfb excite roll-pitch: doublets about roll and pitch, and yaw turns both ways"
PASSES = "straight passes at constant speed, 0.5 to 3 m/s, forth and back and in both body axes"
HOVERS = "long hovers with the heading turned by 90 degrees in between"
EXPERIMENTS = {
    "thrust_scale": "weigh the drone, then hover: mass and thrust cannot be told apart in flight",
    "torque_scale": "yaw turns and stops at constant height (cfb excite single-motor)",
    "inertia": TURNS,
    "cog_offset": HOVERS,
    "payload": "weigh the drone, then hover and cfb excite roll-pitch",
    "motor_gain_mismatch": MOTORS,
    "motor_time_constant": MOTORS,
    "motor_asymmetry": "large command steps up and down, rotor speed logged (cfb excite single-motor)",
    "motor_second_order": MOTORS,
    "motor_thermal_drift": "hover for a minute from cold, twice: on a full and on a half-empty battery",
    "battery_sag": "hover from a full battery to an empty one with the voltage logged",
    "command_delay": "sharp command steps, rotor speed and every command logged (cfb excite single-motor)",
    "esc_rate_limit": "command steps of several sizes, rotor speed logged: a limit shows in the large ones only",
    "inflow_thrust": "climbs and dives at 0.5 to 2 m/s",
    "ground_effect": "hover for five seconds each at 0.1, 0.15, 0.25, 0.5 and 1 m",
    "gyroscopic": "fast roll and pitch while climbing hard: rates at high rotor speed",
    "thrust_tilt": HOVERS,
    "rotor_drag": PASSES,
    "parasitic_drag": PASSES + ", the fastest as fast as there is room for",
    "blade_flapping": PASSES + ", repeated while climbing",
    "wind": "hover with the heading turned through 360 degrees: wind stays in the world, trim turns with the body",
    "gust": "minutes of hover, outdoors or before a fan, and the same indoors",
    "jet": "slow passes across the jet at several distances from the fan",
    "position_moment": "slow passes through the whole room, and the same passes in a larger one",
    "payload_swing": "a sharp stop followed by a hover of five seconds: a load swings on",
    "sensor_delay": "fast turns in yaw and hard stops: delay shows where signals change quickly",
    "sensor_velocity_scale": "long straight passes",
    "sensor_gyro_lowpass": "cfb excite roll-pitch: fast rates show a filter",
    "sensor_time_shift": "sharp command steps with rotor speed logged",
}
FOLLOWS = {
    "velocity": PASSES,
    "rate": TURNS,
    "rotor mean": "climbs, dives and hovers at several thrusts, rotor speed logged",
    "rotor": MOTORS,
    "command": MOTORS,
    "position": "the same manoeuvre at another place, away from walls, cables and other drones",
    "height": "hover at several heights, and the same heights over another floor",
    "heading": HOVERS,
    "voltage": "hover from a full battery to an empty one",
    "time": "hover for a minute from cold, twice",
    "offset": HOVERS,
}
_COMPONENTS = {2: ("x", "y"), 3: ("x", "y", "z"), 4: ("M1", "M2", "M3", "M4")}


def separating(names: list[str], model: str) -> str | None:
    """The command that finds the flight to tell some effects apart; None where flying does not."""
    if not set(names) <= set(CATALOGUE):
        return None
    return f"cfb excite separate --between {','.join(names)} --model {model} -o next"


def is_fault(name: str) -> bool:
    """Whether a name is one of the recording's faults and not physics."""
    return name in SENSOR_FAULTS


def unit_of(name: str, field: str) -> str:
    """Unit of a parameter of an effect or fault; empty for plain ratios."""
    unit = SENSOR_FAULTS[name].unit if is_fault(name) else CATALOGUE[name].units.get(field, "1")
    return "" if unit == "1" else unit.replace("^2", "²")


@dataclass(frozen=True)
class Number:
    """One number of an effect as printed, in a unit that needs no exponent."""

    label: str
    value: float
    std: float
    unit: str
    plausible: tuple[float, float] | None
    """Range the catalogue calls plausible; None for faults of the recording."""

    def __str__(self) -> str:
        return with_error(self.value, self.std, self.unit)


def numbers(item: Reported) -> list[Number]:
    """Every number of an effect or fault."""
    found = []
    prior = {} if is_fault(item.name) else CATALOGUE[item.name].prior
    for field, value in item.parameters.items():
        several = isinstance(value, list)
        each = np.atleast_1d(np.asarray(value, dtype=float))
        deviation = np.broadcast_to(np.asarray(item.uncertainty.get(field, np.nan), dtype=float), each.shape)
        factor, unit = readable(unit_of(item.name, field), float(np.max(np.abs(each))))
        labels = _COMPONENTS.get(len(each), tuple(str(i) for i in range(len(each))))
        low_high = None if field not in prior else (factor * prior[field][0], factor * prior[field][1])
        for label, v, s in zip(labels, each, deviation, strict=True):
            name = f"{field} {label}" if several else field
            found.append(Number(name, factor * float(v), factor * float(s), unit, low_high))
    return found


def readable(unit: str, size: float) -> tuple[float, str]:
    """Factor and unit in which a small number reads well: ms, mm and g for what is far below s, m and kg."""
    smaller = {"s": "ms", "m": "mm", "kg": "g"}
    return (1e3, smaller[unit]) if unit in smaller and size < 0.5 else (1.0, unit)


def with_error(value: float, std: float, unit: str = "") -> str:
    """value ± std unit with as many digits as the deviation allows."""
    unit = f" {unit}" if unit else ""
    if not np.isfinite(std) or std <= 0:
        return f"{value:.3g}{unit}"
    power = int(np.floor(np.log10(max(abs(value), std))))
    scale = power if power < -3 or power > 4 else 0
    digits = max(0, 1 - int(np.floor(np.log10(std))) + scale)
    a, b = value / 10.0**scale, std / 10.0**scale
    return f"({a:.{digits}f} ± {b:.{digits}f})e{scale}{unit}" if scale else f"{a:.{digits}f} ± {b:.{digits}f}{unit}"


def probability(p: float) -> str:
    """A p-value as printed."""
    return f"{p:.1g}" if p > 1e-300 else "< 1e-300"


def strength(item: Reported) -> str:
    """All numbers of an effect in one phrase."""
    return ", ".join(f"{number.label} {number}" for number in numbers(item))


def change(before: float, after: float) -> str:
    """A relative change as printed."""
    share = round(100 * (after / before - 1))
    return f"{share:+d} %" if share else "0 %"


def verdict(outcome: Outcome) -> str:
    """What was found, in a sentence or two."""
    physics = [item for item in outcome.reported if not is_fault(item.name)]
    faults = [item for item in outcome.reported if is_fault(item.name)]
    parts = []
    if len(physics) == 1:
        (item,) = physics
        parts.append(
            f"The drone flies with {item.name} the model lacks ({MEANING.get(item.name, 'no description')}): "
            f"{strength(item)}{_interval(item)}."
        )
    elif physics:
        named = "; ".join(f"{item.name} ({strength(item)})" for item in physics)
        parts.append(f"The drone flies with {len(physics)} effects the model lacks: {named}.")
    if faults:
        named = "; ".join(f"{item.name}, {MEANING[item.name]}: {strength(item)}" for item in faults)
        parts.append(f"The recording is at fault, not the physics: {named}.")
        if not physics and outcome.unexplained is None:
            parts.append("Of the physics nothing is missing beyond chance.")
    if outcome.unexplained is not None:
        parts.append(f"Something is left that no effect of the catalogue accounts for: {outcome.unexplained.where}.")
    elif not outcome.reported:
        parts.append("Nothing is missing beyond chance.")
    if outcome.reported or outcome.unexplained is not None:
        parts.append(_bought(outcome))
    return " ".join(parts)


def _interval(item: Reported) -> str:
    """The 95 % interval of an effect with one number."""
    found = numbers(item)
    if len(found) != 1:
        return ""
    low, high = (found[0].value + side * 1.96 * found[0].std for side in (-1, 1))
    return f" (95 % interval {low:.4g} to {high:.4g})"


def _bought(outcome: Outcome) -> str:
    """The largest drop of a held-out error at the longest horizon."""
    before, after = outcome.before.metrics("commands_in"), outcome.after.metrics("commands_in")
    horizon = f"@{max(outcome.before.horizons):g}s"
    keys = [key for key in before if "_rmse_" in key and key.endswith(horizon)]
    key = min(keys, key=lambda k: after[k] / before[k])
    quantity, _, unit = key.partition("@")[0].split("_")
    unit = {"mps": "m/s", "radps": "rad/s"}.get(unit, unit)
    return (
        f"On held-out flights the {quantity} error {horizon[1:-1]} s ahead goes from {before[key]:.3g} to "
        f"{after[key]:.3g} {unit} ({change(before[key], after[key])})."
    )
