"""Hub moments of rotors moved along their discs: the advancing blade lifts more than the retreating one.

The disc tilts or, on stiff blades, the hub is twisted:

    tau_x = -(1 - anisotropy) c v_y,  tau_y = (1 + anisotropy) c v_x
    c = coefficient (Omega / 1594 rad/s) exp(climb v_z)

with v the velocity through the air, in body axes, and the mean rotor speed. The sign is free, because stiffness and the
height of the discs over the rotors' centre pull in opposite directions. ``climb`` lets the moment depend on the flow
through the discs, without ever turning it round. With ``anisotropy`` flow along the body twists it more than flow from
the side, for what sits between the rotors (battery, decks) is longer than wide.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import mean_hover_ratio, number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.limits import Limits


class BladeFlapping(Effect):
    """tau = coefficient (Omega / 1594) exp(climb v_z) (-(1 - anisotropy) v_y, (1 + anisotropy) v_x, 0)."""

    name: ClassVar[str] = "blade_flapping"
    meaning: ClassVar[str] = "sideways motion tilts the rotor discs and turns the body"
    experiment: ClassVar[str] = (
        "straight passes at constant speed, 0.5 to 3 m/s, forth and back and in both body axes, repeated while climbing"
    )
    units: ClassVar[dict[str, str]] = {"coefficient": "N s", "climb": "s/m", "anisotropy": "1"}
    source: ClassVar[str] = (
        "R. Mahony, V. Kumar, P. Corke, Multirotor aerial vehicles, IEEE RAM 19(3), 2012; G. Hoffmann, H. Huang, S."
        " Waslander, C. Tomlin, Quadrotor helicopter flight dynamics and control: theory and experiment, AIAA GNC "
        "2007"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "coefficient": (-0.001, 0.001),
        "climb": (-0.5, 0.5),
        "anisotropy": (-0.5, 0.5),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "coefficient": Limits(-0.1, 0.1, -0.004, 0.004),
        "climb": Limits(-2.0, 2.0, -1.5, 1.5),
        "anisotropy": Limits(-1.0, 1.0, -1.0, 1.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)
    feels_air: ClassVar[bool] = True
    # Both are looked for at zero, and fitted once the moment is there.
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"climb": 0.0, "anisotropy": 0.0},)

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)
    """Of the four rotors together at hover speed."""
    climb: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of the moment per velocity along body z."""
    anisotropy: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0)
    """By which share pitching moments exceed, and rolling moments fall short of, their mean."""

    @classmethod
    def neutral(cls) -> BladeFlapping:
        return cls(coefficient=0.0, climb=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        vx, vy, vz = condition.airspeed_body
        c = self.coefficient * mean_hover_ratio(condition) * jnp.exp(self.climb * vz)
        return Wrench(
            wrench.force, wrench.torque + Vec(-(1 - self.anisotropy) * c * vy, (1 + self.anisotropy) * c * vx, 0.0)
        )
