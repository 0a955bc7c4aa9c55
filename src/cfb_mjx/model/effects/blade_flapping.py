"""Hub moments of rotors that move along their discs: the advancing blade lifts more than the retreating one.

The disc tilts or, if the blades are stiff, the hub is twisted:

    tau_x = c (-(1 - anisotropy) exp(climb_y v_z) v_y + cross v_x)
    tau_y = c ((1 + anisotropy) exp(climb_x v_z) v_x + cross v_y)
    c = coefficient (Omega / 1594 rad/s)^power exp(fading |v_xy|)

where v is the velocity through the air in body axes and Omega the mean rotor speed. The sign is free, because stiffness
and the height of the discs above the rotors' centre have opposite effects. ``climb`` makes the moments depend on the
flow through the discs, without ever changing their sign. ``anisotropy`` makes the moment of flow along the body larger
than that of flow from the side, because the parts between the rotors (battery, decks) are longer than wide. A disc
responds late, which turns its moment in its direction of rotation. Over four rotors this cancels up to the differences
between them; ``cross`` is what remains. ``fading`` is negative where the wake is blown away and the moment grows less
than in proportion to the speed.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import mean_hover_ratio, number, vector
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits

STILL = 0.01
"""Speed that is added to the speed along the discs (root of the sum of squares), so that it is differentiable at rest,
m/s."""


class BladeFlapping(Effect):
    """Tau = c (cross v_x - (1 - anisotropy) v_y, cross v_y + (1 + anisotropy) v_x, 0), weaker or stronger in climb."""

    name: ClassVar[str] = "blade_flapping"
    meaning: ClassVar[str] = "sideways motion tilts the rotor discs and turns the body"
    experiment: ClassVar[str] = (
        "straight passes at constant speed, 0.5 to 3 m/s, back and forth, along both body axes, repeated while climbing"
    )
    units: ClassVar[dict[str, str]] = {
        "coefficient": "N s",
        "climb": "s/m",
        "anisotropy": "1",
        "power": "1",
        "cross": "1",
        "fading": "s/m",
    }
    source: ClassVar[str] = (
        "R. Mahony, V. Kumar, P. Corke, Multirotor aerial vehicles, IEEE RAM 19(3), 2012; G. Hoffmann, H. Huang, S."
        " Waslander, C. Tomlin, Quadrotor helicopter flight dynamics and control: theory and experiment, AIAA GNC "
        "2007"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "coefficient": (-0.001, 0.001),
        "climb": (-0.5, 0.5),
        "anisotropy": (-0.5, 0.5),
        "power": (0.0, 3.0),
        "cross": (-0.5, 0.5),
        "fading": (-0.3, 0.3),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "coefficient": Limits(-0.1, 0.1, -0.004, 0.004),
        "climb": Limits(-2.0, 2.0, -1.5, 1.5),
        "anisotropy": Limits(-1.0, 1.0, -1.0, 1.0),
        "power": Limits(-2.0, 6.0, -0.5, 4.0),
        "cross": Limits(-10.0, 10.0, -1.5, 1.5),
        "fading": Limits(-2.0, 2.0, -1.0, 1.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)
    feels_air: ClassVar[bool] = True
    # The search starts at zero, with the power of blade theory, and fits all of them once the moment is found.
    probes: ClassVar[tuple[dict[str, float], ...]] = (
        {"climb": 0.0, "anisotropy": 0.0, "power": 1.0, "cross": 0.0, "fading": 0.0},
    )

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)
    """Moment per velocity of the four rotors together at hover speed."""
    climb: Float[Array, "*batch 2"] = eqx.field(converter=vector(2))
    """Relative change, per velocity along body z, of the moments due to motion along body x and y."""
    anisotropy: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0)
    """Share by which pitching moments exceed, and rolling moments fall short of, their mean."""
    power: Float[Array, "*batch"] = eqx.field(converter=number, default=1.0)
    """Exponent of the mean rotor speed: 1 in blade theory at fixed pitch, 2 if proportional to thrust."""
    cross: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0)
    """Ratio of the moment about the direction of motion to the moment across it."""
    fading: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0)
    """Relative change of the moments per airspeed along the discs."""

    @classmethod
    def neutral(cls) -> BladeFlapping:
        return cls(coefficient=0.0, climb=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        vx, vy, vz = condition.airspeed_body
        along = jnp.sqrt(vx**2 + vy**2 + STILL**2)
        c = self.coefficient * mean_hover_ratio(condition) ** self.power * jnp.exp(self.fading * along)
        along_x, along_y = (jnp.exp(climb * vz) for climb in Vec.unstack(self.climb))
        roll = self.cross * vx - (1 - self.anisotropy) * along_y * vy
        pitch = self.cross * vy + (1 + self.anisotropy) * along_x * vx
        return Wrench(wrench.force, wrench.torque + Vec(c * roll, c * pitch, 0.0))
