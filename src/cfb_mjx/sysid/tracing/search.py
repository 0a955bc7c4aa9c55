"""State and elementary operations of the search for missing effects.

A `Search` holds the flights, the sensors' noise and the names of the effects to look for. Its methods replay a
`Hypothesis` along the flights, linearise the whitened residual, fit the parameters of the effects that are present
(Gauss-Newton) and score each absent effect by cross-validation. `trace` decides which effect to add or to remove.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import CATALOGUE, Effect
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight import ROWS, Flight, prepare_flight
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.tracing.evidence import Evidence, Prior, covariance, dealt, evidence, solve
from cfb_mjx.sysid.tracing.hypothesis import (
    FORMULA,
    LEAD_RANGE,
    LEAD_SPREAD,
    LEAD_USUAL,
    SHIFT,
    Column,
    Hypothesis,
    Linear,
    bounds,
    coarse,
    lead_column,
    moved,
    moves,
    neutral_effects,
    sensible,
    shapes,
    shift_column,
    strengths,
    term_columns,
)
from cfb_mjx.sysid.tracing.innovations import (
    CHANNELS,
    DOMAINS,
    Levels,
    fit_levels,
    inner_products,
    levels_from,
    sensor_noise,
    surprise,
)
from cfb_mjx.sysid.tracing.rules import RULES, Rules
from cfb_mjx.sysid.tracing.sensors import SensorCheck
from cfb_mjx.sysid.tracing.signals import (
    Blocks,
    Piece,
    Signals,
    cut,
    driven_by,
    joined,
    residual_blocks,
    term_slopes,
    term_squares,
    with_slopes,
)

STILL = 0.3
"""A fit has converged when every step is below this fraction of a standard deviation."""
GUESSED = 2
"""Number of first iterations in which the shape parameters of coarse effects (`Effect.coarse`) stay fixed.

