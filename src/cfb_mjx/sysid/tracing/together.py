"""All that a drone lacks at once: for real drones, on which no effect alone makes predictions better.

A search that takes in one effect after another asks of each whether half a second of flight is predicted better with
it. Where ten effects are missing the answer is no ten times. Here every effect is judged where it acts, and only the
whole set by predictions:

1. commands to rotor speeds: the motors on their own, from measured rotor speeds (`cfb_mjx.sysid.tracing.motors`);
2. what a drone in one piece usually lacks (`PLANT`), all at once, by predictions;
3. what only some drones have (a load, wind): absent effects in the order of what the innovations say for them, each
   tried beside the rest, kept where predictions gain;
4. what does not earn its place beside the others goes, the least first.

Effects the model declares already are what is known of the type of drone: they stay as they are, but for those that are
a drone's own (`OWN`). Where the model says how far drones of the type differ (``spread``), they move within that.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import norm

from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import CATALOGUE, Effect
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Entry, ModelFile
from cfb_mjx.sysid.evaluation import Evaluation, LogEvaluation, evaluate
from cfb_mjx.sysid.metrics import BLOCK
from cfb_mjx.sysid.refinement import Number, Refinement, plausible_numbers, refine
from cfb_mjx.sysid.refinement.numbers import HELD, PLANT
from cfb_mjx.sysid.refinement.predictions import kinds_alike
from cfb_mjx.sysid.rotors.flown_motors import Motors
from cfb_mjx.sysid.tracing.evidence import Evidence, alike, covariance, solve
from cfb_mjx.sysid.tracing.fits import beside_hold
from cfb_mjx.sysid.tracing.hypothesis import SHIFT, Column, Hypothesis, moved, neutral_effects, strengths
from cfb_mjx.sysid.tracing.motors import MOTORS, motors_of, with_motors
from cfb_mjx.sysid.tracing.rules import Rules
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.trace import line_of

OWN = ("cog_offset", "thrust_tilt", "torque_scale", "command_delay", "motor_asymmetry", "battery_sag")
"""Of `PLANT`, what differs from one drone of a type to the next."""


@dataclass(frozen=True)
class Part:
    """One effect of the whole.

    Attributes:
        name: of the effect.
        parameters: its numbers by field, and their standard deviations; NaN where one stands at a bound.
        at_bound: names of numbers that do.
        without: the drone without it, the others shifted to make up for it.
        buys: by which share it lowers the mean error of the fit flights' predictions: attitude and velocity, at all
            horizons, commands and rotor speeds in, each over what hold errs.
        confusable: effects whose numbers make up for its own.
        t, p_value: of the fit flights' errors with it against those without; of one that the rotor speeds tell, of
            its number against nothing.
        told: whether the rotor speeds tell it: then it need not make predictions better, only not worse.
    """

    name: str
    parameters: dict[str, Any]
    uncertainty: dict[str, Any]
    at_bound: list[str]
    without: Quadrotor
    buys: float
    confusable: list[str]
    t: float
    p_value: float
    told: bool = False


@dataclass(frozen=True)
class Together:
    """Outcome of `fit_together`.

    Attributes:
        model: the drone with everything that stays.
        fit: of its effects.
        motors: entries of the model file that the motors' fit replaces.
        parts: its effects, what buys most first.
        tried: what was looked at, as in a search.
        evaluation: of its predictions of the fit flights.
    """

    model: Quadrotor
    fit: Refinement
    motors: dict[str, Entry]
    parts: list[Part]
    tried: list[dict]
    evaluation: Evaluation
    typical: frozenset[str] = frozenset()
    """Declared effects that moved within the spread of the type: no parts."""

    @property
    def beside_hold(self) -> float:
        """Of its predictions of the fit flights."""
        return beside_hold(self.evaluation)

    def without(self, names: Collection[str]) -> Quadrotor:
        """The drone without some of its parts, the others moved to make up for them."""
        fitted = set(_fitted(self.fit))
        model = _bare(self.fit, self.fit.without([name for name in names if name in fitted]).model)
        for name in set(names) - fitted:
            model = _neutral(model, name)
        return model


def fit_together(
    logs: Sequence[FlightLog],
    base: ModelFile,
    search: Search,
    say: Callable[[str], None] = lambda _: None,
) -> Together:
    """Fit all that a drone lacks at once.

    Args:
        logs: flights to fit, as recorded; run with x64 enabled.
        base: the declared model.
        search: over the same flights, for what the innovations say; its rules count.
        say: told what happens.
    """
    rules = search.rules
    motors = motors_of(logs, base, search, say)
    start = with_motors(base, motors)
    names = names_to_fit(base, motors.known)
    known = of_type(base, rules.spreads)
    say(f"fitting {len(names)} effects together")
    fit = partial(_fit, logs, kinds_alike(start, logs), rules)
    typical = {k.effect for k in known}
    numbers = tuple(n for n in plausible_numbers(start.parameters, names) if n.effect not in typical)
    found = fit(start, numbers, rules.steps, {})
    tried: list[dict] = []
    refused: set[str] = {SHIFT, *(MOTORS if motors.known else ())}
    if "thrust_scale" in names:
        # No flight tells more mass from less thrust.
        refused.add("payload")
    for _ in range(rules.rounds):
        ranking = ranked(search, found.model, refused)
        tried.append({"present": _names(found.model), "ranking": [line_of(v, e) for e, v in ranking[:8]]})
        better = None
        clear = [(evidence, variant) for evidence, variant in ranking if evidence.t > rules.clear]
        for evidence, variant in clear[: rules.tried]:
            name = variant[0].effect
            say(f"trying {name} beside the others")
            model, numbers = _with(found, variant, evidence)
            reached = found.foreseen(numbers, model)
            if reached < (1 - rules.gain / 2) * found.cost[1]:
                beside = [n.held_at_neutral if n.said_by(name) else n for n in found.numbers]
                richer = fit(model, (*beside, *numbers), rules.trial_steps, found.trims)
                reached = richer.cost[1]
                # What drives another number out of what is plausible stands in for something else.
                pressed = set(richer.pressed) - set(found.pressed)
                better = richer if reached < (1 - rules.gain) * found.cost[1] and not pressed else None
            tried[-1] |= {"tried": name, "drop": {"loss": 1 - reached / found.cost[1]}}
            if better is not None:
                break
            refused.add(name)
        if better is None:
            break
        found = better
    if known:
        # Last: free from the start, they would make up for what only this drone has.
        say("moving what the type declares within its spread")
        found = fit(found.model, (*found.numbers, *known), rules.trial_steps, found.trims)
    found = _lean(found, fit, rules, say, typical)
    found, motors = _motors_that_matter(found, motors, rules, say)
    model = _bare(found, found.model)
    parts = _parts(found, motors, rules, say, typical)
    return Together(model, found, motors.entries, parts, tried, _predicted(model, logs), frozenset(typical))


def names_to_fit(base: ModelFile, motors_told: bool) -> list[str]:
    """Effects to fit together: what a model declares is known of the type, but for what is a drone's own."""
    declared = {mapping["name"] for mapping in base.effects}
    told = MOTORS if motors_told else ()
    return [name for name in PLANT if name not in told and (name in OWN or name not in declared)]


