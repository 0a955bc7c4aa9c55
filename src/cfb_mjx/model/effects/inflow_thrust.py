"""Thrust lost to axial inflow: climbing along the rotor's axis reduces the angle of attack of its blades.

    f_i -= coefficient (Omega_i / 1594 rad/s) (v + omega x r_i)_z

where v is the velocity through the air in body axes. The effect acts rotor by rotor: it damps heave and, through the
motion of the hubs, roll and pitch. With a positive coefficient a climbing rotor loses thrust. The change is not
clamped; it vanishes by itself near zero rotor speed.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect
from cfb_mjx.model.effects.fields import HOVER_SPEED, hub_velocities, number
from cfb_mjx.model.rotors import RotorLoads
from cfb_mjx.parameters.parameters import Limits


class InflowThrust(Effect):
    """f_i -= coefficient (Omega_i / 1594) v_i,z."""

    name: ClassVar[str] = "inflow_thrust"
    meaning: ClassVar[str] = "thrust falls in climb and grows in descent"
    experiment: ClassVar[str] = "climbs and dives at 0.5 to 2 m/s"
    units: ClassVar[dict[str, str]] = {"coefficient": "N s/m"}
    source: ClassVar[str] = (
        "J. G. Leishman, Principles of Helicopter Aerodynamics, 2nd ed. 2006, ch. 3; H. Huang, G. Hoffmann, S. "
        "Waslander, C. Tomlin, Aerodynamics and control of autonomous quadrotor helicopters in aggressive "
        "maneuvering, ICRA 2009"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (-0.01, 0.03)}
    limits: ClassVar[dict[str, Limits]] = {"coefficient": Limits(-1.0, 1.0, -0.05, 0.2)}
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)
    feels_air: ClassVar[bool] = True

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)
    """Thrust lost per velocity, per rotor at hover speed."""

    @classmethod
    def neutral(cls) -> InflowThrust:
        return cls(coefficient=0.0)

    def rotors(self, loads: RotorLoads, condition: Condition) -> RotorLoads:
        _, _, axial = hub_velocities(condition)
        lost = condition.rotor_speed * axial * (self.coefficient / HOVER_SPEED)
        return RotorLoads(loads.thrust - lost, loads.torque, loads.rate)
