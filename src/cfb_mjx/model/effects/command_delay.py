"""Commands act late, by a constant dead time: u(t) -> u(t - delay).

Commands are held between rows, so the delayed command of one step is piecewise constant; what the motors receive is its
exact mean over the step. Each command's weight is the overlap of the interval in which it was held with [t - delay,
t - delay + dt], divided by dt: any fraction of a step is possible, and the derivative by the delay exists.

Remembered are the last eight commands and how long ago each began; one row is one integration step, so the longest
delay is eight of them. Beyond that the oldest command stands for all before it.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect, Memory
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.limits import Limits
from cfb_mjx.parameters.parameters import Parameters

ROWS = 8
"""Commands remembered."""


class CommandDelay(Effect):
    """The motors receive u(t - delay)."""

    name: ClassVar[str] = "command_delay"
    meaning: ClassVar[str] = "commands reach the motors late"
    experiment: ClassVar[str] = "sharp command steps, rotor speed and every command logged (cfb excite single-motor)"
    coarse: ClassVar[dict[int, float]] = {0: 0.2}
    units: ClassVar[dict[str, str]] = {"delay": "s"}
    source: ClassVar[str] = (
        "K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, 3rd ed. 1997, ch. 2 (sampling a system with time"
        " delay)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"delay": (0.0, 0.02)}
    limits: ClassVar[dict[str, Limits]] = {"delay": Limits(0.0, 1.0, 0.0, 0.06)}
    strengths: ClassVar[tuple[str, ...]] = ("delay",)

    delay: Float[Array, "*batch"] = eqx.field(converter=number)
    """From when a command is given to when the motors receive it; zero or positive."""

    @classmethod
    def neutral(cls) -> CommandDelay:
        return cls(delay=0.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        steady = (rotor_speed - parameters.motor_speed_offset) / parameters.motor_gain
        steady = steady.map(lambda u: jnp.clip(u, 0.0, 1.0))
        age = jnp.zeros_like(rotor_speed[0])
        # Commands that began at the same instant had no time to act, save the oldest, which has acted for ever.
        return Vec(*(age,) * ROWS), *(steady,) * ROWS

    def command(self, command: Vec, memory: Memory, dt: Any, parameters: Parameters) -> tuple[Vec, Memory]:
        ages, *earlier = memory
        held = dt > 0
        inverse = 1 / jnp.where(held, dt, 1.0)

        def before(age):
            """Share of the step in which commands that began up to ``age`` seconds ago have not arrived yet."""
            late = self.delay - age
            # Comparisons instead of clip: at a delay of zero the derivative is that of a growing delay.
            part = jnp.where(late < 0, 0.0, jnp.where(late * inverse < 1, late * inverse, 1.0))
            # In a step without duration the command is the one that is active at its instant.
            return jnp.where(held, part, jnp.where(late > 0, 1.0, 0.0))

        received, newer = command, command
        for age, older in zip((jnp.zeros_like(ages[0]), *ages[:-1]), earlier, strict=True):
            received = received + (older - newer) * before(age)
            newer = older

        # A step without duration has given no command.
        def pushed(newest, line):
            return [jnp.where(held, a, b) for a, b in zip((newest, *line[:-1]), line, strict=True)]

        ages = pushed(dt, [age + dt for age in ages])
        columns = [pushed(newest, list(line)) for newest, line in zip(command, zip(*earlier, strict=True), strict=True)]
        return received, (Vec(*ages), *(Vec(*row) for row in zip(*columns, strict=True)))
