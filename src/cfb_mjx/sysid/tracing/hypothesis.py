"""What a search may believe of a drone: the numbers it may change, and what a small change of each would explain.

Strengths and shapes of every effect of the catalogue are one column each.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.model.effects import KNOWN, Effect
from cfb_mjx.model.effects.catalogue import COMMAND_LEAD
from cfb_mjx.model.effects.formula import PLACES, TERMS, ResidualFormula
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.tracing.innovations import FIRST, Moved

LEAD = COMMAND_LEAD
"""Nuisance: commands sent between two rows are not in the log. Always free, never reported as an effect."""
SHIFT = "sensor_time_shift"
"""Not an effect of the catalogue but a fault of the recording: command and rotor-speed columns late or early."""
FORMULA = ResidualFormula.name
TORQUE_UNIT, FORCE_UNIT = 3e-5, 4e-3
"""What a term of a formula typically adds, N m and N: about 1 rad/s^2 and 0.1 m/s^2 on this drone."""
LEAST_SIZE = 1e-4
"""Signals smaller than this, in their units, were not excited."""


@dataclass(frozen=True)
class Column:
    """One number: a component of a field of an effect, with other fields at a probe's values."""

    effect: str
    field: str
    index: int | tuple[int, int] | None
    probe: tuple[tuple[str, float], ...] = ()
    scale: float = dataclasses.field(default=1.0, compare=False)
    """Half the prior range: the unit in which the search counts."""


def neutral_effects(names: tuple[str, ...]) -> tuple[Effect, ...]:
    """The named effects of the catalogue where they vanish."""
    return tuple(KNOWN[name].neutral() for name in names)


def columns_of(name: str, fields: tuple[str, ...], probe: dict[str, float]) -> list[Column]:
    """Columns of some fields of an effect."""
    kind = KNOWN[name]
    neutral = kind.neutral()
    found = []
    for item in fields:
        low, high = kind.prior[item]
        value = np.asarray(getattr(neutral, item))
        for index in range(value.size) if value.ndim else [None]:
            found.append(Column(name, item, index, tuple(probe.items()), (high - low) / 2))
    return found


def strengths(name: str, others: Collection[str] = ()) -> list[list[Column]]:
    """Columns of an effect's strengths, one list for each probe of its shape; without what ``others`` say as well."""
    kind = KNOWN[name]
    own = tuple(f for f in kind.strengths if kind.said_by.get(f) not in others)
    return [columns_of(name, own, probe) for probe in kind.probes]


def shapes(effect: Effect, others: Collection[str] = ()) -> list[Column]:
    """Columns of what describes the shape of an effect that is there: fitted once its strength is known.

    What no flight tells (`Effect.assumed`) is left as it is, and so is what ``others`` say as well.
    """
    kind = type(effect)
    moving = {key for probe in kind.probes for key in probe} - set(kind.assumed)
    own = tuple(f for f in kind.prior if f in moving and kind.said_by.get(f) not in others)
    return columns_of(kind.name, own, {})


def bounds(name: str, item: str) -> tuple[float, float]:
    """Between which values a search moves a field of an effect."""
    kind = KNOWN[name]
    low, high = kind.prior[item]
    if item in kind.strengths:
        # A strength may exceed what is plausible (the report will say so), but not change a meaningless sign.
        low, high = (0.0 if low >= 0 else 3 * low), 3 * high
    if item not in kind.limits:  # of a user's own effect
        return low, high
    # Downwards what is unusual is out of reach as well: a lag or a gain of next to nothing is no motor.
    return max(low, kind.limits[item].soft_low), min(high, kind.limits[item].hard_high)


def sensible(variant: list[Column], values: np.ndarray) -> bool:
    """Whether strengths have a sign that makes sense."""
    if variant[0].effect == SHIFT:
        return True
    low = KNOWN[variant[0].effect].prior[variant[0].field][0]
    return low < 0 or bool(np.all(values >= 0))


def coarse(name: str) -> bool:
    """Whether an effect's slope at zero says little of its strength."""
    return name in KNOWN and bool(KNOWN[name].coarse)


def step_of(column: Column, present: bool) -> float:
    """Step of the finite difference by which a column is found."""
    share = 0.02 if present else _shares(column.effect).get(column.probe, 0.05)
    # A step towards positive values: where zero is the lowest value possible there is nothing on the other side.
    return share * 2 * column.scale


def _shares(name: str) -> dict[tuple[tuple[str, float], ...], float]:
    """Shares of the prior range at which an effect is looked for, by probe, where its slope at zero says little."""
    kind = KNOWN.get(name)
    return {} if kind is None else {tuple(kind.probes[i].items()): share for i, share in kind.coarse.items()}


def moved(effect: Effect, column: Column, by: float, present: bool) -> Effect:
    """The effect with one number changed, and at the column's probe if it is not there yet."""
    if not present:
        for key, value in column.probe:
            effect = eqx.tree_at(lambda e, k=key: getattr(e, k), effect, jnp.full_like(getattr(effect, key), value))
    old = getattr(effect, column.field)
    new = old + by if column.index is None else old.at[column.index].add(by)
    return eqx.tree_at(lambda e: getattr(e, column.field), effect, new)


def term_columns(axis: int, sizes: np.ndarray | None = None) -> list[Column]:
    """Every term of the library along one of the axes torque x, y, z, force x, y, z (0..5).

    ``sizes`` are the rms of the signals, body terms then places: a number is counted in what makes its term matter.
    """
    sizes = np.ones(len(TERMS) + len(PLACES)) if sizes is None else np.maximum(sizes, LEAST_SIZE)
    scale = (TORQUE_UNIT if axis < 3 else FORCE_UNIT) / sizes
    found = [Column(FORMULA, "body_terms", (axis, j), (), scale[j]) for j in range(len(TERMS))]
    if axis >= 3:
        found += [Column(FORMULA, "place", (axis - 3, j), (), scale[len(TERMS) + j]) for j in range(len(PLACES))]
    return found