def of_type(base: ModelFile, spreads: float) -> tuple[Number, ...]:
    """Numbers of declared effects that have a ``spread`` between drones, within so many of it about the declared value.

    How far the type's own value is unsure (``uncertainty``) counts too. A drone's own effects are free of it.
    """
    model = Quadrotor.from_file(base)
    items = {item["name"]: item for item in base.effects if item.get("spread") and item["name"] not in OWN}

    def said(number: Number, what: str) -> float:
        value = (items[number.effect].get(what) or {}).get(number.field)
        each = np.nan_to_num(np.atleast_1d(np.asarray(0.0 if value is None else value, dtype=float)))
        # One number stands for all components.
        return float(each[(number.index or 0) % len(each)])

    found = []
    for number in plausible_numbers(model.parameters, list(items)):
        value = number.of(model)
        reach = spreads * float(np.hypot(said(number, "spread"), said(number, "uncertainty")))
        if number.field in items[number.effect]["spread"] and reach > HELD:
            found.append(replace(number, low=value - reach, high=value + reach))
    return tuple(found)


def hypothesis_of(search: Search, model: Quadrotor, absent: Collection[str] = ()) -> Hypothesis:
    """A model as a search has it: every effect of the catalogue, most of them neutral, as are those ``absent``."""
    neutral = neutral_effects(search.names)
    nothing = Hypothesis(neutral, origin=neutral)
    own = {type(e).name: e for e in model.effects if type(e).name not in absent}
    return replace(
        nothing, effects=tuple(own.get(type(e).name, e) for e in nothing.effects), present=tuple(own), lead=0.0
    )


