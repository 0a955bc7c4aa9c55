"""Motors that spin up quicker than they spin down (or slower): active drive one way, drag the other.

    T_i *= 1 - asymmetry * tanh((target_i - Omega_i) / 50 rad/s)

so T (1 - asymmetry) while spinning up and T (1 + asymmetry) while spinning down, switched smoothly. The direction is
that of the start of a step and holds for the step.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect, Memory, Motors
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Parameters

SWITCHING_SPEED = 50.0
"""Distance from the target at which a motor counts as spinning up or down, rad/s."""


class MotorAsymmetry(Effect):
    """T *= 1 -+ asymmetry while spinning up (down)."""

    name: ClassVar[str] = "motor_asymmetry"
    units: ClassVar[dict[str, str]] = {"asymmetry": "1"}
    source: ClassVar[str] = (
        "F. Furrer, M. Burri, M. Achtelik, R. Siegwart, RotorS - a modular Gazebo MAV simulator framework, 2016 (a "
        "time constant for speeding up and one for slowing down)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"asymmetry": (-0.5, 0.5)}
    strengths: ClassVar[tuple[str, ...]] = ("asymmetry",)

    asymmetry: Float[Array, "*batch"] = eqx.field(converter=number)
    """Between -1 and 1; positive means quicker up than down."""

    @classmethod
    def neutral(cls) -> MotorAsymmetry:
        return cls(asymmetry=0.0)

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        direction = ((motors.target - rotor_speed) * (1 / SWITCHING_SPEED)).map(jnp.tanh)
        factor = direction.map(lambda up: 1 - self.asymmetry * up)
        return Motors(motors.target, motors.time_constant * factor), memory
