"""The search for what is missing: propose, fit together, test on blocks left out, look again at what was found."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import CATALOGUE, Effect
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight import Flight, prepare_flight
from cfb_mjx.sysid.tracing import columns as cols
from cfb_mjx.sysid.tracing.columns import LEAD, Column
from cfb_mjx.sysid.tracing.evidence import Evidence, covariance, evidence, solve
from cfb_mjx.sysid.tracing.gram import driven_by, gram, residual_blocks
from cfb_mjx.sysid.tracing.noise import sensor_noise
from cfb_mjx.sysid.tracing.sensors import SensorCheck
from cfb_mjx.sysid.tracing.whitening import FIRST, Blocks, fit_levels, levels_from

LEAD_RANGE = (0.0, 0.6)
"""Share of the next command in the mean over an interval: half at most, if commands not logged came right behind."""
PAD = 8
"""Columns are padded to a multiple of this with copies of the lead, so that one compiled program serves all rounds."""


@dataclass(frozen=True)
class Hypothesis:
    """A model: which effects are there, and the values of all."""

    effects: tuple[Effect, ...]
    present: tuple[str, ...] = ()
    lead: float = 0.0

    def effect(self, name: str) -> Effect:
        """The effect of that name."""
        return next(e for e in self.effects if type(e).name == name)

    def model(self, parameters: Parameters) -> Quadrotor:
        """The drone of this hypothesis, with every effect of the catalogue (most of them neutral)."""
        return Quadrotor(parameters, self.effects)

    def without(self, name: str) -> Hypothesis:
        """The same with one effect back at neutral."""
        effects = tuple(CATALOGUE[name].neutral() if type(e).name == name else e for e in self.effects)
        return Hypothesis(effects, tuple(p for p in self.present if p != name), self.lead)


@dataclass
class Linear:
    """A hypothesis with its residual and derivatives, as inner products."""

    hypothesis: Hypothesis
    columns: list[Column]
    blocks: np.ndarray
    """(b, d, c, c)."""
    scale: np.ndarray

    def index(self, wanted: list[Column]) -> list[int]:
        """Positions of columns in the inner products."""
        where = {c: i + 1 for i, c in reversed(list(enumerate(self.columns)))}
        return [where[c] for c in wanted]

    @property
    def pooled(self) -> np.ndarray:
        """(b, c, c) over all domains."""
        return self.blocks.sum(1)


@dataclass
class Search:
    """One campaign under search."""

    parameters: Parameters
    flights: list[Flight]
    logs: list[FlightLog]
    noise: dict[str, np.ndarray]
    names: tuple[str, ...]
    levels: np.ndarray = field(default_factory=lambda: FIRST.copy())

    @classmethod
    def start(cls, logs: list[FlightLog], parameters: Parameters, delay: float, sensors: SensorCheck) -> Search:
        """Prepare flights, with what is known of their sensors taken out, for a search over the whole catalogue."""
        logs = [sensors.corrected(log) for log in logs]
        flights = [prepare_flight(log, delay) for log in logs]
        return cls(parameters, flights, logs, sensor_noise(logs), tuple(CATALOGUE))

    def nothing(self) -> Hypothesis:
        """The declared model."""
        return Hypothesis(cols.neutral_effects(self.names))

    def learn_levels(self, hypothesis: Hypothesis) -> None:
        """Noise levels that fit what this hypothesis leaves."""
        model = hypothesis.model(self.parameters)
        pieces = []
        for flight in self.flights:
            driven = driven_by(model, flight, hypothesis.lead)
            pieces.append(residual_blocks(model, flight, driven, jnp.asarray(hypothesis.lead)))
        blocks = Blocks(*(_joined([getattr(p, k) for p in pieces]) for k in ("signals", "interval", "valid")))
        self.levels = fit_levels(_padded(blocks), self.noise, self.levels)

    def linearise(self, hypothesis: Hypothesis, wanted: list[Column]) -> Linear:
        """Residual and derivatives by ``wanted`` at a hypothesis."""
        lead = Column(LEAD, LEAD, None, (), 0.25)
        columns = [lead, *wanted]
        padded = columns + [lead] * (-(len(columns) + 1) % PAD)
        effects, steps = cols.stacked(hypothesis.effects, padded, set(hypothesis.present))
        leads = hypothesis.lead + np.array(
            [0.0] + [s if c.effect == LEAD else 0.0 for c, s in zip(padded, steps, strict=True)]
        )
        model = hypothesis.model(self.parameters)
        models = eqx.tree_at(lambda m: m.effects, model, effects)
        levels = levels_from(jnp.asarray(self.levels), self.noise)
        found = []
        for flight in self.flights:
            driven = driven_by(model, flight, hypothesis.lead)
            products, _ = gram(models, flight, driven, jnp.asarray(leads), jnp.asarray(steps), levels)
            found.append(np.asarray(products))
        scale = np.array([1.0] + [c.scale for c in padded])
        return Linear(hypothesis, columns, np.concatenate(found), scale)


    # -- one hypothesis -------------------------------------------------------------------------------------------

    def candidates(self) -> list[list[Column]]:
        """Columns of every effect and probe."""
        return [variant for name in self.names for variant in cols.strengths(name)]

    def own_columns(self, hypothesis: Hypothesis) -> list[Column]:
        """Columns of what is there: strengths and shapes."""
        found = []
        for name in hypothesis.present:
            found += cols.strengths(name)[0] + cols.shapes(hypothesis.effect(name))
        return [replace(c, probe=()) for c in found]

    def refine(self, hypothesis: Hypothesis, rounds: int = 5) -> tuple[Hypothesis, Linear]:
        """Fit everything that is there together; derivatives by the whole catalogue come with the result."""
        for attempt in range(rounds):
            own = self.own_columns(hypothesis)
            absent = [c for v in self.candidates() if v[0].effect not in hypothesis.present for c in v]
            linear = self.linearise(hypothesis, own + absent)
            if attempt == rounds - 1:
                break
            index = [1, *linear.index(own)]
            values = solve(linear.pooled.sum(0), index, linear.scale)
            deviation = np.sqrt(np.diag(covariance(linear.pooled, index, linear.scale, values)))
            if np.max(np.abs(values) / deviation) < 0.3:
                break
            hypothesis = self._moved(hypothesis, own, values * linear.scale[index])
            if attempt == 0:
                self.learn_levels(hypothesis)
        return hypothesis, linear

    def _moved(self, hypothesis: Hypothesis, own: list[Column], by: np.ndarray) -> Hypothesis:
        effects = {type(e).name: e for e in hypothesis.effects}
        for column, change in zip(own, by[1:], strict=True):
            low, high = CATALOGUE[column.effect].prior[column.field]
            effect = cols.moved(effects[column.effect], column, float(change), True)
            value = np.asarray(getattr(effect, column.field))
            if column.field in CATALOGUE[column.effect].strengths:
                # A strength may exceed what is plausible (the report will say so), but not change a meaningless sign.
                low, high = (0.0 if low >= 0 else 3 * low), 3 * high
            value = np.clip(value, low, high)
            effects[column.effect] = eqx.tree_at(
                lambda e, f=column.field: getattr(e, f), effect, jnp.asarray(value)
            )
        lead = float(np.clip(hypothesis.lead + by[0], *LEAD_RANGE))
        return Hypothesis(tuple(effects[type(e).name] for e in hypothesis.effects), hypothesis.present, lead)

    def adding(self, hypothesis: Hypothesis, linear: Linear, variant: list[Column]) -> Evidence | None:
        """Evidence for a candidate beside what is there; None where its sign makes no sense."""
        base = [1, *linear.index(self.own_columns(hypothesis))]
        found = evidence(linear.pooled, base, linear.index(variant), linear.scale)
        low = CATALOGUE[variant[0].effect].prior[variant[0].field][0]
        return None if low >= 0 and np.any(found.values < 0) else found

    def with_candidate(self, hypothesis: Hypothesis, variant: list[Column], found: Evidence) -> Hypothesis:
        """The hypothesis with a candidate at the values the linear fit gives it."""
        name = variant[0].effect
        effect = CATALOGUE[name].neutral()
        for column, value in zip(variant, found.values, strict=True):
            effect = cols.moved(effect, column, float(value) * column.scale, False)
        effects = tuple(effect if type(e).name == name else e for e in hypothesis.effects)
        return Hypothesis(effects, (*hypothesis.present, name), hypothesis.lead)

    def removing(self, hypothesis: Hypothesis, name: str) -> Evidence:
        """Evidence for one effect that is there, beside the others."""
        less = hypothesis.without(name)
        own = self.own_columns(less)
        variant = self._variant_of(hypothesis, name)
        linear = self.linearise(less, own + variant)
        return evidence(linear.pooled, [1, *linear.index(own)], linear.index(variant), linear.scale)

    def _variant_of(self, hypothesis: Hypothesis, name: str) -> list[Column]:
        """Columns of an effect's strengths at the shape it has."""
        effect = hypothesis.effect(name)
        probe = {c.field: float(np.asarray(getattr(effect, c.field))) for c in cols.shapes(effect)}
        return cols.columns_of(name, CATALOGUE[name].strengths, probe)


def _joined(parts):
    import jax

    return jax.tree.map(lambda *x: np.concatenate([np.asarray(y) for y in x]), *parts)


def _padded(blocks: Blocks) -> Blocks:
    import jax

    count = len(blocks.interval)
    wanted = next(n for n in (32, 48, 64, 96, 128, 192, 256, 512, 1024, 4096) if n >= count)
    more = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[:1], wanted - count, axis=0)]), blocks)
    valid = more.valid.copy()
    valid[count:] = 0.0
    return Blocks(more.signals, more.interval, valid)
