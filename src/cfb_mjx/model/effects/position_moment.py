"""A moment that depends on the position: air that moves in a room, or a biased velocity column.

A drone's jet entrains the air around it, sinks, spreads on the floor and rises along the walls. In a closed room the
air above the floor therefore moves towards the place where the jet goes down most of the time, faster at larger
distances: a wind w = -convergence (p - middle). Flight through it acts like a faster flight outwards (`blade_flapping`)
with one gradient along each of the world's horizontal axes:

    tau = (Omega / 1594 rad/s) (-q_y, q_x, 0),  q = R^T (gradient * (p_x, p_y, 0))

where Omega is the mean rotor speed. The gradient divided by the coefficient of `blade_flapping` is the convergence. An
on-board estimator whose velocity is biased towards the middle has the same effect on predictions that start from the
velocity column. Before you believe in moving air, compare the column with the derivative of the position, and check the
accelerometer, which measures the drag of such air. The middle is the origin of the positions; another middle adds a
constant torque, which `cog_offset` describes.

`cfb close-loop` does not propose it alone, because cables and walls also act by position; it fits it where it fits all
effects of a plant together. ``cfb refine`` fits it by name.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import mean_hover_ratio, vector
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters.parameters import Limits


class PositionMoment(Effect):
    """tau = (Omega / 1594) (-q_y, q_x, 0) with q = R^T (gradient * (p_x, p_y, 0))."""

    name: ClassVar[str] = "position_moment"
    meaning: ClassVar[str] = "a torque depends on the position, as in air that moves towards the middle of a room"
    experiment: ClassVar[str] = "slow passes through the whole room, and the same passes in a larger one"
    units: ClassVar[dict[str, str]] = {"gradient": "N"}
    source: ClassVar[str] = (
        "F. Ricou, D. Spalding, Measurements of entrainment by axisymmetrical turbulent jets, J. Fluid Mech. 11(1), "
        "1961"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"gradient": (-5e-4, 5e-4)}
    limits: ClassVar[dict[str, Limits]] = {"gradient": Limits(-0.1, 0.1, -0.002, 0.002)}
    strengths: ClassVar[tuple[str, ...]] = ("gradient",)
    searched: ClassVar[bool] = False

    gradient: Float[Array, "*batch 2"] = eqx.field(converter=vector(2))
    """Torque per distance from the middle along the world's x and y axes."""

    @classmethod
    def neutral(cls) -> PositionMoment:
        return cls(gradient=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        ratio = mean_hover_ratio(condition)
        along_x, along_y = Vec.unstack(self.gradient)
        x, y, _ = condition.position
        q = rotate_inverse(condition.quaternion, Vec(along_x * x * ratio, along_y * y * ratio, 0.0 * x))
        return Wrench(wrench.force, wrench.torque + Vec(-q[1], q[0], 0.0))
