"""A steady wind: air that moves with one velocity everywhere, for every effect that depends on the airspeed, and

    F_world = conductance * velocity

for the drag that no other effect of the model describes. With `rotor_drag` or `parasitic_drag` in the model, their drag
transmits the wind and the conductance should be 0, or the wind counts twice. Without them the conductance stands for
the drone's drag in moving air only (the drag of its own motion is left out). It causes a constant force; flights
determine only the product conductance * velocity. The velocity is fitted for a given conductance.

``felt`` is the share of the wind that acts on other effects. A search uses 0, that is a constant force alone: it cannot
tell whether the force is transmitted by a drag that it also finds, and with 0 the wind does not count twice. A model
file with a conductance and no ``felt`` also means 0, as in versions in which winds were forces only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import number, vector
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters.parameters import Limits, Parameters


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
    """Velocity of the air, world axes."""
    conductance: Float[Array, "*batch"] = eqx.field(converter=number)
    """Force per wind speed, for drag that no other effect describes; 0 if the model has effects of drag."""
    felt: Float[Array, "*batch"] = eqx.field(converter=number, default=1.0)
    """Share of the wind that acts on other effects, 0 to 1."""

    @classmethod
    def neutral(cls) -> Wind:
        return cls(velocity=0.0, conductance=0.02)

    @classmethod
    def migrated(cls, values: Mapping, parameters: Parameters | None) -> Mapping:
        # In earlier versions winds were fitted as forces that no other effect felt.
        before = "felt" not in values and values.get("conductance", 0) != 0
        return {**values, "felt": 0.0} if before else values

    def air(self, condition: Condition) -> Vec:
        return Vec.unstack(self.velocity) * self.felt

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        force = Vec.unstack(self.velocity) * self.conductance
        return Wrench(wrench.force + rotate_inverse(condition.quaternion, force), wrench.torque)
