"""Wording of the report of a model correction: verdict, numbers with units, and suggested experiments."""

from __future__ import annotations

import shlex
from dataclasses import dataclass

import numpy as np

from cfb_mjx import plugins
from cfb_mjx.model.effects import CATALOGUE, KNOWN, SENSOR_FAULTS, CogOffset, Inertia, MotorTimeConstant, RotorDrag
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.tracing.diagnosis import Diagnosis, Reported

FOLLOWS = {
    "velocity": RotorDrag.experiment,
    "rate": Inertia.experiment,
    "rotor mean": "climbs, dives and hovers at several thrusts, rotor speed logged",
    "rotor": MotorTimeConstant.experiment,
    "command": MotorTimeConstant.experiment,
    "position": "the same manoeuvre at another place, away from walls, cables and other drones",
    "height": "hover at several heights, and the same heights over another floor",
    "heading": CogOffset.experiment,
    "voltage": "hover from a full battery to an empty one",
    "time": "hover for a minute from cold, twice",
    "offset": CogOffset.experiment,
}
_COMPONENTS = {2: ("x", "y"), 3: ("x", "y", "z"), 4: ("M1", "M2", "M3", "M4")}


def separating(names: list[str], model: str) -> str | None:
    """The command that finds a trajectory to distinguish effects; None if one of them is not in the catalogue."""
    if not set(names) <= set(CATALOGUE):
        return None
    plugged = "".join(f" --plugin {shlex.quote(str(file))}" for file in plugins.files())
    return f"cfb excite separate --between {','.join(names)} --model {model}{plugged} -o next"


def is_fault(name: str) -> bool:
    """Whether a name is a fault of the recording, not a physical effect."""
    return name in SENSOR_FAULTS


def meaning(name: str) -> str:
    """Short phrase that explains an effect or fault."""
    if is_fault(name):
        return SENSOR_FAULTS[name].meaning
    return KNOWN[name].meaning or documented(name) or name.replace("_", " ")


def documented(name: str) -> str:
    """First paragraph of an effect's docstring, without the full stop."""
    return " ".join((KNOWN[name].__doc__ or "").split("\n\n")[0].split()).rstrip(".")


def experiment(name: str) -> str:
    """Flights that excite an effect or fault, in words."""
    return (SENSOR_FAULTS if is_fault(name) else KNOWN)[name].experiment or f"flights that excite {name}"


def unit_of(name: str, field: str) -> str:
    """Unit of a parameter of an effect or fault; empty for dimensionless parameters."""
    unit = SENSOR_FAULTS[name].unit if is_fault(name) else KNOWN[name].units.get(field, "1")
    return "" if unit == "1" else unit.replace("^2", "²")


@dataclass(frozen=True)
class Number:
    """One number of an effect as printed, in a unit of suitable size."""

    label: str
    value: float
    std: float
    unit: str
    plausible: tuple[float, float] | None
    """Plausible range of the catalogue; None for faults of the recording."""

    def __str__(self) -> str:
        return with_error(self.value, self.std, self.unit)


def numbers(item: Reported) -> list[Number]:
    """All numbers of an effect or fault."""
    found = []
    prior = {} if is_fault(item.name) else KNOWN[item.name].prior
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
    """Factor and unit for printing: ms, mm and g for values below half a s, m or kg."""
    smaller = {"s": "ms", "m": "mm", "kg": "g"}
    return (1e3, smaller[unit]) if unit in smaller and size < 0.5 else (1.0, unit)


def with_error(value: float, std: float, unit: str = "") -> str:
    """Format as ``value ± std unit``, with the number of digits that the standard deviation justifies."""
    unit = f" {unit}" if unit else ""
    if not np.isfinite(std) or std <= 0:
        return f"{value:.3g}{unit}"
    power = int(np.floor(np.log10(max(abs(value), std))))
    scale = power if power < -3 or power > 4 else 0
    digits = max(0, 1 - int(np.floor(np.log10(std))) + scale)
    a, b = value / 10.0**scale, std / 10.0**scale
    return f"({a:.{digits}f} ± {b:.{digits}f})e{scale}{unit}" if scale else f"{a:.{digits}f} ± {b:.{digits}f}{unit}"


def probability(p: float) -> str:
    """Format a p-value."""
    return f"{p:.1g}" if p > 1e-300 else "< 1e-300"


def strength(item: Reported) -> str:
    """All numbers of an effect in one phrase."""
    return ", ".join(f"{number.label} {number}" for number in numbers(item))


def change(before: float, after: float) -> str:
    """Format a relative change."""
    share = round(100 * (after / before - 1))
    return f"{share:+d} %" if share else "0 %"


