"""Wall or ceiling: near a flat surface a rotor gives more thrust, or less.

    f_i *= 1 + strength (reach^2 + d^2) / (reach^2 + a_i^2),  d = 0.1 m

where a_i is the distance of rotor i from the plane, which lies ``distance`` from the world's origin in ``direction``;
behind the plane it counts as zero. The formula is that of `ground_effect`. A ceiling ([0, 0, 1]) attracts the drone;
near a wall the rotors beside it lose some thrust, and the drone leans towards the wall.

`cfb close-loop` does not search for it, because the log does not contain the room. Name it and give the plane.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect
from cfb_mjx.model.effects.fields import hub_positions, number, vector
from cfb_mjx.model.effects.ground_effect import beside_surface
from cfb_mjx.model.rotors import RotorLoads
from cfb_mjx.model.vector import Vec, rotate, rotate_inverse
from cfb_mjx.parameters.parameters import Limits


class WallEffect(Effect):
    """f_i *= 1 + strength (reach^2 + d^2) / (reach^2 + a_i^2), d = 0.1 m."""

    name: ClassVar[str] = "wall_effect"
    meaning: ClassVar[str] = "thrust changes near a wall or the ceiling"
    experiment: ClassVar[str] = "hover for five seconds each at 0.1, 0.15, 0.25 and 0.5 m from the surface"
    units: ClassVar[dict[str, str]] = {"strength": "1", "reach": "m", "direction": "1", "distance": "m"}
    source: ClassVar[str] = (
        "P. Sanchez-Cuevas, G. Heredia, A. Ollero, Multirotor UAS for bridge inspection by contact using the ceiling "
        "effect, ICUAS 2017; D. Robinson, H. Chung, K. Ryan, Computational investigation of micro rotorcraft near-wall "
        "hovering aerodynamics, ICUAS 2014"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "strength": (-0.2, 0.3),
        "reach": (0.02, 0.3),
        "direction": (-1.0, 1.0),
        "distance": (0.5, 5.0),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "strength": Limits(-0.9, 3.0, -0.5, 0.9),
        "reach": Limits(0.001, 10.0, 0.01, 1.0),
        "direction": Limits(-1e3, 1e3, -1.0, 1.0),
        "distance": Limits(-1e3, 1e3, -20.0, 20.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("strength",)
    assumed: ClassVar[tuple[str, ...]] = ("direction", "distance")
    # Acts on the thrust after the effects of the flow through the rotors.
    rank: ClassVar[int] = 1
    searched: ClassVar[bool] = False
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"reach": 0.05}, {"reach": 0.12}, {"reach": 0.25})

    strength: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative gain of thrust 0.1 m from the surface."""
    reach: Float[Array, "*batch"] = eqx.field(converter=number)
    """Distance at which half of the gain at the surface remains."""
    direction: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))
    """Normal of the surface, pointing away from the drone, world; any length except zero."""
    distance: Float[Array, "*batch"] = eqx.field(converter=number)
    """Distance of the surface from the world's origin, along the direction."""

    @classmethod
    def neutral(cls) -> WallEffect:
        return cls(strength=0.0, reach=0.12, direction=[0.0, 0.0, 1.0], distance=2.5)

    def rotors(self, loads: RotorLoads, condition: Condition) -> RotorLoads:
        parameters = condition.parameters
        normal = Vec.unstack(self.direction)
        normal = normal * (1 / jnp.sqrt(normal.dot(normal)))
        in_body = rotate_inverse(condition.quaternion, normal)
        along, across = hub_positions(parameters)
        center = condition.position - rotate(condition.quaternion, Vec.unstack(parameters.center_of_gravity))
        away = -(along * in_body[0] + across * in_body[1]) + (self.distance - center.dot(normal))
        return RotorLoads(loads.thrust * beside_surface(away, self.strength, self.reach), loads.torque, loads.rate)
