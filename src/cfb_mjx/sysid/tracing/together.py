"""Joint fit of all missing effects, for real drones, on which no single effect improves predictions.

A search that adds one effect after another asks of each effect whether half a second of flight is predicted better with
it. If ten effects are missing, the answer is "no" for each of the ten. Therefore predictions judge the whole set:

1. Commands to rotor speeds: the motors are fitted on their own, from measured rotor speeds
   (`cfb_mjx.sysid.tracing.motors`).
2. The effects that an undamaged drone usually has in addition to the paper's model (`PLANT`) are fitted together, to
   predictions.
3. Effects that only some drones have (a load, wind) are tried alongside the rest, in the order of their evidence in the
   innovations, and kept if predictions improve.
4. Effects that contribute too little in addition to the others are removed, the least important first.

Effects that the model already declares belong to the type of drone. They stay as they are, except those that differ
from drone to drone (`OWN`). If the model states how far drones of the type differ (``spread``), they may move within
that range.
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
from cfb_mjx.sysid.tracing.hypothesis import SHIFT, Column, Hypothesis, moved, neutral_effects, strengths
from cfb_mjx.sysid.tracing.jointly import beside_hold
from cfb_mjx.sysid.tracing.motors import MOTORS, motors_of, with_motors
from cfb_mjx.sysid.tracing.rules import Rules
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.trace import line_of

OWN = ("cog_offset", "thrust_tilt", "torque_scale", "command_delay", "motor_asymmetry", "battery_sag")
"""Effects of `PLANT` that differ between drones of the same type."""


@dataclass(frozen=True)
class Part:
    """One effect of the joint fit.

    Attributes:
        name: of the effect.
        parameters: values by field.
        uncertainty: standard deviations by field; None if the parameter is at a bound.
        at_bound: names of the parameters at a bound.
        without: the drone without the effect, with the others adjusted to compensate.
        buys: share by which the effect lowers the mean prediction error on the fit flights (attitude and velocity, at
            all horizons, from commands and from measured rotor speeds, each divided by the error of `hold`).
        confusable: names of effects with parameters strongly correlated with its own.
        t: statistic of the comparison of the fit flights' errors with and without the effect; for an effect identified
            from rotor speeds, of its evidence there.
        p_value: one-sided p-value of ``t``.
        told: whether rotor speeds identify the effect. It then need not improve predictions, but must not make them
            worse.
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
        model: the drone with all effects that were kept.
        fit: fit of its effects.
        motors: entries of the model file that the motors' fit replaces.
        parts: its effects, the largest improvement first.
        tried: candidates of every round, as in a search.
        evaluation: predictions of the fit flights.
        typical: names of declared effects that were moved within the spread of the type; they are not parts.
    """

    model: Quadrotor
    fit: Refinement
    motors: dict[str, Entry]
    parts: list[Part]
    tried: list[dict]
    evaluation: Evaluation
    typical: frozenset[str] = frozenset()

    @property
    def beside_hold(self) -> float:
        """Prediction error on the fit flights relative to `hold` (`fits.beside_hold`)."""
        return beside_hold(self.evaluation)

    def without(self, names: Collection[str]) -> Quadrotor:
        """The drone without some of its parts, with the others adjusted to compensate."""
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
    """Fit all missing effects of a drone together.

    Args:
        logs: flights to fit, as recorded; run with x64 enabled.
        base: the declared model.
        search: over the same flights, for the evidence in the innovations; supplies the rules.
        say: called with a message at each step.
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
        # Flights cannot distinguish a larger mass from a smaller thrust.
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
                # A candidate that drives another parameter to its bound stands in for something else.
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
        # Done last: if free from the start, they would absorb the effects that only this drone has.
        say("fitting declared effects within the spread of the type")
        found = fit(found.model, (*found.numbers, *known), rules.trial_steps, found.trims)
    found = _lean(found, fit, rules, say, typical)
    found, motors = _motors_that_matter(found, motors, rules, say)
    model = _bare(found, found.model)
    parts = _parts(found, motors, rules, say, typical)
    return Together(model, found, motors.entries, parts, tried, _predicted(model, logs), frozenset(typical))


def names_to_fit(base: ModelFile, motors_told: bool) -> list[str]:
    """Names of the effects to fit together.

    Args:
        base: the declared model. Effects it declares are not fitted, unless they differ between drones (`OWN`).
        motors_told: leave out the effects that rotor speeds have identified.
    """
    declared = {mapping["name"] for mapping in base.effects}
    told = MOTORS if motors_told else ()
    return [name for name in PLANT if name not in told and (name in OWN or name not in declared)]


