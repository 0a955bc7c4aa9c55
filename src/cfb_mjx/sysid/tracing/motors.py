"""Motors of a drone whose model lacks many effects, from rotor speeds alone: named effects, or refitted constants.

Rotor speeds do not depend on the rest of the drone, so the effects of the motors are found first, by one-step
innovations. This is done twice: with the declared motor constants, and with refitted ones (gain, offset and lag of each
motor). The first result is kept unless the second is clearly likelier, with a penalty for its parameters. Named effects
are more informative; refitted constants are for motors that differ from the declared ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import ModelFile
from cfb_mjx.sysid.rotors.flown_motors import Motors, Told, evenly_spread, flown_motors
from cfb_mjx.sysid.tracing.evidence import alike
from cfb_mjx.sysid.tracing.hypothesis import SHIFT, Hypothesis, bounds
from cfb_mjx.sysid.tracing.jointly import look_by_look, one_by_one
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.trace import numbers_of, spread_of

FITTED = ("command_delay", "battery_sag")
"""Effects that are fitted together with refitted motor constants."""
IN_CONSTANTS = ("motor_gain_mismatch", "motor_time_constant")
"""Effects that refitted motor constants include."""
MOTORS = (
    *FITTED,
    *IN_CONSTANTS,
    *("motor_asymmetry", "motor_second_order", "motor_thermal_drift", "motor_hysteresis", "esc_rate_limit"),
)
"""Effects that measured rotor speeds can identify."""


def motors_of(
    logs: Sequence[FlightLog], base: ModelFile, search: Search, say: Callable[[str], None] = lambda _: None
) -> Motors:
    """Identify the motors from measured rotor speeds; the result is empty if none were measured.

    Args:
        logs: flights to fit, as recorded; run with x64 enabled.
        base: the declared model.
        search: over the same flights; supplies the rules.
        say: called with a message at each step.
    """
    flown = [log for log in logs if log.rotor_speed is not None]
    if not flown:
        return Motors()
    rules = search.rules
    say("fitting the motors to the rotor speeds")
    parts = _some(flown, rules.motor_searched)
    anew = flown_motors(logs, base.parameters(), rules.motor_rows, rules.motor_piece)
    declared = {type(e).name for e in search.declared}
    names = tuple(name for name in search.names if name in MOTORS or name in declared)
    few = replace(rules, looks=rules.motor_looks)
    plain = replace(search, logs=parts, names=names, rules=few, rotors_only=True, _flights={})
    started = with_motors(base, anew)
    beside = replace(plain, parameters=started.parameters, declared=started.effects)
    # These were fitted with the constants, to pieces of more flights: few flights hardly separate the slope of the
    # battery's effect from its level.
    held = (*IN_CONSTANTS, *(told.name for told in anew.effects))
    rows = sum(int(np.isfinite(not_none(log.rotor_speed)).sum()) for log in parts)
    named, named_cost = _found(plain, plain.nothing(), (), rows, say)
    rest, rest_cost = _found(beside, beside.nothing(), held, rows, say)
    constants = sum(np.size(entry.value) for entry in anew.entries.values()) + len(anew.effects)
    price = 0.5 * np.log(rows) * constants
    # The log-likelihood ratio of a statistic t is t^2 / 2; require t of at least ``clear``, as for an effect.
    if named_cost - rest_cost - price < 0.5 * rules.clear**2:
        return Motors(effects=_told(plain, named), known=True)
    return Motors(anew.entries, (*anew.effects, *_told(beside, rest)), known=True)


def with_motors(base: ModelFile, motors: Motors) -> Quadrotor:
    """The declared model with its motors replaced by those found."""
    model = Quadrotor.from_file(replace(base, entries={**base.entries, **motors.entries}))
    # Refitted constants replace the effects of the motors that the model declares.
    replaced = {*(told.name for told in motors.effects), *(MOTORS if motors.entries else ())}
    kept = tuple(e for e in model.effects if type(e).name not in replaced)
    return Quadrotor(model.parameters, (*kept, *(told.effect for told in motors.effects)), body=model.body)


def _some(flown: Sequence[FlightLog], rows: int) -> list[FlightLog]:
    """As many flights as hold about ``rows`` rows, each from its first row: motors are cold at the start of a log."""
    count = int(np.clip(round(rows / np.mean([len(log) for log in flown])), 1, len(flown)))
    return [log.rows(np.arange(min(len(log), rows))) for log in evenly_spread(flown, count)]


def _found(
    search: Search, hypothesis: Hypothesis, never: Sequence[str], rows: int, say: Callable[[str], None]
) -> tuple[Hypothesis, float]:
    """Add the effects that the rotor speeds require; return the hypothesis and its BIC / 2.

    The second value is the negative log-likelihood plus half the logarithm of ``rows`` per parameter.
    """
    refused = {SHIFT, *never, *(name for name in search.names if name not in MOTORS)}
    found, _ = look_by_look(search, search.learned(hypothesis), refused, say=say)
    found = search.learned(found)
    return found, search.surprise(found) + 0.5 * np.log(rows) * len(search.own_columns(found))


def _told(search: Search, hypothesis: Hypothesis) -> tuple[Told, ...]:
    """The present effects of a hypothesis, with their uncertainty."""
    # Predictions hold a command until the next row. With a lead, a fitted delay would be too long by that lead.
    hypothesis = search.settled(replace(hypothesis, lead=0.0), search.rules.look_steps, lead_free=False, shrunk=True)
    linear = search.linearise(hypothesis, search.own_columns(hypothesis))
    columns, spread = spread_of(search, hypothesis, linear)
    deviation = np.sqrt(np.diag(spread))
    correlation = spread / np.outer(deviation, deviation)
    stds = dict(zip(columns, deviation.tolist(), strict=True))
    found = []
    for name, (evidence, without) in one_by_one(search, hypothesis).items():
        _, std = numbers_of(hypothesis, stds, name)
        effect = hypothesis.effect(name)
        at_bound = tuple(f"{name}.{f}" for f in std if np.any(np.isin(getattr(effect, f), bounds(name, f))))
        others = tuple(without.effect(other) for other in hypothesis.present if other != name)
        same = alike([c.effect for c in columns], correlation, name, search.rules.confused)
        found.append(Told(effect, std, evidence.t, at_bound, others, tuple(same)))
    return tuple(found)
