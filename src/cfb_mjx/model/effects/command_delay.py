"""Commands act late, by a constant dead time: u(t) -> u(t - delay).

Commands are held between rows, so the delayed command is piecewise constant within a step. The motors receive its exact
mean over the step: the weight of each command is the overlap of the interval in which it was held with [t - delay,
t - delay + dt], divided by dt. The delay may be any fraction of a step, and the derivative with respect to it exists.

The memory holds the last commands and their ages. Their number is what the longest delay of the effect's range needs at
the model's integration step, but at least eight. If the steps are shorter, as between the rows of a log, commands that
together lasted less than delay / (number - 1) are stored as their mean, so that the memory always covers the delay.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect, Memory
from cfb_mjx.model.effects.fields import command_before, number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters

ROWS = 8
"""Smallest number of commands in the memory."""


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
    """Time between a command and its arrival at the motors; zero or positive."""

    @classmethod
    def neutral(cls) -> CommandDelay:
        return cls(delay=0.0)

    def begin(self, rotor_speed: Vec, parameters: Parameters, dt: float) -> Memory:
        longest = self.prior["delay"][1]
        if not isinstance(self.delay, Tracer):
            longest = max(longest, float(np.asarray(self.delay).max()))
        return self._steady(rotor_speed, parameters, max(ROWS, math.ceil(longest / dt - 1e-6) + 1))

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        return self._steady(rotor_speed, parameters, ROWS)

    def _steady(self, rotor_speed: Vec, parameters: Parameters, rows: int) -> Memory:
        steady = command_before(rotor_speed, parameters)
        age = jnp.zeros_like(rotor_speed[0])
        # Equal ages: all but the oldest command have lasted no time, and the oldest has acted for ever.
        return Vec(*(age,) * rows), *(steady,) * rows

    def command(self, command: Vec, memory: Memory, dt: Any, parameters: Parameters) -> tuple[Vec, Memory]:
        ages, *earlier = memory
        held = dt > 0
        inverse = 1 / jnp.where(held, dt, 1.0)

        def before(age):
            """Share of the step in which commands that began at most ``age`` seconds ago have not arrived yet."""
            late = self.delay - age
            # Comparisons, not clip: at zero delay the derivative is the one towards positive delays.
            part = jnp.where(late < 0, 0.0, jnp.where(late * inverse < 1, late * inverse, 1.0))
            # A step of zero length has the command that is active at its instant.
            return jnp.where(held, part, jnp.where(late > 0, 1.0, 0.0))

        received, newer = command, command
        for age, older in zip((jnp.zeros_like(ages[0]), *ages[:-1]), earlier, strict=True):
            received = received + (older - newer) * before(age)
            newer = older

        # The newest command gets a row of its own if the row before it has lasted long enough: rows of this length
        # reach back as far as the delay. Otherwise both become their mean. A step of zero length changes nothing.
        own = ages[0] >= self.delay / (len(earlier) - 1) * (1 - 1e-3)
        lasted = ages[0] + dt
        share = dt / jnp.where(lasted > 0, lasted, 1.0)
        own = own & held

        def pushed(newest, mixed, line):
            return [
                jnp.where(own, newest, mixed),
                *(jnp.where(own, a, b) for a, b in pairwise(line)),
            ]

        ages = pushed(dt, lasted, [age + dt for age in ages])
        columns = [
            pushed(newest, line[0] + (newest - line[0]) * share, line)
            for newest, line in zip(command, zip(*earlier, strict=True), strict=True)
        ]
        return received, (Vec(*ages), *(Vec(*row) for row in zip(*columns, strict=True)))