def ranked(search: Search, model: Quadrotor, refused: set[str]) -> list[tuple[Evidence, list[Column]]]:
    """Absent effects by what the innovations say for each beside the others, the largest gain first."""
    search = replace(search, parameters=model.parameters, _flights={})
    hypothesis = search.learned(hypothesis_of(search, model))
    best = search.probes(hypothesis, search.whole(hypothesis))
    return sorted((pair for name, pair in best.items() if name not in refused), key=lambda pair: -pair[0].gain)


ASKED_STEPS = 3
"""Steps towards what the innovations ask for: one from far off goes too far for what divides (inertia)."""


@dataclass(frozen=True)
class Asked:
    """What the innovations make of one number: accelerations from row to row, beside a disturbance that wanders.

    Predictions fly on the commands alone, and under a controller these answer what the model does not feel: inertia and
    damping come out too large. The innovations are free of that. Where both tell, and differ, a number stands in for
    something.

    Attributes:
        name: of the number.
        value: that they ask for.
        std: its standard deviation.
        contradicts: whether that is not what predictions ask for.
    """

    name: str
    value: float
    std: float
    contradicts: bool


def asked(search: Search, model: Quadrotor, names: Collection[str]) -> dict[str, list[Asked]]:
    """What the innovations ask of the strengths of some effects of a model, all together, by effect."""
    search = replace(search, parameters=model.parameters, _flights={})
    hypothesis = search.learned(hypothesis_of(search, model))
    columns = [column for name in names for variant in strengths(name, names)[:1] for column in variant]
    columns = [replace(column, probe=()) for column in columns]

    def values(of):
        every = [np.asarray(getattr(of.effect(c.effect), c.field)) for c in columns]
        return np.array([v if c.index is None else v[c.index] for c, v in zip(columns, every, strict=True)])

    predicted, scale = values(hypothesis), np.array([c.scale for c in columns])
    others, deviations = predicted, np.full(len(columns), np.inf)
    for step in range(ASKED_STEPS):
        linear = search.linearise(hypothesis, columns)
        index = linear.index(columns)
        steps = solve(linear.blocks.sum(0), index, linear.scale)
        deviations = np.sqrt(np.diag(covariance(linear.blocks, index, linear.scale, steps))) * scale
        others = values(hypothesis) + steps * scale
        if step + 1 < ASKED_STEPS:
            hypothesis = search.moved(hypothesis, columns, np.append(0.0, steps * scale))
    found: dict[str, list[Asked]] = {name: [] for name in names}
    for column, now, other, std in zip(columns, *map(np.ndarray.tolist, (predicted, others, deviations)), strict=True):
        at = "" if column.index is None else f"[{column.index}]"
        differs = abs(other - now) > max(
            search.rules.contradicts * std, search.rules.differs * max(abs(now), abs(other))
        )
        found[column.effect].append(Asked(f"{column.effect}.{column.field}{at}", other, std, differs))
    return found


