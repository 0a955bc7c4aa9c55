"""Hypotheses of the search and the parameters it may change.

Every component of a strength or shape field of an effect is one `Column` of the linearised residual.
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
from cfb_mjx.sysid.tracing.innovations import FIRST
from cfb_mjx.sysid.tracing.signals import Moved

LEAD = COMMAND_LEAD
"""Nuisance parameter: commands sent between two rows are not in the log. Always free, never reported as an effect."""
SHIFT = "sensor_time_shift"
"""Fault of the recording, not an effect of the catalogue: command and rotor-speed columns are late or early."""
FORMULA = ResidualFormula.name
TORQUE_UNIT, FORCE_UNIT = 3e-5, 4e-3
"""Typical contribution of a term of a formula, N m and N: about 1 rad/s^2 and 0.1 m/s^2 on this drone."""
LEAST_SIZE = 1e-4
"""A signal with a smaller rms than this, in its unit, counts as not excited."""


@dataclass(frozen=True)
class Column:
    """One parameter: a component of a field of an effect, with other fields at the values of a probe.

    Attributes:
        effect: name of the effect.
        field: of the effect.
        index: component of the field; None for a scalar.
        probe: values of the shape fields at which an absent effect is linearised.
        scale: half the prior range, the unit of the search.
    """

    effect: str
    field: str
    index: int | tuple[int, int] | None
    probe: tuple[tuple[str, float], ...] = ()
    scale: float = dataclasses.field(default=1.0, compare=False)


def neutral_effects(names: tuple[str, ...]) -> tuple[Effect, ...]:
    """The named effects of the catalogue at their neutral values, where they vanish."""
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
    """Columns of an effect's strengths, one list per probe of its shape, without fields redundant with ``others``."""
    kind = KNOWN[name]
    own = tuple(f for f in kind.strengths if kind.said_by.get(f) not in others)
    return [columns_of(name, own, probe) for probe in kind.probes]


def shapes(effect: Effect, others: Collection[str] = ()) -> list[Column]:
    """Columns of the shape of an effect that is present; they are fitted once its strength is known.

    Fields that no flight determines (`Effect.assumed`) and fields redundant with ``others`` (`Effect.said_by`) are left
    out.
    """
    kind = type(effect)
    moving = {key for probe in kind.probes for key in probe} - set(kind.assumed)
    own = tuple(f for f in kind.prior if f in moving and kind.said_by.get(f) not in others)
    return columns_of(kind.name, own, {})


def bounds(name: str, item: str) -> tuple[float, float]:
    """Lower and upper bound of a field of an effect in a search."""
    kind = KNOWN[name]
    low, high = kind.prior[item]
    if item in kind.strengths:
        # A strength may exceed the plausible range (the report says so), but must not take a meaningless sign.
        low, high = (0.0 if low >= 0 else 3 * low), 3 * high
    if item not in kind.limits:  # of a user's own effect
        return low, high
    # Unusually low values are excluded too: no motor has a lag or a gain of nearly zero.
    return max(low, kind.limits[item].soft_low), min(high, kind.limits[item].hard_high)


def sensible(variant: list[Column], values: np.ndarray) -> bool:
    """Whether the strengths have a meaningful sign."""
    if variant[0].effect == SHIFT:
        return True
    low = KNOWN[variant[0].effect].prior[variant[0].field][0]
    return low < 0 or bool(np.all(values >= 0))


def coarse(name: str) -> bool:
    """Whether the derivative at zero strength says little about the effect's strength (`Effect.coarse`)."""
    return name in KNOWN and bool(KNOWN[name].coarse)


def step_of(column: Column, present: bool) -> float:
    """Step of the finite difference for a column."""
    share = 0.02 if present else _shares(column.effect).get(column.probe, 0.05)
    # The step is positive, because zero is the lower bound of some parameters.
    return share * 2 * column.scale


def _shares(name: str) -> dict[tuple[tuple[str, float], ...], float]:
    """Finite-difference steps of a coarse effect as shares of its prior range, by probe."""
    kind = KNOWN.get(name)
    return {} if kind is None else {tuple(kind.probes[i].items()): share for i, share in kind.coarse.items()}


def moved(effect: Effect, column: Column, by: float, present: bool) -> Effect:
    """The effect with one parameter changed by ``by``; its shape is set to the column's probe if it is not present."""
    if not present:
        for key, value in column.probe:
            effect = eqx.tree_at(lambda e, k=key: getattr(e, k), effect, jnp.full_like(getattr(effect, key), value))
    old = getattr(effect, column.field)
    new = old + by if column.index is None else old.at[column.index].add(by)
    return eqx.tree_at(lambda e: getattr(e, column.field), effect, new)


def term_columns(axis: int, sizes: np.ndarray | None = None) -> list[Column]:
    """Columns of every term of the formula library along one axis.

    Args:
        axis: 0 to 5 for torque x, y, z, force x, y, z.
        sizes: (c,) rms of the signals, body terms first, then places. A coefficient's scale is the value at which its
            term has its typical size.
    """
    sizes = np.ones(len(TERMS) + len(PLACES)) if sizes is None else np.maximum(sizes, LEAST_SIZE)
    scale = (TORQUE_UNIT if axis < 3 else FORCE_UNIT) / sizes
    found = [Column(FORMULA, "body_terms", (axis, j), (), scale[j]) for j in range(len(TERMS))]
    if axis >= 3:
        found += [Column(FORMULA, "place", (axis - 3, j), (), scale[len(TERMS) + j]) for j in range(len(PLACES))]
    return found


