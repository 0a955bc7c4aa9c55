"""The motors of a drone from its flights: constants of each, their dead time, and how far they follow the battery."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.bench_tables import MotorRecord, record_of
from cfb_mjx.model.effects import BatterySag, CommandDelay, Effect
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Entry, Parameters
from cfb_mjx.sysid.rotors.motors import ENTRIES
from cfb_mjx.sysid.rotors.supply import SURE, fit_with_sag


@dataclass(frozen=True)
class Told:
    """An effect of the motors.

    Attributes:
        effect: with its numbers.
        std: their standard deviations, by field.
        t: how surely it is there: standard normal where it is not.
        at_bound: names of numbers that stand at the end of what is plausible.
        without: other effects of the motors, moved to make up for it; those that are not there stay as they are.
        alike: names of effects whose numbers make up for its own.
    """

    effect: Effect
    std: dict[str, Any]
    t: float
    at_bound: tuple[str, ...] = ()
    without: tuple[Effect, ...] = ()
    alike: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name

    @classmethod
    def of(cls, effect: Effect, number: str, std: float) -> Told:
        """An effect of one number, beside constants that were fitted with it."""
        value = float(getattr(effect, number))
        at = (f"{effect.name}.{number}",) if value in effect.prior[number] else ()
        return cls(effect, {number: std}, value / std, at)


@dataclass(frozen=True)
class Motors:
    """What commands and measured rotor speeds tell.

    Attributes:
        entries: of a model file.
        effects: of the motors.
        known: whether rotor speeds were measured.
    """

    entries: dict[str, Entry] = field(default_factory=dict)
    effects: tuple[Told, ...] = ()
    known: bool = False


def flown_motors(logs: Sequence[FlightLog], nominal: Parameters, rows: int, piece: float) -> Motors:
    """Each motor's constants, the dead time of all, and how far they follow the battery; nothing without rotor speeds.

    Args:
        logs: flights; of long ones the middle is enough.
        nominal: where to start.
        rows: that are fitted to, about: the middles of flights.
        piece: seconds of a flight at least, of so many flights evenly spread as that allows.
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
        # Beside a dead time of its own the lag is the motors' alone, not the one lag that is nearest to both.
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
    """So many of some flights, from the first to the last."""
    return [logs[i] for i in np.linspace(0, len(logs) - 1, count).round().astype(int)]


def _middle(log: FlightLog, rows: int) -> MotorRecord:
    """The motors in the middle of a flight, with the battery's voltage."""
    skipped = max(0, (len(log) - rows) // 2)
    part = log.rows(np.arange(skipped, len(log) - skipped))
    voltage = part.battery_voltage
    if voltage is not None and (known := np.isfinite(voltage)).any():
        voltage = np.interp(part.time, part.time[known], voltage[known])
    return replace(not_none(record_of(part)), battery_voltage=voltage)