def paired(poorer: Evaluation, better: Evaluation) -> tuple[float, float]:
    """How surely the second predicts the same flights better: t over blocks of windows, and its one-sided p."""
    pairs = zip(poorer.logs, better.logs, strict=True)
    return _surely([_losses(less) - _losses(more) for less, more in pairs if len(less.windows)])


def _surely(gains: Sequence[np.ndarray]) -> tuple[float, float]:
    """t and p of gains (W,) of windows in the order they were flown, several flights or kinds of prediction."""
    blocks = np.array([each[i : i + BLOCK].sum() for each in gains for i in range(0, len(each), BLOCK)])
    spread = np.sqrt(len(blocks) / max(len(blocks) - 1, 1) * np.sum((blocks - blocks.mean()) ** 2))
    t = float(blocks.sum() / max(spread, 1e-300))
    return t, float(norm.sf(t))


def _losses(one: LogEvaluation) -> np.ndarray:
    """(W,) of each window: errors of attitude and velocity at the last horizon over the flight's mean of hold."""
    errors, still = not_none(one.errors["commands_in"]), not_none(one.errors["hold"])
    parts = [errors[q][:, -1] / still[q][:, -1].mean() for q in ("attitude", "velocity")]
    return np.minimum(np.nan_to_num(np.sum(parts, axis=0), nan=1e3), 1e3)


def _predicted(model: Quadrotor, logs: Sequence[FlightLog]) -> Evaluation:
    return evaluate(model, logs, keep_diverged=True)


def _names(model: Quadrotor) -> list[str]:
    return [type(e).name for e in model.effects]


def _fit(
    logs: Sequence[FlightLog],
    weights: Mapping[str, float],
    rules: Rules,
    model: Quadrotor,
    numbers: Sequence[Number],
    steps: int,
    trims: Mapping[str, np.ndarray],
) -> Refinement:
    return refine(model, logs, numbers, weights=weights, trims=trims, iterations=steps, most_windows=rules.windows)


def _with(found: Refinement, variant: list[Column], evidence: Evidence) -> tuple[Quadrotor, tuple[Number, ...]]:
    """The model with one more effect at a tenth of what the innovations give it, and the effect's numbers.

    All of it at once might be far off, for what they see of an effect and what predictions ask of it may differ.
    """
    kind = CATALOGUE[variant[0].effect]
    effect: Effect = kind.neutral()
    for column, value in zip(variant, evidence.values, strict=True):
        effect = moved(effect, column, 0.1 * float(value) * column.scale, False)
    model = Quadrotor(found.model.parameters, (*found.model.effects, effect), body=found.model.body)
    there = _fitted(found)
    own = plausible_numbers(model.parameters, [kind.name])
    return model, tuple(number for number in own if not any(map(number.said_by, there)))


def _lean(
    found: Refinement,
    fit: Callable[..., Refinement],
    rules: Rules,
    say: Callable[[str], None],
    typical: Collection[str] = (),
) -> Refinement:
    """The fit with what does not earn its place held at neutral, the least first, fitted anew until all else does.

    What is ``typical`` stays.
    """
    while True:
        gone: list[str] = []
        while rest := [name for name in _fitted(found) if name not in gone and name not in typical]:
            growth = {name: found.growth([*gone, name]) for name in rest}
            least = min(rest, key=growth.__getitem__)
            if growth[least] > rules.worth * found.cost[1] * (1 + len(gone)):
                break
            gone.append(least)
        if not gone:
            return found
        say(f"leaving out {', '.join(gone)}")
        numbers = [n.held_at_neutral if n.effect in gone else n for n in found.numbers]
        found = fit(found.without(gone).model, numbers, rules.trial_steps, found.trims)


