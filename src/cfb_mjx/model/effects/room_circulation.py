"""Air that circulates in a closed room: a horizontal wind that changes with the place.

A drone's jet draws in the air around it, sinks, spreads on the floor and rises along the walls. Above the floor the air
therefore moves towards where the jet goes down most of the time, the faster the farther out: a wind
w = -convergence (p - middle). Flying through it feels like flying faster outwards, as a hub moment (`blade_flapping`)
and as a drag (`rotor_drag`), with one gradient along each of the world's horizontal axes:

    tau = (Omega / 1594 rad/s) (-q_y, q_x, 0),  q = R^T (moment_gradient * (p_x, p_y, 0))
    F = -(Omega / 1594 rad/s) R^T (drag_gradient * (p_x, p_y, 0))

with the mean rotor speed. Both gradients together tell air from anything else that hangs on the place: over the
coefficient of `blade_flapping` and of `rotor_drag` both are the same convergence. The middle of the room is the origin
of the positions; another one adds a constant torque, which `cog_offset` takes, and a constant force.

Not searched for by `cfb close-loop`: cables and walls act by the place as well. Name it to ``cfb refine``.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import mean_hover_ratio, vector
from cfb_mjx.model.vector import Vec, rotate_inverse


class RoomCirculation(Effect):
    """q = R^T (moment_gradient * p), tau = (Omega / 1594) (-q_y, q_x, 0),
    F = -(Omega / 1594) R^T (drag_gradient * p)."""

    name: ClassVar[str] = "room_circulation"
    units: ClassVar[dict[str, str]] = {"moment_gradient": "N", "drag_gradient": "N/m"}
    source: ClassVar[str] = (
        "F. Ricou, D. Spalding, Measurements of entrainment by axisymmetrical turbulent jets, J. Fluid Mech. 11(1), "
        "1961"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"moment_gradient": (-5e-4, 5e-4), "drag_gradient": (-0.02, 0.02)}
    strengths: ClassVar[tuple[str, ...]] = ("moment_gradient", "drag_gradient")
    searched: ClassVar[bool] = False

    moment_gradient: Float[Array, "*batch 2"] = eqx.field(converter=vector(2))
    """Torque per distance along the world's x and y axes."""
    drag_gradient: Float[Array, "*batch 2"] = eqx.field(converter=vector(2))
    """Force per distance along them."""

    @classmethod
    def neutral(cls) -> RoomCirculation:
        return cls(moment_gradient=0.0, drag_gradient=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        ratio = mean_hover_ratio(condition)
        x, y, _ = condition.position
        moment, drag = (
            rotate_inverse(condition.quaternion, Vec(along_x * x * ratio, along_y * y * ratio, 0.0 * x))
            for along_x, along_y in (Vec.unstack(self.moment_gradient), Vec.unstack(self.drag_gradient))
        )
        return Wrench(wrench.force - drag, wrench.torque + Vec(-moment[1], moment[0], 0.0))
