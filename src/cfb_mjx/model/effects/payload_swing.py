"""A load on a string from a point on the rotors' axis: a spherical pendulum with a moving pivot.

    n'' = -(1 - n n^T) (a + g e_z) / length - |n'|^2 n - 2 damping_ratio sqrt(g / length) n'
    F_world = T n,  T = max(length |n'|^2 - n . F / M, 0) m M / (m + M)
    torque = (0, 0, pivot) x F,  about the rotors' centre, body axes

n is the unit vector from the drone to the load, a the drone's acceleration, M its mass and F the force (world) of
everything except gravity. The tension T follows from the constant length of the string. Where the string is tied below
the centre of gravity (``pivot`` negative), a sideways pull also turns the drone; the motion of the pivot relative to
the drone's centre is left out. A string cannot push; where it would be slack the load still moves on its sphere. The
memory holds n and n'; at the start the load hangs still.

Swings are hardly damped, and after a slack string nothing determines their state. Along a log the force that the model
does not explain therefore turns n towards the direction of the pull (a Luenberger observer).
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import CONSTRAINT, Condition, Effect, Memory, Wrench
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec, rotate, rotate_inverse
from cfb_mjx.parameters.parameters import Limits, Parameters

FOLLOWING = 8.0
"""Twice the damping of the observer's error along a log, 1/s."""
UNSURE = 0.5
"""Acceleration that the model may miss for other reasons, m/s^2: weaker pulls hardly show the string's direction."""
GAP = 0.05
"""Gap between rows, s, after which the load is assumed to hang still, opposite to the specific force."""


class PayloadSwing(Effect):
    """A load on a string tied to the drone on the rotors' axis."""

    name: ClassVar[str] = "payload_swing"
    meaning: ClassVar[str] = "a load swings below the drone"
    experiment: ClassVar[str] = "a sharp stop followed by a hover of five seconds: a load swings on"
    units: ClassVar[dict[str, str]] = {"mass": "kg", "length": "m", "damping_ratio": "1", "pivot": "m"}
    source: ClassVar[str] = (
        "K. Sreenath, T. Lee, V. Kumar, Geometric control and differential flatness of a quadrotor UAV with a "
        "cable-suspended load, CDC 2013"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "mass": (0.0, 0.015),
        "length": (0.05, 0.5),
        "damping_ratio": (0.002, 0.4),
        "pivot": (-0.04, 0.02),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "mass": Limits(0.0, 1.0, 0.0, 0.06),
        "length": Limits(0.005, 100.0, 0.02, 5.0),
        "damping_ratio": Limits(0.0, 10.0, 0.0, 1.0),
        "pivot": Limits(-1.0, 1.0, -0.1, 0.1),
    }
    strengths: ClassVar[tuple[str, ...]] = ("mass",)
    # The tension follows from all other forces.
    rank: ClassVar[int] = CONSTRAINT
    probes: ClassVar[tuple[dict[str, float], ...]] = (
        {"length": 0.1, "damping_ratio": 0.05, "pivot": 0.0},
        {"length": 0.15, "damping_ratio": 0.05, "pivot": 0.0},
        {"length": 0.25, "damping_ratio": 0.05, "pivot": 0.0},
    )

    mass: Float[Array, "*batch"] = eqx.field(converter=number)
    """Mass of the load."""
    length: Float[Array, "*batch"] = eqx.field(converter=number)
    """Length of the string."""
    damping_ratio: Float[Array, "*batch"] = eqx.field(converter=number, default=0.02)
    """Damping ratio of the swing."""
    pivot: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0)
    """Height of the point where the string is tied above the rotors' centre, along body z; negative below it."""

    @classmethod
    def neutral(cls) -> PayloadSwing:
        return cls(mass=0.0, length=0.15)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        zero = jnp.zeros_like(rotor_speed[0])
        return Vec(zero, zero, zero - 1.0), Vec(zero, zero, zero)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        along, turning = condition.memory
        mass, own = self.mass, condition.parameters.mass
        force = rotate(condition.quaternion, wrench.force)
        tension = jnp.maximum(self.length * turning.dot(turning) - along.dot(force) / own, 0.0)
        tension = tension * mass * own / (mass + own)
        pull = rotate_inverse(condition.quaternion, along * tension)
        x, y, _ = pull
        return Wrench(wrench.force + pull, wrench.torque + Vec(-self.pivot * y, self.pivot * x, 0.0))

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        along, turning = condition.memory
        gravity = condition.parameters.gravity
        felt = acceleration + Vec(0.0, 0.0, gravity)
        across = felt - along * along.dot(felt)
        # Without gravity there is no swing, and the square root has no derivative at zero.
        swings = gravity > 0
        damping = 2 * self.damping_ratio * jnp.sqrt(jnp.where(swings, gravity / self.length, 1.0)) * swings
        # Semi-implicit, like the body: the integration itself neither damps nor excites the swing.
        turning = turning - (across * (1 / self.length) + turning * damping) * dt
        along = along + turning * dt
        along = along * (1 / jnp.sqrt(along.dot(along)))
        return along, turning - along * along.dot(turning)

    def follow(self, condition: Condition, acceleration: Vec, missed: Vec, dt: Any) -> Memory:
        along, turning = self.advance(condition, acceleration, dt)
        felt = acceleration + Vec(0.0, 0.0, condition.parameters.gravity)
        mass, own = self.mass, condition.parameters.mass
        pull = mass / own * jnp.maximum(self.length * turning.dot(turning) - along.dot(felt), 0.0)
        # Tends to the angle of the error where the pull is strong, and to zero where it is weak.
        off = (missed - along * along.dot(missed)) * (pull / (pull * pull + UNSURE**2))
        along = along + off * (FOLLOWING * dt)
        turning = turning + off * (FOLLOWING**2 / 2 * dt)
        below = felt * (-1 / jnp.sqrt(felt.dot(felt) + 1e-6))
        gap = jnp.asarray(dt) > GAP
        along = Vec(*(jnp.where(gap, b, a) for a, b in zip(along, below, strict=True)))
        along = along * (1 / jnp.sqrt(along.dot(along)))
        turning = Vec(*(jnp.where(gap, 0.0, x) for x in turning))
        return along, turning - along * along.dot(turning)