def _motors_that_matter(
    found: Refinement, motors: Motors, rules: Rules, say: Callable[[str], None]
) -> tuple[Refinement, Motors]:
    """The fit without effects of the motors that predictions do not miss, the least first.

    Rotor speeds tell of an effect long before it matters. What goes is left in the fit's model, at neutral.
    """
    while motors.effects:
        losses = [found.loss(_neutral(found.model, told.name, told.without)) for told in motors.effects]
        reached, least = min(losses), motors.effects[int(np.argmin(losses))]
        if reached - found.cost[1] > rules.worth * found.cost[1]:
            break
        say(f"leaving out {least.name}")
        found = replace(found, model=_neutral(found.model, least.name, least.without), cost=(found.cost[0], reached))
        kept = {each.name: each for each in least.without}
        rest = (told for told in motors.effects if told is not least)
        rest = (replace(told, effect=kept.get(told.name, told.effect), without=()) for told in rest)
        motors = replace(motors, effects=tuple(rest))
    return found, motors


def _fitted(found: Refinement) -> list[str]:
    """Names of the effects whose numbers may move."""
    return list(dict.fromkeys(n.effect for n in found.numbers if not n.held))


def _bare(found: Refinement, model: Quadrotor) -> Quadrotor:
    """A model without the effects that a fit held at neutral, and those of motors that do nothing."""
    held = {n.effect for n in found.numbers} - set(_fitted(found))
    effects = tuple(e for e in model.effects if type(e).name not in held and not _idle(e))
    return Quadrotor(model.parameters, effects, body=model.body)


def _parts(
    found: Refinement, motors: Motors, rules: Rules, say: Callable[[str], None], typical: Collection[str] = ()
) -> list[Part]:
    say("leaving out one effect after another")
    whole = found.left
    error = _mean(whole.errors)
    told = {each.name: each for each in motors.effects}
    parts = []
    for name in [*(name for name in _fitted(found) if name not in typical), *told]:
        own = told.get(name)
        less = found.without([name]) if own is None else found.judged(_neutral(found.model, name, own.without))
        effect = next(e for e in found.model.effects if type(e).name == name)
        if own is None:
            std, at_bound = (
                found.uncertainty(name),
                [n.name for n in found.numbers if n.effect == name and found.at_bound(n)],
            )
            confusable = alike([n.effect for n in found.numbers], found.correlation, name, rules.confused)
            t, p_value = _surely([(a - b).sum(axis=(1, 2)) for a, b in zip(less.losses, whole.losses, strict=True)])
        else:
            std, at_bound, confusable = own.std, list(own.at_bound), list(own.alike)
            t, p_value = own.t, float(norm.sf(own.t))
        values = {key: np.asarray(getattr(effect, key)).tolist() for key in std}
        buys = 1 - error / _mean(less.errors)
        without = _bare(found, less.model)
        parts.append(Part(name, values, std, at_bound, without, buys, confusable, t, p_value, own is not None))
    return sorted(parts, key=lambda part: -part.buys)


def _neutral(model: Quadrotor, name: str, others: Sequence[Effect] = ()) -> Quadrotor:
    """A model with an effect at neutral, and others as they are without it."""
    instead = {each.name: each for each in (*others, CATALOGUE[name].neutral())}
    effects = (instead.get(each.name, each) for each in model.effects)
    return Quadrotor(model.parameters, tuple(effects), body=model.body)


def _idle(effect: Effect) -> bool:
    """Whether an effect of the motors is at neutral."""
    neutral, fields = type(effect).neutral(), type(effect).strengths
    return type(effect).name in MOTORS and all(
        np.array_equal(getattr(effect, field), getattr(neutral, field)) for field in fields
    )


def _mean(errors: list[np.ndarray]) -> float:
    """Over all windows, horizons and quantities."""
    return float(np.concatenate([each.ravel() for each in errors]).mean())
