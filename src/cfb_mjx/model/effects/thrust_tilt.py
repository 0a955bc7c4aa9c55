"""Thrust that does not point along body z: tilted rotors, or body axes that the estimator sees tilted.

    F_i = f_i (tilt + twist t_i),  tau += r_i x F_i

on each rotor i, where f_i is its thrust, r_i its position and t_i the tangent counter-clockwise round the drone; small
angles. The common tilt of the rotors (``tilt``) moves the force sideways; a tilt of every rotor in the same direction
round the drone (``twist``) causes a yaw torque. If the rotors' thrusts differ, the first also causes a torque and the
second a force. The tilt of the reaction torques is left out.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.cog_offset import CogOffset
from cfb_mjx.model.effects.fields import hub_positions, number, vector
from cfb_mjx.model.vector import Vec
from cfb_mjx.optional import not_none
from cfb_mjx.parameters.parameters import Limits


class ThrustTilt(Effect):
    """F_i = f_i (tilt + twist t_i) on each rotor, tau += r_i x F_i."""

    name: ClassVar[str] = "thrust_tilt"
    meaning: ClassVar[str] = "the thrust does not point along the body's z axis"
    experiment: ClassVar[str] = CogOffset.experiment
    units: ClassVar[dict[str, str]] = {"tilt": "rad", "twist": "rad"}
    source: ClassVar[str] = (
        "G. Michieletto, M. Ryll, A. Franchi, Fundamental actuation properties of multirotors, IEEE T-RO 34(3), "
        "2018 (thrust along tilted axes)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"tilt": (-0.05, 0.05), "twist": (-0.05, 0.05)}
    limits: ClassVar[dict[str, Limits]] = {
        "tilt": Limits(-0.8, 0.8, -0.2, 0.2),
        "twist": Limits(-0.8, 0.8, -0.2, 0.2),
    }
    strengths: ClassVar[tuple[str, ...]] = ("tilt", "twist")

    tilt: Float[Array, "*batch 2"] = eqx.field(converter=vector(2))
    """Tilt of the thrust towards body x and y."""
    twist: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0)
    """Tilt of every rotor counter-clockwise round the drone, seen from above."""

    @classmethod
    def neutral(cls) -> ThrustTilt:
        return cls(tilt=0.0, twist=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        x, y = hub_positions(condition.parameters)
        along_x, along_y = Vec.unstack(self.tilt)
        # `Effect.body` always receives the loads.
        thrust = not_none(condition.loads).thrust
        round_ = self.twist / (condition.parameters.rotor_spacing * 0.5**0.5)
        force_x, force_y = thrust * (along_x + -round_ * y), thrust * (along_y + round_ * x)
        turn = (x * force_y - y * force_x).sum()
        return Wrench(wrench.force + Vec(force_x.sum(), force_y.sum(), 0.0), wrench.torque + Vec(0.0, 0.0, turn))
