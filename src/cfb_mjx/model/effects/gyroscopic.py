"""Gyroscopic torque of the spinning rotors:

    tau = -omega x h,   h = scale J_m sum_i(-yaw_i Omega_i) e_z

where J_m is the model's own moment of inertia of a rotor (``rotor_inertia``), so that a scale of 1 is physics and 0 the
paper's model. yaw_i is the sign of rotor i's reaction torque on the body; the rotor spins in the opposite direction.
The torque is perpendicular to the body rate and does no work.
"""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.rotors import YAW_SIGNS
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters


class Gyroscopic(Effect):
    """tau = -omega x h with h the angular momentum of the rotors."""

    name: ClassVar[str] = "gyroscopic"
    meaning: ClassVar[str] = "the spinning rotors resist being turned"
    experiment: ClassVar[str] = "fast roll and pitch while climbing hard: rates at high rotor speed"
    units: ClassVar[dict[str, str]] = {"scale": "1"}
    source: ClassVar[str] = (
        "S. Bouabdallah, Design and control of quadrotors with application to autonomous flying, EPFL thesis 3727, 2007"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"scale": (0.0, 4.0)}
    limits: ClassVar[dict[str, Limits]] = {"scale": Limits(0.0, 1000.0, 0.0, 20.0)}
    strengths: ClassVar[tuple[str, ...]] = ("scale",)

    scale: Float[Array, "*batch"] = eqx.field(converter=number)
    """Factor on the angular momentum of the rotors that follows from the model's J_m."""

    @classmethod
    def neutral(cls) -> Gyroscopic:
        return cls(scale=0.0)

    @classmethod
    def migrated(cls, values: Mapping, parameters: Parameters | None) -> Mapping:
        if "rotor_inertia" not in values:
            return values
        values = dict(values)
        absolute, own = values.pop("rotor_inertia"), None if parameters is None else float(parameters.rotor_inertia)
        if not own or not isinstance(absolute, Real):
            raise CfbError(
                "effects.gyroscopic.parameters.rotor_inertia is now a factor on the model's own rotor_inertia; write "
                "scale instead (1 for its full value), and give the model a rotor_inertia above zero."
            )
        return values | {"scale": absolute / own}

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        momentum = -self.scale * condition.parameters.rotor_inertia * condition.rotor_speed.dot(YAW_SIGNS)
        return Wrench(wrench.force, wrench.torque - condition.body_rate.cross(Vec(0.0, 0.0, momentum)))
