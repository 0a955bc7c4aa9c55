"""A steady wind: air that moves alike everywhere, for every effect that depends on the airspeed, and

    F_world = conductance * velocity

for the drag that no other effect of the model describes. With `rotor_drag` or `parasitic_drag` in the model their drag
carries the wind, and the conductance should be 0, or it counts twice. Without them it stands for the drone's drag in
moving air only (that of its own motion is left out): a constant force, of which flights tell the product
conductance * velocity and nothing more. The velocity is fitted at a given conductance.

``felt`` is the share of the wind that other effects feel. A search takes 0, a constant force and no more: whether a
force is carried by the drag it also finds is more than it can tell, and so the wind does not count twice there. A model
file that gives a conductance and no ``felt`` means 0 as well, as it did when winds were forces only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import number, vector
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters.limits import Limits
from cfb_mjx.parameters.parameters import Parameters


class Wind(Effect):
    """The air moves with ``velocity``, and F = conductance * velocity in the world."""

    name: ClassVar[str] = "wind"
    meaning: ClassVar[str] = "the air moves"
    experiment: ClassVar[str] = (
        "hover with the heading turned through 360 degrees: wind stays in the world, trim turns with the body"
    )
    units: ClassVar[dict[str, str]] = {"velocity": "m/s", "conductance": "N s/m", "felt": "1"}
    source: ClassVar[str] = (
        "S. Waslander, C. Wang, Wind disturbance estimation and rejection for quadrotor position control, AIAA 2009"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "velocity": (-3.0, 3.0),
        "conductance": (0.0, 0.05),
        "felt": (0.0, 1.0),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "velocity": Limits(-50.0, 50.0, -15.0, 15.0),
        "conductance": Limits(0.0, 10.0, 0.0, 0.2),
        "felt": Limits(0.0, 1.0, 0.0, 1.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("velocity",)
    assumed: ClassVar[tuple[str, ...]] = ("conductance", "felt")
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"felt": 0.0},)

    velocity: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))
    """Of the air, world axes."""
    conductance: Float[Array, "*batch"] = eqx.field(converter=number)
    """Force per wind speed, of whatever no other effect describes; 0 beside effects of drag."""
    felt: Float[Array, "*batch"] = eqx.field(converter=number, default=1.0)
    """Share of it that other effects feel."""

    @classmethod
    def neutral(cls) -> Wind:
        return cls(velocity=0.0, conductance=0.02)

    @classmethod
    def migrated(cls, values: Mapping[str, Any], parameters: Parameters | None) -> Mapping[str, Any]:
        # Winds of earlier versions were fitted as forces that no other effect felt.
        before = "felt" not in values and values.get("conductance", 0) != 0
        return {**values, "felt": 0.0} if before else values

    def air(self, condition: Condition) -> Vec:
        return Vec.unstack(self.velocity) * self.felt

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        force = Vec.unstack(self.velocity) * self.conductance
        return Wrench(wrench.force + rotate_inverse(condition.quaternion, force), wrench.torque)
