"""Ground effect: near the floor (world z = 0) a rotor gives more thrust.

    f_i *= 1 + strength / (1 + (z_i / height)^2)

with z_i the height of rotor i, from the position of the rotors' centre and the tilt; below the floor it counts as zero.
Far up the gain falls as 1/z^2, as Cheeseman and Bennett's 1 / (1 - (R / 4 z)^2) does (there strength * height^2 =
R^2 / 16); unlike theirs it stays finite at the floor.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect
from cfb_mjx.model.effects.fields import hub_positions, number
from cfb_mjx.model.rotors import RotorLoads
from cfb_mjx.model.vector import rotate


class GroundEffect(Effect):
    """f_i *= 1 + strength / (1 + (z_i / height)^2)."""

    name: ClassVar[str] = "ground_effect"
    units: ClassVar[dict[str, str]] = {"strength": "1", "height": "m"}
    source: ClassVar[str] = (
        "I. Cheeseman, W. Bennett, The effect of the ground on a helicopter rotor in forward flight, ARC R&M 3021, "
        "1955; P. Sanchez-Cuevas, G. Heredia, A. Ollero, Int. J. Aerospace Eng. 2017, 1823056"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"strength": (0.0, 0.5), "height": (0.05, 0.3)}
    strengths: ClassVar[tuple[str, ...]] = ("strength",)
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"height": 0.06}, {"height": 0.12}, {"height": 0.25})

    strength: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative gain of thrust at the floor."""
    height: Float[Array, "*batch"] = eqx.field(converter=number)
    """Height at which half of the gain is left."""

    @classmethod
    def neutral(cls) -> GroundEffect:
        return cls(strength=0.0, height=0.12)

    def rotors(self, loads: RotorLoads, condition: Condition) -> RotorLoads:
        parameters = condition.parameters
        w, x, y, z = condition.quaternion
        along, across = hub_positions(parameters)
        center = condition.position[2] - rotate(condition.quaternion, parameters.center_of_gravity)[2]
        # The last row of the rotation matrix: how high a point beside the centre lies.
        above = along * (2 * (x * z - w * y)) + across * (2 * (y * z + w * x)) + center
        ratio = above.map(lambda h: jnp.where(h > 0, h, 0.0)) / self.height
        factor = ratio.map(lambda r: 1 + self.strength / (1 + r * r))
        return RotorLoads(loads.thrust * factor, loads.torque, loads.rate)
