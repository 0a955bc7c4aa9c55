"""Parameters of a model that a refinement may fit, and their bounds."""

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
"""Effects that an undamaged drone usually has in addition to the paper's model. They have to be fitted together,
because none of them alone improves predictions. Loads, wind and other effects of only some drones are fitted on
request."""
INERTIA = 0.25
"""Largest plausible relative change of a moment of inertia, for instance by decks and another battery."""
HELD = 1e-12
"""Half-width of the range of a held parameter; it must not be zero, because it is the parameter's scale."""
STEP = 1e-5
"""Step of a finite difference, in units of a parameter's scale."""
AIR = 1.2
"""Air density, kg/m^3."""


@dataclass(frozen=True)
class Number:
    """One parameter of a refinement: a component of a field of an effect, and its bounds.

    Attributes:
        effect: name of the effect.
        field: of the effect.
        index: component of the field; None for a scalar.
        low: lower bound.
        high: upper bound.
    """

    effect: str
    field: str
    index: int | None
    low: float
    high: float

    @property
    def scale(self) -> float:
        """Half the range, the unit of the fit."""
        return (self.high - self.low) / 2

    @property
    def name(self) -> str:
        """Name for reports, for instance ``inertia.relative[0]``."""
        at = "" if self.index is None else f"[{self.index}]"
        return f"{self.effect}.{self.field}{at}"

    @property
    def held_at_neutral(self) -> Number:
        """The same parameter, held at the value at which its effect vanishes.

        A fit with held parameters reuses the program compiled for all of them.
        """
        value = self.of_neutral()
        return replace(self, low=value - HELD, high=value + HELD)

    def said_by(self, effect: str) -> bool:
        """Whether the parameter is redundant with another effect (`Effect.said_by`)."""
        return KNOWN[self.effect].said_by.get(self.field) == effect

    @property
    def held(self) -> bool:
        """Whether the parameter is held fixed."""
        return self.high - self.low <= 4 * HELD

    def step(self, value: float) -> float:
        """Signed step of a finite difference at a value: upwards unless that leaves the range."""
        step = STEP * self.scale
        return step if value + step <= self.high else -step

    def of(self, model: Quadrotor) -> float:
        """Value of the parameter in a model that has the effect."""
        return self._in(_effect(model, self.effect))

    def of_neutral(self) -> float:
        """Value of the parameter where the effect vanishes."""
        return self._in(KNOWN[self.effect].neutral())

    def _in(self, effect: Effect) -> float:
        value = np.asarray(getattr(effect, self.field))
        return float(value if self.index is None else value[self.index])


def plausible_numbers(parameters: Parameters, effects: Sequence[str]) -> tuple[Number, ...]:
    """All parameters of some effects, with physically plausible bounds.

    The bounds are the prior ranges of the effects. The inertia is limited by `INERTIA`, the inflow coefficient by
    momentum theory. Fields that no flight determines (`Effect.assumed`) and fields that are redundant with another of
    the effects (`Effect.said_by`) are not fitted.

    Args:
        parameters: the drone, for the limit from momentum theory.
        effects: names of the effects.

    Raises:
        CfbError: an effect is not in the catalogue, or is not physical.
    """
    if RegressionDilution.name in effects:
        raise CfbError(f"{RegressionDilution.name} is not a physical effect; it is for predictors only (--predictor).")
    # A disc of area A at hover loses at most dT/dv = 2 rho A v_h of its thrust T = 2 rho A v_h^2 to a climb (Leishman,
    # Principles of Helicopter Aerodynamics, ch. 2), and discs side by side are no wider than the rotors' spacing.
    area = np.pi * float(parameters.rotor_spacing) ** 2 / 4
    lost = float(np.sqrt(2 * AIR * area * float(parameters.mass * parameters.gravity) / 4))
    bounds = {("inertia", "relative"): (-INERTIA, INERTIA), ("inflow_thrust", "coefficient"): (0.0, lost)}
    return _numbers(effects, bounds)


def free_numbers(effects: Sequence[str]) -> tuple[Number, ...]:
    """All parameters of some effects, with wide bounds on inertia and inflow, for predictors.

    Args:
        effects: names of the effects.

    Raises:
        CfbError: an effect is not in the catalogue.
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
    """The model with new values of some parameters; differentiable with respect to them.

    Args:
        model: the drone, with all effects of ``numbers``.
        numbers: the N parameters.
        values: (N,) their new values.
    """
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
