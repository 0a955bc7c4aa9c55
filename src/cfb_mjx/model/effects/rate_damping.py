"""Roll and pitch braked by the rotor discs: a disc that turns with the body meets air along its axis at its edge.

    tau -= coefficient (Omega / 1594 rad/s) (omega_x, omega_y, 0)

with the mean rotor speed. Beside the hubs' own motion up and down, which `inflow_thrust` has, every disc feels its own
turning: by blade-element theory ``rho a c Omega R^4 / 16`` per blade, 5e-6 N m s for a propeller of the Crazyflie
Brushless, four times that for the drone.

Predictions of flights under a controller ask for more. Commands that answer a disturbance act on a simulated drone that
feels no disturbance; a brake makes it follow them less. Compare what the innovations say (``innovations`` in the report
of `cfb close-loop`) before you believe in it as physics. Not searched for by itself, only where a drone's effects are
fitted together: filters of a gyro and slow motors look like it.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import mean_hover_ratio, number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.limits import Limits


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
    """Of the four rotors together at hover speed."""

    @classmethod
    def neutral(cls) -> RateDamping:
        return cls(coefficient=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        wx, wy, _ = condition.body_rate
        c = self.coefficient * mean_hover_ratio(condition)
        return Wrench(wrench.force, wrench.torque - Vec(c * wx, c * wy, 0.0))
