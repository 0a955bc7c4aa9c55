"""Translational lift: a rotor that moves sideways through the air meets more air and lifts more.

    f_i += coefficient (v_i,x^2 + v_i,y^2)

where v_i is the velocity of the hub through the air in body axes. This is the part of the blade elements' thrust that
grows with the square of the sideways velocity at any rotor speed; the decrease of the induced velocity adds to it.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect
from cfb_mjx.model.effects.fields import hub_velocities, number
from cfb_mjx.model.rotors import RotorLoads
from cfb_mjx.parameters.parameters import Limits


class TranslationalLift(Effect):
    """f_i += coefficient (v_i,x^2 + v_i,y^2)."""

    name: ClassVar[str] = "translational_lift"
    meaning: ClassVar[str] = "thrust grows in fast horizontal flight"
    experiment: ClassVar[str] = "level passes at 1, 2 and 4 m/s, both ways"
    units: ClassVar[dict[str, str]] = {"coefficient": "N s^2/m^2"}
    source: ClassVar[str] = (
        "J. Svacha, K. Mohta, V. Kumar, Improving quadrotor trajectory tracking by compensating for aerodynamic "
        "effects, ICUAS 2017; J. G. Leishman, Principles of Helicopter Aerodynamics, 2nd ed. 2006, ch. 3"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (-0.001, 0.004)}
    limits: ClassVar[dict[str, Limits]] = {"coefficient": Limits(-0.1, 0.1, -0.005, 0.02)}
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)
    feels_air: ClassVar[bool] = True

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)
    """Additional thrust per squared velocity, per rotor."""

    @classmethod
    def neutral(cls) -> TranslationalLift:
        return cls(coefficient=0.0)

    def rotors(self, loads: RotorLoads, condition: Condition) -> RotorLoads:
        x, y, _ = hub_velocities(condition)
        return RotorLoads(loads.thrust + self.coefficient * (x * x + y * y), loads.torque, loads.rate)
