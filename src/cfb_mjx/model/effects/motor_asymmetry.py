"""Motors that spin up and down at different rates: active drive in one direction, drag in the other.

    T_i *= 1 + (spin_up (1 + d_i) + spin_down (1 - d_i)) / 2,  d_i = tanh((target_i - Omega_i) / width)

The time constant is T (1 + spin_up) while spinning up and T (1 + spin_down) while spinning down, with a smooth
transition of width ``width``. The direction at the start of a step holds for the whole step.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect, Memory, Motors
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters


class MotorAsymmetry(Effect):
    """T *= 1 + spin_up (spin_down) while spinning up (down)."""

    name: ClassVar[str] = "motor_asymmetry"
    meaning: ClassVar[str] = "the motors spin up and down at different speed"
    experiment: ClassVar[str] = "large command steps up and down, rotor speed logged (cfb excite single-motor)"
    units: ClassVar[dict[str, str]] = {"spin_up": "1", "spin_down": "1", "width": "rad/s"}
    source: ClassVar[str] = (
        "F. Furrer, M. Burri, M. Achtelik, R. Siegwart, RotorS - a modular Gazebo MAV simulator framework, 2016 (a "
        "time constant for speeding up and one for slowing down)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "spin_up": (-0.5, 0.5),
        "spin_down": (-0.5, 0.5),
        "width": (5.0, 200.0),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "spin_up": Limits(-0.95, 20.0, -0.8, 2.0),
        "spin_down": Limits(-0.95, 20.0, -0.8, 2.0),
        "width": Limits(0.1, 100000.0, 1.0, 1000.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("spin_up", "spin_down")
    # Direction towards the target that the lag of the windings leaves.
    rank: ClassVar[int] = 2
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"width": 15.0}, {"width": 60.0})

    spin_up: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of the time constant while spinning up, above -1."""
    spin_down: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of the time constant while spinning down, above -1."""
    width: Float[Array, "*batch"] = eqx.field(converter=number, default=50.0)
    """Distance from the target at which a motor counts as spinning up or down."""

    @classmethod
    def neutral(cls) -> MotorAsymmetry:
        return cls(spin_up=0.0, spin_down=0.0)

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        direction = ((motors.target - rotor_speed) * (1 / self.width)).map(jnp.tanh)
        factor = direction.map(lambda d: 1 + 0.5 * (self.spin_up * (1 + d) + self.spin_down * (1 - d)))
        return Motors(motors.target, motors.time_constant * factor), memory
