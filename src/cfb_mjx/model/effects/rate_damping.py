"""Damping of roll and pitch by the rotor discs: the edges of a disc that turns with the body move along its axis.

    tau -= coefficient (Omega / 1594 rad/s) (omega_x, omega_y, 0)

where Omega is the mean rotor speed. `inflow_thrust` already has the motion of the hubs; in addition every disc responds
to its own rotation. Blade-element theory gives ``rho a c Omega R^4 / 16`` per blade, 5e-6 N m s for a propeller of the
Crazyflie Brushless and four times that for the drone.

Predictions of flights under a controller ask for more damping than that. The logged commands are the controller's
response to disturbances, and the simulated drone has no disturbances; with damping it follows such commands less.
Before you believe in the damping as physics, look at the innovations (``innovations`` in the report of `cfb
close-loop`). The search does not look for it by itself, only where the effects of a drone are fitted together, because
gyro filters and slow motors look like it.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import mean_hover_ratio, number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits


class RateDamping(Effect):
    """tau -= coefficient (Omega / 1594) (omega_x, omega_y, 0)."""

    name: ClassVar[str] = "rate_damping"
    meaning: ClassVar[str] = (
        "roll and pitch are braked, by rotor discs that turn with the body or by what stands behind it"
    )
    experiment: ClassVar[str] = "doublets in roll and pitch at hover, rotor speeds logged (cfb excite roll-pitch)"
    units: ClassVar[dict[str, str]] = {"coefficient": "N m s"}
    source: ClassVar[str] = (
        "P. Pounds, R. Mahony, P. Corke, Modelling and control of a large quadrotor robot, Control Engineering Practice"
        " 18(7), 2010; A. Bramwell, Helicopter Dynamics, 2nd ed. 2001, ch. 3"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 2e-4)}
    limits: ClassVar[dict[str, Limits]] = {"coefficient": Limits(-0.01, 0.01, -2e-4, 1e-3)}
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)
    searched: ClassVar[bool] = False

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)
    """Torque per body rate of the four rotors together at hover speed."""

    @classmethod
    def neutral(cls) -> RateDamping:
        return cls(coefficient=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        wx, wy, _ = condition.body_rate
        c = self.coefficient * mean_hover_ratio(condition)
        return Wrench(wrench.force, wrench.torque - Vec(c * wx, c * wy, 0.0))
