"""A second lag in front of the motor's own, such as the current in its windings or a filter in its controller:

    lag y' = K u - y,   T Omega' = y - Omega

The memory holds y; its exact mean over a step is the target of the motor during the step.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect, Memory, Motors
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.effects.motor_time_constant import MotorTimeConstant
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters


class MotorSecondOrder(Effect):
    """lag y' = K u - y, T Omega' = y - Omega."""

    name: ClassVar[str] = "motor_second_order"
    meaning: ClassVar[str] = "the motors respond with a second lag"
    experiment: ClassVar[str] = MotorTimeConstant.experiment
    coarse: ClassVar[dict[int, float]] = {0: 0.3}
    units: ClassVar[dict[str, str]] = {"lag": "s"}
    source: ClassVar[str] = (
        "G. Franklin, J. D. Powell, A. Emami-Naeini, Feedback Control of Dynamic Systems, ch. 2 (motor with winding"
        " inductance)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"lag": (0.0, 0.03)}
    limits: ClassVar[dict[str, Limits]] = {"lag": Limits(0.0, 1.0, 0.0, 0.1)}
    strengths: ClassVar[tuple[str, ...]] = ("lag",)
    # After battery and temperature have changed the steady speed.
    rank: ClassVar[int] = 1

    lag: Float[Array, "*batch"] = eqx.field(converter=number)
    """Time constant of the additional first-order lag; zero or positive."""

    @classmethod
    def neutral(cls) -> MotorSecondOrder:
        return cls(lag=0.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        return (rotor_speed,)

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        (last,) = memory
        # Comparison, not maximum: at zero the derivative is the one towards positive lags.
        lag = jnp.where(self.lag >= 0, self.lag, 0.0)
        # exp(-100) is zero for all purposes, and a smaller lag would make the derivative divide by its square.
        slow = lag > 0.01 * dt
        decay = jnp.where(slow, jnp.exp(-dt / jnp.where(slow, lag, 1.0)), 0.0)
        mean = jnp.where(dt > 0, lag * (1 - decay) / jnp.where(dt > 0, dt, 1.0), 1.0)
        away = last - motors.target
        return Motors(motors.target + away * mean, motors.time_constant), (motors.target + away * decay,)