def lead_column() -> Column:
    """The column of `LEAD`, as a share of an interval."""
    return Column(LEAD, LEAD, None, (), 0.25)


def shift_column() -> Column:
    """The column of `SHIFT`, in units of 10 ms."""
    return Column(SHIFT, "shift", None, (), 0.01)


def moves(effects: tuple[Effect, ...], lead: float, columns: list[Column], present: set[str]) -> list[Moved]:
    """The models of the finite differences: the effects with one column moved at a time."""
    order = {type(effect).name: i for i, effect in enumerate(effects)}
    # NumPy arrays are stacked ten times faster than JAX arrays.
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
"""Finite-difference steps of the command lead, as a share of an interval, and of the time shift, s."""
LEAD_RANGE, LEAD_USUAL, LEAD_SPREAD = (0.0, 0.5), 0.25, 0.1
"""Range, prior mean and prior standard deviation of the command lead.

The lead is the share of the next row's command in the mean over an interval: a quarter if every second command is
logged, at most a half. A larger lead would be a time shift, so the prior has to separate the two.
"""


@dataclass(frozen=True)
class Hypothesis:
    """A candidate model: the effects it adds to the declared model, and all parameter values.

    Attributes:
        effects: all effects of the search, most of them neutral.
        present: names of the effects that are added.
        lead: command lead, the share of the next row's command in the mean over an interval.
        shift: delay of the command and rotor-speed columns, s.
        terms: terms of a formula, if the catalogue does not explain the residual.
        origin: effects of the declared model, to which an absent effect is reset.
        levels: noise levels of this hypothesis's residuals, as the vector of `innovations.levels_from`.
    """

    effects: tuple[Effect, ...]
    present: tuple[str, ...] = ()
    lead: float = LEAD_USUAL
    shift: float = 0.0
    terms: tuple[Column, ...] = ()
    origin: tuple[Effect, ...] = ()
    levels: np.ndarray = field(default_factory=lambda: FIRST, compare=False)

    def effect(self, name: str) -> Effect:
        """The effect with this name."""
        return next(e for e in self.effects if type(e).name == name)

    def declared(self, name: str) -> Effect:
        """The effect with this name in the declared model; neutral if the model does not have it."""
        return next(e for e in self.origin if type(e).name == name)

    def model(self, parameters: Parameters) -> Quadrotor:
        """The drone of this hypothesis, with every effect of the search (most of them neutral)."""
        return Quadrotor(parameters, self.effects)

    @property
    def faults(self) -> SensorFaults:
        """Faults of the recording that the hypothesis itself assumes: the time shift of the motor columns."""
        return SensorFaults(motor_shift=self.shift)

    def having(self, effect: Effect) -> Hypothesis:
        """Add an absent effect; fields of other effects that are redundant with it return to their declared values."""
        name = type(effect).name
        present = (*self.present, name)
        effects = (effect if type(e).name == name else e for e in self.effects)
        pairs = zip(effects, self.origin, strict=True)
        return replace(self, effects=tuple(_unsaid(e, declared, present) for e, declared in pairs), present=present)

    def without(self, name: str) -> Hypothesis:
        """Remove an effect: reset it to its declared value."""
        pairs = zip(self.effects, self.origin, strict=True)
        effects = tuple(declared if type(e).name == name else e for e, declared in pairs)
        shift = 0.0 if name == SHIFT else self.shift
        return replace(self, effects=effects, present=tuple(p for p in self.present if p != name), shift=shift)


def _unsaid(effect: Effect, declared: Effect, others: Collection[str]) -> Effect:
    """The effect with its fields that are redundant with ``others`` (`Effect.said_by`) reset to ``declared``."""
    for item, by in effect.said_by.items():
        if by in others:
            effect = eqx.tree_at(lambda e, f=item: getattr(e, f), effect, getattr(declared, item))
    return effect


@dataclass
class Linear:
    """The whitened residual of a hypothesis and its derivatives, as inner products per block.

    Attributes:
        columns: the c - 1 parameters of the derivatives; if a column occurs twice, the first is used.
        blocks: (b, c, c) inner products; index 0 is the residual itself.
        fold: (b,) cross-validation fold of each block (`evidence.dealt`); None if all blocks are of one flight.
        scale: (c,) unit of each column; 1 for the residual.
    """

    columns: list[Column]
    blocks: np.ndarray
    fold: np.ndarray | None = None
    scale: np.ndarray = field(init=False)

    def __post_init__(self):
        self.scale = np.array([1.0] + [c.scale for c in self.columns])

    def index(self, wanted: list[Column]) -> list[int]:
        """Positions of the wanted columns in the inner products."""
        where = {c: i + 1 for i, c in reversed(list(enumerate(self.columns)))}
        return [where[c] for c in wanted]


@dataclass(frozen=True)
class Fit:
    """A hypothesis fitted to the flights.

    Attributes:
        hypothesis: with the fitted values.
        linear: linearisation with respect to the whole catalogue; None if it has not been computed yet.
        errors: (8,) prediction errors `fits.ERRORS` over all flights.
        by_flight: (L, 8) prediction errors of each flight that has prediction windows.
        beside_hold: prediction error relative to `hold` (`fits.beside_hold`).
    """

    hypothesis: Hypothesis
    linear: Linear | None
    errors: np.ndarray
    by_flight: np.ndarray
    beside_hold: float = 0.0
