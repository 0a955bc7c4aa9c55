"""A steady wind, felt through a linear drag:

    F_world = conductance * velocity

The drag of the drone's own motion through still air is the business of `rotor_drag` and `parasitic_drag`. A steady wind
only adds a constant force, so flights can tell the product conductance * velocity and nothing more: fit the velocity at
a given conductance.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import number, vector
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters.limits import Limits


class Wind(Effect):
    """F = conductance * velocity in the world."""

    name: ClassVar[str] = "wind"
    meaning: ClassVar[str] = "the air moves"
    experiment: ClassVar[str] = (
        "hover with the heading turned through 360 degrees: wind stays in the world, trim turns with the body"
    )
    units: ClassVar[dict[str, str]] = {"velocity": "m/s", "conductance": "N s/m"}
    source: ClassVar[str] = (
        "S. Waslander, C. Wang, Wind disturbance estimation and rejection for quadrotor position control, AIAA 2009"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"velocity": (-3.0, 3.0), "conductance": (0.005, 0.05)}
    limits: ClassVar[dict[str, Limits]] = {
        "velocity": Limits(-50.0, 50.0, -15.0, 15.0),
        "conductance": Limits(0.0, 10.0, 0.0, 0.2),
    }
    strengths: ClassVar[tuple[str, ...]] = ("velocity",)

    velocity: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))
    """Of the air, world axes."""
    conductance: Float[Array, "*batch"] = eqx.field(converter=number)
    """Force per wind speed."""

    @classmethod
    def neutral(cls) -> Wind:
        return cls(velocity=0.0, conductance=0.02)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        force = Vec.unstack(self.velocity) * self.conductance
        return Wrench(wrench.force + rotate_inverse(condition.quaternion, force), wrench.torque)
