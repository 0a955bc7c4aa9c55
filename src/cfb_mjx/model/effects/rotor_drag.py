"""Rotor drag: a spinning rotor resists motion along its disc (induced drag and H-force).

On each rotor i, where v_i = v + omega x r_i is the velocity of its hub through the air in body axes:

    F_i,xy = -(coefficient / 4) (Omega_i / 1594 rad/s) v_i,xy

The force acts at the hub, so it also damps yaw.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import HOVER_SPEED, hub_positions, hub_velocities, number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits


class RotorDrag(Effect):
    """F_xy = -coefficient (Omega / 1594) v_xy, shared by the four rotors."""

    name: ClassVar[str] = "rotor_drag"
    meaning: ClassVar[str] = "the rotors drag against sideways motion, in proportion to speed"
    experiment: ClassVar[str] = "straight passes at constant speed, 0.5 to 3 m/s, back and forth, along both body axes"
    units: ClassVar[dict[str, str]] = {"coefficient": "N s/m"}
    source: ClassVar[str] = (
        "P. Martin, E. Salaun, The true role of accelerometer feedback in quadrotor control, ICRA 2010; M. "
        "Faessler, A. Franchi, D. Scaramuzza, RA-L 3(2), 2018"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 0.05)}
    limits: ClassVar[dict[str, Limits]] = {"coefficient": Limits(0.0, 10.0, 0.0, 0.2)}
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)
    feels_air: ClassVar[bool] = True

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)
    """Force per velocity of the four rotors together at hover speed."""

    @classmethod
    def neutral(cls) -> RotorDrag:
        return cls(coefficient=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        x, y = hub_positions(condition.parameters)
        along_x, along_y, _ = hub_velocities(condition)
        share = condition.rotor_speed * (-0.25 / HOVER_SPEED * self.coefficient)
        force_x, force_y = share * along_x, share * along_y
        yaw = (x * force_y - y * force_x).sum()
        return Wrench(wrench.force + Vec(force_x.sum(), force_y.sum(), 0.0), wrench.torque + Vec(0.0, 0.0, yaw))
