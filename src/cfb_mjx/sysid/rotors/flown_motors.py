"""Motors of a drone from its flights: constants of each motor, dead time, and dependence on the battery voltage."""

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
