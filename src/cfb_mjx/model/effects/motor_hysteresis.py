"""A motor controller that does not follow small changes of the command: play, as in a gear.

    y' = min(max(y, u - width), u + width),   u' = u + share (y' - u)

The output ``y`` stays constant while the command ``u`` moves within ``width`` of it, and is dragged along beyond that.
The motors receive a mixture of both. Small oscillations of the command are suppressed; during large ones the output
lags behind by up to ``width`` in both directions.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect, Memory
from cfb_mjx.model.effects.fields import command_before, number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters


class MotorHysteresis(Effect):
    """Y = min(max(y, u - width), u + width), the motors receive u + share (y - u)."""

    name: ClassVar[str] = "motor_hysteresis"
    meaning: ClassVar[str] = "the motor controllers do not follow small changes of the command"
    experiment: ClassVar[str] = "small command steps up and down about hover, rotor speed logged"
    units: ClassVar[dict[str, str]] = {"width": "1", "share": "1"}
    source: ClassVar[str] = (
        "G. Tao, P. Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, 1996 (backlash)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"width": (0.0, 0.05), "share": (0.0, 1.0)}
    limits: ClassVar[dict[str, Limits]] = {
        "width": Limits(0.0, 1.0, 0.0, 0.2),
        "share": Limits(0.0, 1.0, 0.0, 1.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("width",)
    # Play narrower than the changes of the command from row to row is hardly visible.
    coarse: ClassVar[dict[int, float]] = {0: 0.15}
    # After the delay of the commands, before their rate limit.
    rank: ClassVar[int] = 2
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"share": 1.0},)

    width: Float[Array, "*batch"] = eqx.field(converter=number)
    """Half the play, as a share of full command; zero or positive."""
    share: Float[Array, "*batch"] = eqx.field(converter=number, default=1.0)
    """Share of the motors' command that passes through the play."""

    @classmethod
    def neutral(cls) -> MotorHysteresis:
        return cls(width=0.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        return command_before(rotor_speed, parameters), 0.0 * rotor_speed

    def command(self, command: Vec, memory: Memory, dt: Any, parameters: Parameters) -> tuple[Vec, Memory]:
        last, place = memory
        # Comparison, not maximum: at zero the derivative is the one towards positive play.
        width = jnp.where(self.width >= 0, self.width, 0.0)
        there = width > 0

        def placed(u, before, z):
            # Position of the output within its play, -1 to 1: with it, the derivative exists without play too, and the
            # command is unchanged there.
            moved = u - before
            at_end = jnp.where(moved > 0, -1.0, jnp.where(moved < 0, 1.0, z))
            return jnp.where(there, jnp.clip(z - moved / jnp.where(there, width, 1.0), -1.0, 1.0), at_end)

        place = command.map(placed, last, place)
        return command + (self.share * width) * place, (command, place)
