"""A propeller that is nicked, bent or of another type: one rotor gives less thrust and more torque at the same speed.

    thrust_scale_m *= 1 + thrust,   torque_scale_m *= 1 + torque

for one motor m (1 to 4, as in logs). A motor that turns at another speed is `motor_gain_mismatch`; measured rotor
speeds tell the two apart.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.fields import number
from cfb_mjx.parameters.parameters import Limits, Parameters


class PropDamage(Effect):
    """thrust_scale_m *= 1 + thrust, torque_scale_m *= 1 + torque for one motor m."""

    name: ClassVar[str] = "prop_damage"
    meaning: ClassVar[str] = "one propeller pulls less or drags more than the others"
    experiment: ClassVar[str] = "climbs and yaw turns, rotor speeds logged; then the same with propellers exchanged"
    units: ClassVar[dict[str, str]] = {"thrust": "1", "torque": "1", "motor": "1"}
    source: ClassVar[str] = (
        "G. Iannace, G. Ciaburro, A. Trematerra, Fault diagnosis for UAV blades using artificial neural network, "
        "Robotics 8(3), 2019 (nicked blades: less thrust, more torque at one rotor)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "thrust": (-0.3, 0.3),
        "torque": (-0.4, 0.4),
        "motor": (1.0, 4.0),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "thrust": Limits(-1.0, 5.0, -0.6, 0.6),
        "torque": Limits(-1.0, 5.0, -0.8, 2.0),
        "motor": Limits(1.0, 4.0, 1.0, 4.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("thrust", "torque")
    probes: ClassVar[tuple[dict[str, float], ...]] = tuple({"motor": float(m)} for m in (1, 2, 3, 4))
    assumed: ClassVar[tuple[str, ...]] = ("motor",)

    thrust: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of the rotor's thrust."""
    torque: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of the rotor's aerodynamic torque."""
    motor: Float[Array, "*batch"] = eqx.field(converter=number, default=1.0)
    """Number of the motor, 1 to 4."""

    @classmethod
    def neutral(cls) -> PropDamage:
        return cls(thrust=0.0, torque=0.0)

    def change(self, parameters: Parameters) -> Parameters:
        its = jnp.arange(1, 5) == jnp.round(self.motor)[..., None]
        changed = [
            parameters.thrust_scale * jnp.where(its, 1 + self.thrust[..., None], 1.0),
            parameters.torque_scale * jnp.where(its, 1 + self.torque[..., None], 1.0),
        ]
        return eqx.tree_at(lambda p: (p.thrust_scale, p.torque_scale), parameters, changed)