def of_type(base: ModelFile, spreads: float) -> tuple[Number, ...]:
    """Parameters of declared effects that may move within the spread between drones of the type.

    Args:
        base: the declared model. Only effects with a ``spread`` count, and not those of `OWN`.
        spreads: range about the declared value, in standard deviations. The deviation combines the ``spread`` and the
            ``uncertainty`` of the type's value.
    """
    model = Quadrotor.from_file(base)
    items = {item["name"]: item for item in base.effects if item.get("spread") and item["name"] not in OWN}

    def said(number: Number, what: str) -> float:
        value = (items[number.effect].get(what) or {}).get(number.field)
        each = np.nan_to_num(np.atleast_1d(np.asarray(0.0 if value is None else value, dtype=float)))
        # A single value holds for all components.
        return float(each[(number.index or 0) % len(each)])

    found = []
    for number in plausible_numbers(model.parameters, list(items)):
        value = number.of(model)
        reach = spreads * float(np.hypot(said(number, "spread"), said(number, "uncertainty")))
        if number.field in items[number.effect]["spread"] and reach > HELD:
            found.append(replace(number, low=value - reach, high=value + reach))
    return tuple(found)


def hypothesis_of(search: Search, model: Quadrotor, absent: Collection[str] = ()) -> Hypothesis:
    """Convert a model to a hypothesis of a search; effects named in ``absent`` become neutral."""
    neutral = neutral_effects(search.names)
    nothing = Hypothesis(neutral, origin=neutral)
    own = {type(e).name: e for e in model.effects if type(e).name not in absent}
    return replace(
        nothing, effects=tuple(own.get(type(e).name, e) for e in nothing.effects), present=tuple(own), lead=0.0
    )


def ranked(search: Search, model: Quadrotor, refused: set[str]) -> list[tuple[Evidence, list[Column]]]:
    """Evidence in the innovations for each absent effect that is not ``refused``, the largest gain first."""
    search = replace(search, parameters=model.parameters, _flights={})
    hypothesis = search.learned(hypothesis_of(search, model))
    best = search.probes(hypothesis, search.whole(hypothesis))
    return sorted((pair for name, pair in best.items() if name not in refused), key=lambda pair: -pair[0].gain)


ASKED_STEPS = 3
"""Number of Gauss-Newton steps in `asked`. A single long step overshoots for parameters that divide (inertia)."""


@dataclass(frozen=True)
class Asked:
    """Value of one parameter according to the innovations, to compare with its fit to predictions.

    Predictions use the commands only. Under feedback the commands respond to disturbances that the model lacks, which
    biases inertia and damping upwards. One-step innovations do not have this bias. If both determine a parameter and
    they differ, the parameter stands in for something else.

    Attributes:
        name: of the parameter.
        value: according to the innovations.
        std: its standard deviation.
        contradicts: whether it contradicts the fit to predictions (`Rules.contradicts`, `Rules.differs`).
    """

    name: str
    value: float
    std: float
    contradicts: bool


def asked(search: Search, model: Quadrotor, names: Collection[str]) -> dict[str, list[Asked]]:
    """Fit the strengths of some effects of a model to the innovations, all together.

    Args:
        search: over the flights.
        model: the drone, fitted to predictions.
        names: of the effects.

    Returns:
        Values of the effects' strengths, by effect.
    """
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
    """Paired test of whether ``better`` predicts the same flights better: t over blocks of windows, one-sided p."""
    pairs = zip(poorer.logs, better.logs, strict=True)
    return _surely([_losses(less) - _losses(more) for less, more in pairs if len(less.windows)])


def _surely(gains: Sequence[np.ndarray]) -> tuple[float, float]:
    """t and one-sided p-value of gains (W,) per window in flown order, one array per flight or kind of prediction."""
    blocks = np.array([each[i : i + BLOCK].sum() for each in gains for i in range(0, len(each), BLOCK)])
    spread = np.sqrt(len(blocks) / max(len(blocks) - 1, 1) * np.sum((blocks - blocks.mean()) ** 2))
    t = float(blocks.sum() / max(spread, 1e-300))
    return t, float(norm.sf(t))


def _losses(one: LogEvaluation) -> np.ndarray:
    """Loss (W,) of each window: attitude and velocity error at the last horizon, over the flight's mean for `hold`."""
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
    """The model with one more effect, at a tenth of its strength in the innovations, and the effect's parameters.

    The full strength might be a poor starting point, because predictions may require another value.
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
    """Hold effects that contribute too little at neutral, the least important first, and refit, until none is left.

    Effects in ``typical`` are kept.
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
    """Remove effects of the motors that predictions do not need, the least important first.

    Rotor speeds can show an effect that is far too small to matter. Removed effects stay in the fit's model, at
    neutral.
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
    """Names of the effects with free parameters."""
    return list(dict.fromkeys(n.effect for n in found.numbers if not n.held))


def _bare(found: Refinement, model: Quadrotor) -> Quadrotor:
    """The model without effects that the fit held at neutral, and without neutral effects of the motors."""
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
    """The model with an effect at neutral, and other effects replaced by ``others``."""
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
    """Mean over all windows, horizons and quantities."""
    return float(np.concatenate([each.ravel() for each in errors]).mean())
