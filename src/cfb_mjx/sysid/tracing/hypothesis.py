"""What a search may believe of a drone, and what a small change of it would explain."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from cfb_mjx.model.effects import Effect
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.tracing.columns import SHIFT, Column
from cfb_mjx.sysid.tracing.whitening import FIRST

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
    """Noise levels that fit what this hypothesis leaves (the vector of `whitening.levels_from`)."""

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
        """The same with an effect that was absent."""
        name = type(effect).name
        effects = tuple(effect if type(e).name == name else e for e in self.effects)
        return replace(self, effects=effects, present=(*self.present, name))

    def without(self, name: str) -> Hypothesis:
        """The same with one effect back at neutral."""
        pairs = zip(self.effects, self.origin, strict=True)
        effects = tuple(declared if type(e).name == name else e for e, declared in pairs)
        shift = 0.0 if name == SHIFT else self.shift
        return replace(self, effects=effects, present=tuple(p for p in self.present if p != name), shift=shift)


@dataclass
class Linear:
    """A residual and its derivatives at a hypothesis, as inner products.

    Attributes:
        columns: one fewer than c: the residual itself comes first. Of columns that occur twice the first counts.
        blocks: (b, c, c).
        scale: (c,) unit of each.
    """

    columns: list[Column]
    blocks: np.ndarray
    scale: np.ndarray = field(init=False)

    def __post_init__(self):
        self.scale = np.array([1.0] + [c.scale for c in self.columns])

    def index(self, wanted: list[Column]) -> list[int]:
        """Positions of columns in the inner products."""
        where = {c: i + 1 for i, c in reversed(list(enumerate(self.columns)))}
        return [where[c] for c in wanted]