Their strength is a rough guess at first, because the derivative at zero strength says little about it.
"""
SAME_LEVELS = 0.5
"""A fit is not repeated if no noise level changed by more than this (difference of logarithms)."""
FILTERED_GYRO = 0.1
"""Noise level assumed for a low-pass filtered gyro, rad/s. Only its low frequencies are trusted."""
SAMPLE = 32
"""Number of blocks from which noise levels are estimated: about a minute, far longer than the disturbances'
correlation time."""
KNOWN = 2
"""Number of hypotheses whose residuals are cached, and of time shifts whose flights are."""


@dataclass
class Search:
    """The search on the flights of one campaign.

    Attributes:
        parameters: the declared drone.
        logs: flights, corrected for sensor faults and biases.
        delay: age of pose and velocity in a row, s.
        noise: white noise of each sensor, from `sensor_noise`.
        names: effects to look for.
        declared: effects that the declared model already has.
        rules: thresholds.
        rotors_only: use rotor speeds only and ignore the motion of the body.
    """

    parameters: Parameters
    logs: list[FlightLog]
    delay: float
    noise: dict[str, np.ndarray]
    names: tuple[str, ...]
    declared: tuple[Effect, ...] = ()
    rules: Rules = RULES
    rotors_only: bool = False
    _flights: dict[float, list[Flight]] = field(default_factory=dict)
    _known: list[tuple[Hypothesis, list]] = field(default_factory=list, init=False)
    """Cache of `residuals`, newest first; not copied by `dataclasses.replace`."""

    @classmethod
    def start(
        cls,
        logs: list[FlightLog],
        parameters: Parameters,
        delay: float,
        sensors: SensorCheck,
        declared: tuple[Effect, ...] = (),
        named: Sequence[str] = (),
        rules: Rules = RULES,
    ) -> Search:
        """Create a search over the catalogue.

        Args:
            logs: flights as recorded; the faults and biases found by ``sensors`` are removed.
            parameters: the declared drone.
            delay: age of pose and velocity in a row, s.
            sensors: result of `check_sensors` on the same flights.
            declared: effects that the declared model already has.
            named: effects to look for even if they are excluded from searches (`Effect.searched`). Declared effects
                always take part.
            rules: thresholds.
        """
        logs = [sensors.corrected(log) for log in logs]
        noise = sensor_noise(logs, FILTERED_GYRO if sensors.faults.gyro_lag else 1e-3)
        asked_for = {*named, *(type(effect).name for effect in declared)}
        looked_for = tuple(
            name for name, kind in CATALOGUE.items() if name in asked_for or (kind.searched and _shown_by(logs, kind))
        )
        return cls(parameters, logs, delay, noise, looked_for, declared, rules)

    @property
    def delays(self) -> tuple[float, float]:
        """Age of the pose and of the gyro reading in a row, s."""
        return self.delay, float(self.parameters.gyro_delay)

    def flights(self, hypothesis: Hypothesis) -> list[Flight]:
        """The prepared flights, with the time shift of the motor columns that the hypothesis assumes removed."""
        key = round(hypothesis.shift, 5)
        found = self._flights.pop(key, None)
        if found is None:
            faults = SensorFaults(motor_shift=key)
            found = [prepare_flight(faults.repaired(log), *self.delays) for log in self.logs]
        # A fit of the shift asks for many of them in turn; the ones asked for last are kept.
        self._flights[key] = found
        for old in list(self._flights)[:-KNOWN]:
            del self._flights[old]
        return found

    def residuals(
        self, hypothesis: Hypothesis, flights: Sequence[Flight] | None = None
    ) -> list[tuple[Blocks, np.ndarray]]:
        """Compute the residual blocks of each flight and the rotor speeds (n, 4), rad/s, that drove the body.

        Args:
            hypothesis: model to replay.
            flights: flights to replay; by default those of the search, whose result is cached.
        """
        if flights is None:
            # Several hypotheses in turn are compared with the same one, so its residuals are reused.
            kept = self._kept(hypothesis)
            if kept is not None:
                self._keep(hypothesis, kept)
                return kept
        model = hypothesis.model(self.parameters)
        own = self.flights(hypothesis) if flights is None else flights
        driven = driven_by(model, own, hypothesis.lead)
        blocks = map(self._looked_at, residual_blocks(model, own, driven, hypothesis.lead))
        found = list(zip(blocks, driven, strict=True))
        if flights is None:
            self._keep(hypothesis, found)
        return found

    def _kept(self, hypothesis: Hypothesis) -> list[tuple[Blocks, np.ndarray]] | None:
        return next((found for known, found in self._known if _alike(known, hypothesis)), None)

    def _keep(self, hypothesis: Hypothesis, found: list[tuple[Blocks, np.ndarray]]) -> None:
        others = [pair for pair in self._known if not _alike(pair[0], hypothesis)]
        self._known = [(hypothesis, found), *others[: KNOWN - 1]]

    def beside(self, logs: list[FlightLog], sensors: SensorCheck) -> Search:
        """The same search on other flights of the drone, corrected by ``sensors``."""
        return replace(self, logs=[sensors.corrected(log) for log in logs], _flights={})

    def nothing(self) -> Hypothesis:
        """The hypothesis that adds nothing: the declared model."""
        given = {type(e).name: e for e in self.declared}
        effects = tuple(given.get(type(e).name, e) for e in neutral_effects(self.names))
        return Hypothesis(effects, origin=effects)

    def learned(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis with the maximum-likelihood noise levels of its residuals."""
        blocks = joined(blocks for blocks, _ in self.residuals(hypothesis))
        return replace(hypothesis, levels=fit_levels(_sample(blocks), self.noise, hypothesis.levels))

    def surprise(self, hypothesis: Hypothesis) -> float:
        """Negative log-likelihood of a hypothesis's residuals at its noise levels, nats, on the blocks of `learned`."""
        blocks = joined(blocks for blocks, _ in self.residuals(hypothesis))
        return float(surprise(jnp.asarray(hypothesis.levels), self.noise, _sample(blocks))[0])

    def linearise(self, hypothesis: Hypothesis, wanted: list[Column]) -> Linear:
        """Linearise the residual at a hypothesis, with respect to the command lead and the ``wanted`` columns."""
        columns = [lead_column(), *wanted]
        blocks = map(self._blocks, self._slopes(hypothesis, columns))
        return self._linear(hypothesis, columns, inner_products(blocks, self._levels(hypothesis)))

    def linearise_terms(self, hypothesis: Hypothesis, own: list[Column]) -> list[Linear]:
        """`linearise` with respect to ``own`` and the library of formula terms, for each axis of `formula.AXES`."""
        model, driven = hypothesis.model(self.parameters), self._driven(hypothesis)
        flights, columns = self.flights(hypothesis), [lead_column(), *own]
        squares = [term_squares(model, *pair) for pair in zip(flights, driven, strict=True)]
        sizes = np.sqrt(np.mean(squares, axis=0))
        counts = []

        def blocks() -> Iterator[Blocks]:
            for piece in self._slopes(hypothesis, columns, driven):
                for axis in range(6):
                    found = self._blocks(_beside(piece, term_slopes(model, piece, axis)))
                    counts.append(len(found.interval))
                    yield found

        products = inner_products(blocks(), self._levels(hypothesis))
        parts = np.split(products, np.cumsum(counts)[:-1])
        every = [(columns + term_columns(axis, sizes), np.concatenate(parts[axis::6])) for axis in range(6)]
        return [self._linear(hypothesis, *pair) for pair in every]

    def _driven(self, hypothesis: Hypothesis) -> list[np.ndarray]:
        kept = self._kept(hypothesis)
        if kept is not None:
            return [driven for _, driven in kept]
        return driven_by(hypothesis.model(self.parameters), self.flights(hypothesis), hypothesis.lead)

    def _blocks(self, piece: Piece) -> Blocks:
        return self._looked_at(cut(piece.flight, not_none(piece.signals)))

    def _levels(self, hypothesis: Hypothesis) -> Levels:
        return levels_from(jnp.asarray(hypothesis.levels), self.noise)

    def _linear(self, hypothesis: Hypothesis, columns: list[Column], products: np.ndarray) -> Linear:
        counts = [len(flight.time) // ROWS for flight in self.flights(hypothesis)]
        return Linear(columns, products, dealt(counts))

    def _looked_at(self, blocks: Blocks) -> Blocks:
        """The blocks with the channels that this search ignores marked as invalid."""
        if not self.rotors_only:
            return blocks
        return replace(blocks, valid=blocks.valid * np.isin(np.arange(CHANNELS), DOMAINS["rotor_speed"]))

    def _slopes(
        self, hypothesis: Hypothesis, columns: list[Column], driven: list[np.ndarray] | None = None
    ) -> Iterator[Piece]:
        """Residual and its derivatives with respect to ``columns``, for every flight or piece of a long one."""
        changes = moves(hypothesis.effects, hypothesis.lead, columns, set(hypothesis.present))
        driven = self._driven(hypothesis) if driven is None else driven
        model, flights = hypothesis.model(self.parameters), self.flights(hypothesis)
        return with_slopes(model, hypothesis.lead, changes, flights, driven)

    # -- one hypothesis -------------------------------------------------------------------------------------------

    def stands(self, found: Evidence) -> bool:
        """Whether evidence for an effect is significant, corrected for the number of effects in the search."""
        return self.rules.significant(found, len(self.names))

    def candidates(self, hypothesis: Hypothesis) -> list[list[Column]]:
        """Strength columns of every absent effect, one list per probe of its shape."""
        there = hypothesis.present
        absent = [name for name in self.names if name not in there]
        shift = [] if SHIFT in there else [[shift_column()]]
        return shift + [variant for name in absent for variant in strengths(name, there)]

    def own_columns(self, hypothesis: Hypothesis, guessed: bool = False) -> list[Column]:
        """Columns of the effects that are present: their strengths and shapes, and the terms of a formula.

        Args:
            hypothesis: model whose columns to list.
            guessed: the strengths may still be rough guesses; leave out the shapes of coarse effects.
        """
        found = []
        for name in hypothesis.present:
            if name == SHIFT:
                found.append(shift_column())
                continue
            found += strengths(name, hypothesis.present)[0]
            if not (guessed and coarse(name)):
                found += shapes(hypothesis.effect(name), hypothesis.present)
        return [replace(c, probe=()) for c in found] + list(hypothesis.terms)

    def whole(self, hypothesis: Hypothesis) -> Linear:
        """Linearise with respect to the effects that are present and to all absent effects of the catalogue."""
        absent = [c for variant in self.candidates(hypothesis) for c in variant]
        return self.linearise(hypothesis, self.own_columns(hypothesis) + absent)

    def refine(self, hypothesis: Hypothesis, rounds: int = 5) -> tuple[Hypothesis, Linear]:
        """Fit all present effects together; return the hypothesis and its linearisation by the whole catalogue."""
        hypothesis = self.settled(hypothesis, rounds)
        return hypothesis, self.whole(hypothesis)

    def settled(
        self, hypothesis: Hypothesis, rounds: int = 5, lead_free: bool = True, shrunk: bool = False
    ) -> Hypothesis:
        """Fit the parameters of all present effects together, by Gauss-Newton.

        Args:
            hypothesis: where to start.
            rounds: maximum number of iterations plus one.
            lead_free: fit the command lead too; otherwise it is kept.
            shrunk: add a normal prior centred on the declared values, with half the prior range as its standard
                deviation. It keeps collinear effects from diverging.
        """
        for attempt in range(rounds - 1):
            # While a strength is far from its optimum, the fit would distort the shape to make up for it.
            own = self.own_columns(hypothesis, guessed=attempt < GUESSED)
            linear = self.linearise(hypothesis, own)
            index = [1, *linear.index(own)]
            lead = linear.scale[1]
            known = Prior.weak(1) + (self.prior(hypothesis, own) if shrunk else Prior.weak(len(own)))
            prior = known.pulled(0, (LEAD_USUAL - hypothesis.lead) / lead, (lead / LEAD_SPREAD) ** 2)
            values = solve(linear.blocks.sum(0), index, linear.scale, prior)
            kept = np.clip(hypothesis.lead + lead_free * values[0] * lead, *LEAD_RANGE)
            if kept != hypothesis.lead + values[0] * lead:
                # The lead is at its bound: solve again with the lead fixed there.
                fixed = known.pulled(0, (kept - hypothesis.lead) / lead, 1e9)
                values = solve(linear.blocks.sum(0), index, linear.scale, fixed)
            deviation = np.sqrt(np.diag(covariance(linear.blocks, index, linear.scale, values, prior)))
            still = np.max(np.abs(values) / deviation) < STILL and own == self.own_columns(hypothesis)
            if attempt and still:
                break
            hypothesis = self.moved(hypothesis, own, values * linear.scale[index])
            if attempt == 0:
                # The noise levels come from a poorer model, so estimate them again even if the values are unchanged.
                before, hypothesis = hypothesis.levels, self.learned(hypothesis)
                if still and np.max(np.abs(hypothesis.levels - before)) < SAME_LEVELS:
                    break
        return hypothesis

    def prior(self, hypothesis: Hypothesis, columns: list[Column]) -> Prior:
        """Prior for a step of ``columns``: normal about the declared values, with half the prior range as deviation."""
        away = []
        for column in columns:
            if column.effect == SHIFT:
                away.append(-hypothesis.shift / column.scale)
                continue
            here, there = (
                np.asarray(getattr(effect, column.field))[... if column.index is None else column.index]
                for effect in (hypothesis.effect(column.effect), hypothesis.declared(column.effect))
            )
            away.append(float(there - here) / column.scale)
        return Prior(np.array(away), np.ones(len(columns)))

    def moved(self, hypothesis: Hypothesis, own: list[Column], by: np.ndarray) -> Hypothesis:
        """Apply a step to a hypothesis, clipped to the bounds.

        Args:
            hypothesis: before the step.
            own: columns to move.
            by: (1 + len(own),) change of the command lead, then of each column, in the parameters' units.
        """
        effects = {type(e).name: e for e in hypothesis.effects}
        shift = hypothesis.shift
        for column, change in zip(own, by[1:], strict=True):
            if column.effect == SHIFT:
                shift = float(np.clip(shift + change, -0.05, 0.05))
                continue
            if column.effect == FORMULA:
                effects[column.effect] = moved(effects[column.effect], column, float(change), True)
                continue
            effect = moved(effects[column.effect], column, float(change), True)
            value = np.clip(getattr(effect, column.field), *bounds(column.effect, column.field))
            effects[column.effect] = eqx.tree_at(lambda e, f=column.field: getattr(e, f), effect, jnp.asarray(value))
        lead = float(np.clip(hypothesis.lead + by[0], *LEAD_RANGE))
        found = tuple(effects[type(e).name] for e in hypothesis.effects)
        return replace(hypothesis, effects=found, lead=lead, shift=shift)

    def adding(self, hypothesis: Hypothesis, linear: Linear, variant: list[Column]) -> Evidence | None:
        """Evidence for adding a candidate to a hypothesis; None if a fitted strength has a meaningless sign."""
        # The lead is not free here: it would absorb delayed commands.
        base = linear.index(self.own_columns(hypothesis))
        found = evidence(linear.blocks, base, linear.index(variant), linear.scale, fold=linear.fold)
        return found if sensible(variant, found.values) else None

    def probes(self, hypothesis: Hypothesis, linear: Linear) -> dict[str, tuple[Evidence, list[Column]]]:
        """Evidence for every absent effect with a meaningful sign, at the probe of its shape with the largest gain."""
        best: dict[str, tuple[Evidence, list[Column]]] = {}
        for variant in self.candidates(hypothesis):
            name = variant[0].effect
            found = self.adding(hypothesis, linear, variant)
            if found is not None and (name not in best or found.gain > best[name][0].gain):
                best[name] = (found, variant)
        return best

    def with_candidate(self, hypothesis: Hypothesis, variant: list[Column], found: Evidence) -> Hypothesis:
        """The hypothesis with a candidate effect added, at the values of the linear fit ``found``."""
        name = variant[0].effect
        if name == SHIFT:
            shift = hypothesis.shift + float(found.values[0]) * variant[0].scale
            return replace(hypothesis, present=(*hypothesis.present, name), shift=shift)
        effect = hypothesis.effect(name)
        for column, value in zip(variant, found.values, strict=True):
            effect = moved(effect, column, float(value) * column.scale, False)
        return hypothesis.having(effect)


def _beside(piece: Piece, more: Signals) -> Piece:
    """A piece with more columns."""
    pairs = zip(not_none(piece.signals), more, strict=True)
    return piece._replace(signals=Signals(*(np.concatenate(pair, axis=-1) for pair in pairs)))


def _alike(a: Hypothesis, b: Hypothesis) -> bool:
    """Whether two hypotheses have the same residuals; noise levels may differ."""
    return a.effects is b.effects and (a.lead, a.shift) == (b.lead, b.shift)


def _sample(blocks: Blocks) -> Blocks:
    """`SAMPLE` of the valid blocks, evenly spread. The fixed number lets one compiled program serve every campaign."""
    share = np.asarray(blocks.valid).max(axis=2).mean(axis=1)
    good = np.flatnonzero(share > 0.5 * share.max())
    chosen = good[np.linspace(0, len(good) - 1, SAMPLE).round().astype(int)]
    picked = jax.tree.map(lambda x: x[chosen], blocks)
    # If there are fewer blocks than that, each counts once.
    first = np.concatenate([[True], np.diff(chosen) > 0])
    return Blocks(picked.signals, picked.interval, picked.valid * first[:, None, None])


def _shown_by(logs: Sequence[FlightLog], kind: type[Effect]) -> bool:
    """Whether a log has what an effect needs."""
    return kind.needs is None or any(getattr(log, kind.needs) is not None for log in logs)
