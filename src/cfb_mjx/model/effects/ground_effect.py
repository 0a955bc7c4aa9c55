"""Ground effect: near the floor (world z = 0) a rotor gives more thrust.

    f_i *= 1 + strength (height^2 + d^2) / (height^2 + z_i^2),  d = 0.1 m

where z_i is the height of rotor i, from the position of the rotors' centre and the tilt; a height below the floor
counts as zero. Far from the floor the gain falls as 1/z^2, as 1 / (1 - (R / 4 z)^2) of Cheeseman and Bennett does
(there strength * (height^2 + d^2) = R^2 / 16); unlike theirs it is finite at the floor. The strength is the gain at
height d, where drones do fly; the gain at the floor itself would be an extrapolation that no flight determines.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect
from cfb_mjx.model.effects.fields import hub_positions, number
from cfb_mjx.model.rotors import RotorLoads
from cfb_mjx.model.vector import Vec, rotate
from cfb_mjx.parameters.parameters import Limits

REFERENCE = 0.1
"""Height of the rotors above the floor at which the strength is defined, m."""


class GroundEffect(Effect):
    """f_i *= 1 + strength (height^2 + d^2) / (height^2 + z_i^2), d = 0.1 m."""

    name: ClassVar[str] = "ground_effect"
    meaning: ClassVar[str] = "thrust grows near the ground"
    experiment: ClassVar[str] = "hover for five seconds each at 0.1, 0.15, 0.25, 0.5 and 1 m"
    units: ClassVar[dict[str, str]] = {"strength": "1", "height": "m"}
    source: ClassVar[str] = (
        "I. Cheeseman, W. Bennett, The effect of the ground on a helicopter rotor in forward flight, ARC R&M 3021, "
        "1955; P. Sanchez-Cuevas, G. Heredia, A. Ollero, Int. J. Aerospace Eng. 2017, 1823056"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"strength": (0.0, 0.3), "height": (0.02, 0.3)}
    limits: ClassVar[dict[str, Limits]] = {
        "strength": Limits(-0.5, 3.0, 0.0, 0.9),
        "height": Limits(0.001, 10.0, 0.01, 1.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("strength",)
    # Acts on the thrust after the effects of the flow through the rotors.
    rank: ClassVar[int] = 1
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"height": 0.05}, {"height": 0.12}, {"height": 0.25})

    strength: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative gain of thrust at `REFERENCE` above the floor."""
    height: Float[Array, "*batch"] = eqx.field(converter=number)
    """Height at which half of the gain at the floor remains."""

    @classmethod
    def neutral(cls) -> GroundEffect:
        return cls(strength=0.0, height=0.12)

    def rotors(self, loads: RotorLoads, condition: Condition) -> RotorLoads:
        parameters = condition.parameters
        w, x, y, z = condition.quaternion
        along, across = hub_positions(parameters)
        center = condition.position[2] - rotate(condition.quaternion, Vec.unstack(parameters.center_of_gravity))[2]
        # The last row of the rotation matrix: height of a point relative to the centre.
        above = along * (2 * (x * z - w * y)) + across * (2 * (y * z + w * x)) + center
        return RotorLoads(loads.thrust * beside_surface(above, self.strength, self.height), loads.torque, loads.rate)


def beside_surface(distance: Vec, strength: Array, reach: Array) -> Vec:
    """Factors on the rotors' thrusts near a flat surface.

    Args:
        distance: distance of every rotor, m; behind the surface it counts as zero.
        strength: relative gain at `REFERENCE`.
        reach: distance at which half of the gain at the surface remains, m.
    """
    core = reach**2
    gain = strength * (core + REFERENCE**2)
    return distance.map(lambda a: 1 + gain / (core + jnp.where(a > 0, a, 0.0) ** 2))
