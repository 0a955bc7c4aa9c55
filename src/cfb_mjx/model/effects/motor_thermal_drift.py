"""Motors that get weaker as they warm up: winding resistance rises, the magnets' field falls.

    steady rotor speed *= 1 - drop (1 - exp(-t / time_constant))

with t the time since power-on, remembered; a log's own time is taken over where there is one.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Memory, Motors, Reading
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Parameters


class MotorThermalDrift(Effect):
    """Steady rotor speed *= 1 - drop (1 - exp(-t / time_constant))."""

    name: ClassVar[str] = "motor_thermal_drift"
    units: ClassVar[dict[str, str]] = {"drop": "1", "time_constant": "s"}
    source: ClassVar[str] = (
        "D. Hanselman, Brushless Permanent Magnet Motor Design, 2nd ed. 2003 (temperature of windings and magnets)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"drop": (0.0, 0.1), "time_constant": (5.0, 60.0)}
    strengths: ClassVar[tuple[str, ...]] = ("drop",)
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"time_constant": 8.0}, {"time_constant": 20.0})

    drop: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative loss of speed once warm."""
    time_constant: Float[Array, "*batch"] = eqx.field(converter=number)
    """Of warming up."""

    @classmethod
    def neutral(cls) -> MotorThermalDrift:
        return cls(drop=0.0, time_constant=15.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        return (Vec(jnp.zeros_like(rotor_speed[0])),)

    def sense(self, memory: Memory, reading: Reading) -> Memory:
        ((time,),) = memory
        return (Vec(jnp.asarray(reading.time, time.dtype)),)

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        ((time,),) = memory
        factor = 1 - self.drop * (1 - jnp.exp(-time / self.time_constant))
        return Motors(motors.target * factor, motors.time_constant), memory

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        ((time,),) = condition.memory
        return (Vec(time + dt),)
