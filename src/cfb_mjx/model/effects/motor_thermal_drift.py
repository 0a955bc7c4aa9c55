"""Motors that weaken as they warm up: the winding resistance rises and the magnets' field falls.

    steady rotor speed of motor i *= 1 - drop h_i,  time_constant h_i' = (Omega_i / 1594 rad/s)^3 - h_i

h is the warmth: 0 for a cold motor, 1 for one that has hovered for long. The power of a rotor grows with the cube of
its speed, and the losses roughly do so too. Motors are cold at the start of a log or a rollout.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Memory, Motors
from cfb_mjx.model.effects.fields import HOVER_SPEED, number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters


class MotorThermalDrift(Effect):
    """Steady rotor speed *= 1 - drop h, where h follows (Omega / 1594)^3 with time_constant."""

    name: ClassVar[str] = "motor_thermal_drift"
    meaning: ClassVar[str] = "the motors slow down as they warm up"
    experiment: ClassVar[str] = "hover for a minute from cold, twice: on a full and on a half-empty battery"
    units: ClassVar[dict[str, str]] = {"drop": "1", "time_constant": "s"}
    source: ClassVar[str] = (
        "D. Hanselman, Brushless Permanent Magnet Motor Design, 2nd ed. 2003 (temperature of windings and magnets)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"drop": (0.0, 0.1), "time_constant": (5.0, 60.0)}
    limits: ClassVar[dict[str, Limits]] = {
        "drop": Limits(-0.5, 0.95, 0.0, 0.3),
        "time_constant": Limits(0.01, 100000.0, 1.0, 1000.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("drop",)
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"time_constant": 8.0}, {"time_constant": 20.0})

    drop: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative loss of speed of a motor that has hovered for long."""
    time_constant: Float[Array, "*batch"] = eqx.field(converter=number)
    """Time constant of the warming."""

    @classmethod
    def neutral(cls) -> MotorThermalDrift:
        return cls(drop=0.0, time_constant=15.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        return (rotor_speed.map(jnp.zeros_like),)

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        (warmth,) = memory
        weaker = motors.target.map(lambda target, warm: target * (1 - self.drop * warm), warmth)
        return Motors(weaker, motors.time_constant), memory

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        (warmth,) = condition.memory
        load = (condition.rotor_speed * (1 / HOVER_SPEED)).map(lambda ratio: ratio * ratio * ratio)
        # Exact for a constant load, because rows of a log may be far apart.
        return (warmth + (load - warmth) * (1 - jnp.exp(-dt / self.time_constant)),)
