"""A motor controller with a rate limit, on its output, |du/dt| <= 1 / slowness, or on the speed of the rotor.

With ``rotor`` = 0 the output moves towards the command at most at that rate. The motors receive the exact mean of this
ramp over a step; the memory holds its end. With ``rotor`` = 1 the acceleration of the rotor is limited, as by a limit
of the motor's current: |dOmega/dt| <= K / slowness. Values between divide the slowness between the two. The slowness is
the time from zero to full output, so that zero is no limit. Because of the mean, the effect has a derivative at zero;
the end of the ramp alone would not change until the limit is slower than a step.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect, Memory, Motors
from cfb_mjx.model.effects.fields import command_before, number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters


class EscRateLimit(Effect):
    """|du/dt| <= 1 / ((1 - rotor) slowness), |dOmega/dt| <= K / (rotor slowness)."""

    name: ClassVar[str] = "esc_rate_limit"
    meaning: ClassVar[str] = "the motor controllers limit how fast a command, or the rotor, may change"
    experiment: ClassVar[str] = (
        "command steps of several sizes, rotor speed logged: a limit shows in the large ones only"
    )
    # No rotor reaches the rates that are tried as limits of the command.
    coarse: ClassVar[dict[int, float]] = {1: 0.8}
    units: ClassVar[dict[str, str]] = {"slowness": "s", "rotor": "1"}
    source: ClassVar[str] = (
        "B. Stevens, F. Lewis, E. Johnson, Aircraft Control and Simulation, 3rd ed. 2016 (rate-limited actuator)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"slowness": (0.0, 1.0), "rotor": (0.0, 1.0)}
    limits: ClassVar[dict[str, Limits]] = {
        "slowness": Limits(0.0, 10.0, 0.0, 3.0),
        "rotor": Limits(0.0, 1.0, 0.0, 1.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("slowness",)
    # After delay and hysteresis of the commands, and after all lags of the rotor.
    rank: ClassVar[int] = 3
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"rotor": 0.0}, {"rotor": 1.0})

    slowness: Float[Array, "*batch"] = eqx.field(converter=number)
    """Time from zero to full output; zero or positive."""
    rotor: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0)
    """Share of the slowness that limits the rotor's acceleration instead of the output."""

    @classmethod
    def neutral(cls) -> EscRateLimit:
        return cls(slowness=0.0)

    @property
    def _slowness(self) -> Array:
        # Comparison, not maximum: at zero the derivative is the one towards positive slowness.
        return jnp.where(self.slowness >= 0, self.slowness, 0.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        return (command_before(rotor_speed, parameters),)

    def command(self, command: Vec, memory: Memory, dt: Any, parameters: Parameters) -> tuple[Vec, Memory]:
        (last,) = memory
        slowness = (1 - self.rotor) * self._slowness
        limit = dt / jnp.where(slowness > 0, slowness, 1.0)
        inverse = 1 / jnp.where(dt > 0, dt, 1.0)

        def ramp(wanted, output):
            way = wanted - output
            duration = jnp.abs(way) * slowness
            arrives = duration <= dt
            end = jnp.where(arrives, wanted, output + jnp.sign(way) * limit)
            mean = jnp.where(arrives, wanted - 0.5 * way * duration * inverse, output + 0.5 * jnp.sign(way) * limit)
            return mean, end

        ramps = command.map(ramp, last)
        return Vec(*(mean for mean, _ in ramps)), (Vec(*(end for _, end in ramps)),)

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        slowness = self.rotor * self._slowness
        limited = slowness > 0
        limits = parameters.motor_gain * (dt / jnp.where(limited, slowness, 1.0))

        def reached(target, speed, lag, limit):
            # The target at which the lagging rotor comes in this step as far as the limit allows.
            share = -jnp.expm1(-dt / lag)
            furthest = limit / jnp.where(share > 0, share, 1.0)
            kept = speed + jnp.clip(target - speed, -furthest, furthest)
            return jnp.where(limited & (share > 0), kept, target)

        target = motors.target.map(reached, rotor_speed, motors.time_constant, limits)
        return Motors(target, motors.time_constant), memory
