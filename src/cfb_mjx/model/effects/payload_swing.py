"""A load slung on a string from the rotors' centre, near hover:

    r'' = -(g / length) r - a_xy - 2 * 0.05 sqrt(g / length) r'
    F_world = mass ((g / length) r_x, (g / length) r_y, -g)

r is where the load hangs from the drone in the world's horizontal plane, a the drone's acceleration: a pendulum of
small angles whose pivot accelerates, lightly damped by the air. The load's weight is carried in full at all times: that
the string pulls more while the drone accelerates upwards is left out. Remembered are r and r'; at the start the load
hangs still.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Memory, Wrench
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters.parameters import Parameters

DAMPING_RATIO = 0.05
"""Of the swing, against critical damping."""


class PayloadSwing(Effect):
    """A pendulum of small angles under the rotors' centre."""

    name: ClassVar[str] = "payload_swing"
    units: ClassVar[dict[str, str]] = {"mass": "kg", "length": "m"}
    source: ClassVar[str] = (
        "I. Palunko, R. Fierro, P. Cruz, Trajectory generation for swing-free maneuvers of a quadrotor with "
        "suspended payload, ICRA 2012"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"mass": (0.0, 0.015), "length": (0.05, 0.5)}
    strengths: ClassVar[tuple[str, ...]] = ("mass",)
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"length": 0.1}, {"length": 0.15}, {"length": 0.2})

    mass: Float[Array, "*batch"] = eqx.field(converter=number)
    """Of the load."""
    length: Float[Array, "*batch"] = eqx.field(converter=number)
    """Of the string."""

    @classmethod
    def neutral(cls) -> PayloadSwing:
        return cls(mass=0.0, length=0.15)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        still = jnp.zeros_like(rotor_speed[0])
        return Vec(still, still), Vec(still, still)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        (x, y), _ = condition.memory
        weight = self.mass * condition.parameters.gravity
        force = Vec(weight / self.length * x, weight / self.length * y, -weight)
        return Wrench(wrench.force + rotate_inverse(condition.quaternion, force), wrench.torque)

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        place, velocity = condition.memory
        stiffness = condition.parameters.gravity / self.length
        # Without gravity there is no swing; the square root has no derivative there.
        swings = stiffness > 0
        damping = jnp.where(swings, 2 * DAMPING_RATIO * jnp.sqrt(jnp.where(swings, stiffness, 1.0)), 0.0)
        pull = -stiffness * place - damping * velocity - Vec(*acceleration[:2])
        # Semi-implicit, as the body itself: the swing neither grows nor dies by the numbers.
        velocity = velocity + pull * dt
        return place + velocity * dt, velocity
