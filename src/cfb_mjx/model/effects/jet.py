"""The jet of a fan: air that moves along an axis, widens, and slows down by the air it entrains.

    air = speed (width / b) exp(-ln 2 (r / b)^2) s(x) along ``direction``,  b = width + spreading x

at the distance x along the axis from ``origin`` and r from the axis. b is the radius at which the speed has fallen to
half of that on the axis. The product of b and the speed on the axis is constant, as the momentum of a round jet
requires. s(x) = (1 + tanh(2 x / width)) / 2 lets the jet begin at the fan. The slow entrained air near the fan and
beside the jet is left out, and the air is the same at all rotors of a drone.
"""

from __future__ import annotations

import math
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect
from cfb_mjx.model.effects.fields import number, vector
from cfb_mjx.model.vector import Vec, rotate
from cfb_mjx.parameters.parameters import Limits


class Jet(Effect):
    """A round jet with a Gaussian profile."""

    name: ClassVar[str] = "jet"
    meaning: ClassVar[str] = "a fan blows"
    experiment: ClassVar[str] = "slow passes across the jet at several distances from the fan"
    units: ClassVar[dict[str, str]] = {
        "speed": "m/s",
        "origin": "m",
        "direction": "1",
        "width": "m",
        "spreading": "1",
    }
    source: ClassVar[str] = (
        "H. Hussein, S. Capp, W. George, Velocity measurements in a high-Reynolds-number, momentum-conserving, "
        "axisymmetric, turbulent jet, J. Fluid Mech. 258, 1994 (spreading rate 0.094 to 0.102)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "speed": (0.0, 6.0),
        "origin": (-3.0, 3.0),
        "direction": (-1.0, 1.0),
        "width": (0.02, 0.5),
        "spreading": (0.05, 0.2),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "speed": Limits(0.0, 100.0, 0.0, 20.0),
        "origin": Limits(-1e4, 1e4, -100.0, 100.0),
        "direction": Limits(-1e3, 1e3, -1e3, 1e3),
        "width": Limits(1e-3, 100.0, 0.02, 2.0),
        "spreading": Limits(0.0, 2.0, 0.05, 0.3),
    }
    strengths: ClassVar[tuple[str, ...]] = ("speed",)
    searched: ClassVar[bool] = False

    speed: Float[Array, "*batch"] = eqx.field(converter=number)
    """Speed on the axis at the fan."""
    origin: Float[Array, "*batch 3"] = eqx.field(converter=vector(3), default=0.0)
    """Position of the fan, world."""
    direction: Float[Array, "*batch 3"] = eqx.field(converter=vector(3), default=(1.0, 0.0, 0.0))
    """Direction in which the fan blows, world; the length is ignored."""
    width: Float[Array, "*batch"] = eqx.field(converter=number, default=0.1)
    """Distance from the axis at which the speed has fallen to half, at the fan."""
    spreading: Float[Array, "*batch"] = eqx.field(converter=number, default=0.1)
    """Growth of that distance per distance from the fan."""

    @classmethod
    def neutral(cls) -> Jet:
        return cls(speed=0.0)

    def air(self, condition: Condition) -> Vec:
        lever = Vec.unstack(condition.parameters.center_of_gravity)
        center = condition.position - rotate(condition.quaternion, lever)
        axis = Vec.unstack(self.direction)
        axis = axis * (1 / jnp.sqrt(axis.dot(axis)))
        away = center - Vec.unstack(self.origin)
        along = away.dot(axis)
        square = away.dot(away) - along * along
        # Behind the fan the width is constant; the jet vanishes there.
        b = self.width + self.spreading * jnp.where(along > 0, along, 0.0)
        begins = 0.5 * (1 + jnp.tanh(2 * along / self.width))
        return axis * (self.speed * begins * (self.width / b) * jnp.exp(-math.log(2) * square / b**2))
