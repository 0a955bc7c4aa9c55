"""Gyroscopic torque of the turning rotors:

    tau = -omega x h,   h = rotor_inertia * sum_i(-yaw_i Omega_i) e_z

where yaw_i is the sign of rotor i's reaction on the body (a rotor that pushes the body one way turns the other way).
The torque is at right angles to the body rate: it does no work.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.rotors import YAW_SIGNS
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.limits import Limits


class Gyroscopic(Effect):
    """tau = -omega x h with h the angular momentum of the rotors."""

    name: ClassVar[str] = "gyroscopic"
    meaning: ClassVar[str] = "the spinning rotors resist being turned"
    experiment: ClassVar[str] = "fast roll and pitch while climbing hard: rates at high rotor speed"
    units: ClassVar[dict[str, str]] = {"rotor_inertia": "kg m^2"}
    source: ClassVar[str] = (
        "S. Bouabdallah, Design and control of quadrotors with application to autonomous flying, EPFL thesis 3727, 2007"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"rotor_inertia": (0.0, 2e-07)}
    limits: ClassVar[dict[str, Limits]] = {"rotor_inertia": Limits(0.0, 0.0001, 0.0, 1e-06)}
    strengths: ClassVar[tuple[str, ...]] = ("rotor_inertia",)

    rotor_inertia: Float[Array, "*batch"] = eqx.field(converter=number)
    """Of one rotor with its bell about its axis."""

    @classmethod
    def neutral(cls) -> Gyroscopic:
        return cls(rotor_inertia=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        momentum = -self.rotor_inertia * condition.rotor_speed.dot(YAW_SIGNS)
        return Wrench(wrench.force, wrench.torque - condition.body_rate.cross(Vec(0.0, 0.0, momentum)))