def verdict(diagnosis: Diagnosis) -> str:
    """Summary of the result in one or two sentences."""
    physics = [item for item in diagnosis.reported if not is_fault(item.name)]
    faults = [item for item in diagnosis.reported if is_fault(item.name)]
    parts = []
    if diagnosis.together is not None:
        return _many(diagnosis, physics)
    if len(physics) == 1:
        (item,) = physics
        parts.append(
            f"The drone flies with {item.name} the model lacks ({meaning(item.name)}): "
            f"{strength(item)}{_interval(item)}."
        )
    elif physics:
        named = "; ".join(f"{item.name} ({strength(item)})" for item in physics)
        parts.append(f"The drone flies with {len(physics)} effects the model lacks: {named}.")
    if faults:
        named = "; ".join(f"{item.name}, {meaning(item.name)}: {strength(item)}" for item in faults)
        parts.append(f"The recording is at fault, not the physics: {named}.")
        if not physics and diagnosis.unexplained is None:
            parts.append("In the physics, nothing is missing beyond chance.")
    if diagnosis.unexplained is not None:
        parts.append(f"Structure is left that no effect of the catalogue accounts for: {diagnosis.unexplained.where}.")
    elif not diagnosis.reported:
        parts.append("Nothing is missing beyond chance.")
    if diagnosis.reported or diagnosis.unexplained is not None:
        parts.append(_bought(diagnosis))
    return " ".join(parts)


SHOWN = 3
"""Largest number of effects that the first paragraph explains."""


def _many(diagnosis: Diagnosis, physics: list[Reported]) -> str:
    """Summary of a joint fit of many effects: the effects, the errors before and after, and advice."""
    first = "; ".join(f"{item.name} ({meaning(item.name)})" for item in physics[:SHOWN])
    more = [item.name for item in physics[SHOWN:]]
    count = f"{len(physics)} effects" if len(physics) != 1 else "one effect"
    motors = ", and its motors differ from the model's" if diagnosis.motors else ""
    has = f"The drone flies with {count} the model lacks{motors}; the most important: {first}"
    has += f"; then {', '.join(more)}." if more else "."
    horizon = f"@{max(diagnosis.before.horizons):g}s"
    keys = {"attitude": ("attitude_mean_deg", "deg"), "velocity": ("velocity_mean_mps", "m/s")}
    before, after, still = (
        not_none(found.metrics(variant))
        for found, variant in (
            (diagnosis.before, "commands_in"),
            (diagnosis.after, "commands_in"),
            (diagnosis.before, "hold"),
        )
    )
    errors = " and ".join(
        f"the {name} error {horizon[1:-1]} s ahead goes from {before[key + horizon]:.3g} to {after[key + horizon]:.3g} "
        f"{unit} (hold: {still[key + horizon]:.3g})"
        for name, (key, unit) in keys.items()
    )
    bound = [number for item in diagnosis.reported for number in item.at_bound]
    do = "Fly and train with model.yaml"
    if bound:
        do += f"; do not trust as physics the numbers at the edge of their plausible range ({', '.join(bound)})"
    other = [item.name for item in diagnosis.reported if any(each.contradicts for each in item.asked)]
    if other:
        no = ", nor" if bound else "; do not trust as physics"
        do += f"{no} the effects that the accelerations contradict ({', '.join(other)})"
    return f"{has} On held-out flights {errors}. {do}."


def _interval(item: Reported) -> str:
    """The 95 % interval of an effect with one number; empty for several numbers."""
    found = numbers(item)
    if len(found) != 1:
        return ""
    low, high = (found[0].value + side * 1.96 * found[0].std for side in (-1, 1))
    return f" (95 % interval {low:.4g} to {high:.4g})"


def _bought(diagnosis: Diagnosis) -> str:
    """Sentence on the largest reduction of a held-out error at the longest horizon."""
    before, after = (not_none(found.metrics("commands_in")) for found in (diagnosis.before, diagnosis.after))
    horizon = f"@{max(diagnosis.before.horizons):g}s"
    keys = [key for key in before if "_rmse_" in key and key.endswith(horizon)]
    key = min(keys, key=lambda k: after[k] / before[k])
    quantity, _, unit = key.partition("@")[0].split("_")
    unit = {"mps": "m/s", "radps": "rad/s"}.get(unit, unit)
    return (
        f"On held-out flights the {quantity} error {horizon[1:-1]} s ahead goes from {before[key]:.3g} to "
        f"{after[key]:.3g} {unit} ({change(before[key], after[key])})."
    )