def lead_column() -> Column:
    """The column of `LEAD`, a share of an interval."""
    return Column(LEAD, LEAD, None, (), 0.25)


def shift_column() -> Column:
    """The column of `SHIFT`, in units of 10 ms."""
    return Column(SHIFT, "shift", None, (), 0.01)


def moves(effects: tuple[Effect, ...], lead: float, columns: list[Column], present: set[str]) -> list[Moved]:
    """The model with each of some columns moved, for finite differences."""
    order = {type(effect).name: i for i, effect in enumerate(effects)}
    # NumPy's arrays are stacked ten times as fast as jax's.
    still = jax.tree.map(np.asarray, effects)
    found = []
    for column in columns:
        if column.effect == LEAD:
            found.append(Moved(still, lead + LEAD_STEP, 0.0, LEAD_STEP))
        elif column.effect == SHIFT:
            found.append(Moved(still, lead, SHIFT_STEP, SHIFT_STEP))
        else:
            at, here = order[column.effect], column.effect in present
            step = step_of(column, here)
            own = jax.tree.map(np.asarray, moved(effects[at], column, step, here))
            found.append(Moved((*still[:at], own, *still[at + 1 :]), lead, 0.0, step))
    return found


LEAD_STEP, SHIFT_STEP = 0.05, 0.002
"""Moves of the two nuisances: a share of an interval, and s."""
LEAD_RANGE, LEAD_USUAL, LEAD_SPREAD = (0.0, 0.5), 0.25, 0.1
"""Share of the next command in the mean over an interval: a quarter if every second command is logged, half at most.
Beyond this a lead would be a time shift, so what is known of it beforehand has to decide between the two."""


@dataclass(frozen=True)
class Hypothesis:
    """A model: which effects are there, and the values of all."""

    effects: tuple[Effect, ...]
    present: tuple[str, ...] = ()
    lead: float = LEAD_USUAL
    shift: float = 0.0
    """How late the motor columns are, s."""
    terms: tuple[Column, ...] = ()
    """Of a formula, where the catalogue has failed."""
    origin: tuple[Effect, ...] = ()
    """The effects of the declared model: what an absent effect goes back to."""
    levels: np.ndarray = field(default_factory=lambda: FIRST, compare=False)
    """Noise levels that fit what this hypothesis leaves (the vector of `innovations.levels_from`)."""

    def effect(self, name: str) -> Effect:
        """The effect of that name."""
        return next(e for e in self.effects if type(e).name == name)

    def declared(self, name: str) -> Effect:
        """The effect of that name as the declared model has it: neutral, where it has none."""
        return next(e for e in self.origin if type(e).name == name)

    def model(self, parameters: Parameters) -> Quadrotor:
        """The drone of this hypothesis, with every effect of the catalogue (most of them neutral)."""
        return Quadrotor(parameters, self.effects)

    @property
    def faults(self) -> SensorFaults:
        """What is wrong with the recording beyond what the sensors say of each other."""
        return SensorFaults(motor_shift=self.shift)

    def having(self, effect: Effect) -> Hypothesis:
        """The same with an effect that was absent; what of the others it says as well is as declared again."""
        name = type(effect).name
        present = (*self.present, name)
        effects = (effect if type(e).name == name else e for e in self.effects)
        pairs = zip(effects, self.origin, strict=True)
        return replace(self, effects=tuple(_unsaid(e, declared, present) for e, declared in pairs), present=present)

    def without(self, name: str) -> Hypothesis:
        """The same with one effect back at neutral."""
        pairs = zip(self.effects, self.origin, strict=True)
        effects = tuple(declared if type(e).name == name else e for e, declared in pairs)
        shift = 0.0 if name == SHIFT else self.shift
        return replace(self, effects=effects, present=tuple(p for p in self.present if p != name), shift=shift)


def _unsaid(effect: Effect, declared: Effect, others: Collection[str]) -> Effect:
    """The effect with what others say as well as it is declared."""
    for item, by in effect.said_by.items():
        if by in others:
            effect = eqx.tree_at(lambda e, f=item: getattr(e, f), effect, getattr(declared, item))
    return effect


@dataclass
class Linear:
    """A residual and its derivatives at a hypothesis, as inner products.

    Attributes:
        columns: one fewer than c: the residual itself comes first. Of columns that occur twice the first counts.
        blocks: (b, c, c).
        fold: (b,) of each block (`evidence.dealt`); None where all are of one flight.
        scale: (c,) unit of each.
    """

    columns: list[Column]
    blocks: np.ndarray
    fold: np.ndarray | None = None
    scale: np.ndarray = field(init=False)

    def __post_init__(self):
        self.scale = np.array([1.0] + [c.scale for c in self.columns])

    def index(self, wanted: list[Column]) -> list[int]:
        """Positions of columns in the inner products."""
        where = {c: i + 1 for i, c in reversed(list(enumerate(self.columns)))}
        return [where[c] for c in wanted]


@dataclass(frozen=True)
class Fit:
    """A hypothesis fitted to the flights.

    Attributes:
        hypothesis: with the values that fit.
        linear: its derivatives by the whole catalogue; None for one among many, which may not be taken.
        errors: (8,) `fits.ERRORS` over all flights.
        by_flight: (L, 8) `fits.ERRORS` in each flight that has prediction windows.
        beside_hold: `fits.beside_hold` of its predictions.
    """

    hypothesis: Hypothesis
    linear: Linear | None
    errors: np.ndarray
    by_flight: np.ndarray
    beside_hold: float = 0.0
