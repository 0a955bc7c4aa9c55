"""Which numbers of a model a refinement may move, and how far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import KNOWN, Effect, RegressionDilution
from cfb_mjx.parameters import Parameters

PLANT = (
    *("blade_flapping", "inflow_thrust", "rate_damping", "rotor_drag", "thrust_scale", "inertia", "cog_offset"),
    *("torque_scale", "thrust_tilt", "position_moment", "command_delay", "motor_asymmetry", "battery_sag"),
)
"""What a drone in one piece lacks beside the paper's model, all at once: one by one none of them predicts better.
Loads, wind and what only some drones have are for where there is a reason."""
INERTIA = 0.25
"""Largest plausible change of a moment of inertia, as a share: what decks and another battery bring about."""
HELD = 1e-12
"""By so much a number that is held may move: its scale must not be nothing."""
STEP = 1e-5
"""Of a finite difference, in a number's scale."""
AIR = 1.2
"""Density, kg/m^3."""


@dataclass(frozen=True)
class Number:
    """One component of a field of an effect, and where it may lie."""

    effect: str
    field: str
    index: int | None
    low: float
    high: float

    @property
    def scale(self) -> float:
        """Half the range: the unit the fit counts in."""
        return (self.high - self.low) / 2

    @property
    def name(self) -> str:
        """For reports."""
        at = "" if self.index is None else f"[{self.index}]"
        return f"{self.effect}.{self.field}{at}"

    @property
    def held_at_neutral(self) -> Number:
        """The same, where it may not leave the value at which its effect vanishes.

        A fit with such numbers runs the program compiled for all of them.
        """
        value = self.of_neutral()
        return replace(self, low=value - HELD, high=value + HELD)

    def said_by(self, effect: str) -> bool:
        """Whether another effect says the same."""
        return KNOWN[self.effect].said_by.get(self.field) == effect

    @property
    def held(self) -> bool:
        """Whether it may not move."""
        return self.high - self.low <= 4 * HELD

    def step(self, value: float) -> float:
        """Of a finite difference at a value: upwards, unless that leaves the range."""
        step = STEP * self.scale
        return step if value + step <= self.high else -step

    def of(self, model: Quadrotor) -> float:
        """Its value in a model."""
        return self._in(_effect(model, self.effect))

    def of_neutral(self) -> float:
        """Its value where the effect vanishes."""
        return self._in(KNOWN[self.effect].neutral())

    def _in(self, effect: Effect) -> float:
        value = np.asarray(getattr(effect, self.field))
        return float(value if self.index is None else value[self.index])


def plausible_numbers(parameters: Parameters, effects: Sequence[str]) -> tuple[Number, ...]:
    """Every number of some effects within its prior range; inertia within `INERTIA`, inflow within momentum theory.

    Fields that no flight tells (`Effect.assumed`), and those that another of the effects says (`Effect.said_by`), stay
    as the model has them.

    Raises:
        CfbError: an effect the catalogue does not have, or one that is no physics.
    """
    if RegressionDilution.name in effects:
        raise CfbError(f"{RegressionDilution.name} is no physics: it is for predictors only (--predictor).")
    # A disc of area A at hover loses at most dT/dv = 2 rho A v_h of its thrust T = 2 rho A v_h^2 to a climb (Leishman,
    # Principles of Helicopter Aerodynamics, ch. 2), and discs side by side are no wider than the rotors' spacing.
    area = np.pi * float(parameters.rotor_spacing) ** 2 / 4
    lost = float(np.sqrt(2 * AIR * area * float(parameters.mass * parameters.gravity) / 4))
    bounds = {("inertia", "relative"): (-INERTIA, INERTIA), ("inflow_thrust", "coefficient"): (0.0, lost)}
    return _numbers(effects, bounds)


def free_numbers(effects: Sequence[str]) -> tuple[Number, ...]:
    """The same with inertia and inflow free: for predictors.

    Raises:
        CfbError: an effect the catalogue does not have.
    """
    bounds = {("inertia", "relative"): (-0.7, 4.0), ("inflow_thrust", "coefficient"): (-0.05, 0.2)}
    return _numbers(effects, bounds)


def _numbers(effects: Sequence[str], bounds: dict) -> tuple[Number, ...]:
    found = []
    for name in effects:
        if name not in KNOWN:
            raise CfbError(f"{name}: no such effect; the catalogue has {', '.join(sorted(KNOWN))}.")
        neutral = KNOWN[name].neutral()
        for field, prior in KNOWN[name].prior.items():
            if field in KNOWN[name].assumed or KNOWN[name].said_by.get(field) in effects:
                continue
            low, high = bounds.get((name, field), prior)
            value = np.asarray(getattr(neutral, field))
            found += [Number(name, field, i, low, high) for i in (range(value.size) if value.ndim else [None])]
    return tuple(found)


def with_values(model: Quadrotor, numbers: tuple[Number, ...], values: Any) -> Quadrotor:
    """A model that has the effects of some numbers, with other values of these; differentiable by them."""
    effects = list(model.effects)
    order = {type(e).name: i for i, e in enumerate(effects)}
    for i, number in enumerate(numbers):
        at = order[number.effect]
        old = getattr(effects[at], number.field)
        new = values[i] * jnp.ones_like(old) if number.index is None else old.at[number.index].set(values[i])
        effects[at] = eqx.tree_at(lambda e, f=number.field: getattr(e, f), effects[at], new)
    return eqx.tree_at(lambda m: m.effects, model, tuple(effects))


def _effect(model: Quadrotor, name: str) -> Effect:
    return next(e for e in model.effects if type(e).name == name)
