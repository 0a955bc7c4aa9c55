"""Downwash: the wake of another drone pushes this one down and, off its axis, tilts it.

The wake is a turbulent jet along the other drone's thrust T, from its centre. At the distance s along it, r beside it:

    u = w / b (1 + (sqrt(2) - 1) (r / b)^2)^-2,  b = width + spreading s,  w = sqrt(T / (0.805 pi rho))
    f_i = coefficient / 4 |u_i| u_i  on the hub of rotor i,  rho = 1.2 kg/m^3
    torque = lever sum_i (r_i x f_i)  about the rotors' centre

b is the radius at which the speed has fallen to half of that on the axis. The momentum of the jet is the thrust
(0.805 pi rho w^2 = T), so u does not depend on the size of the propellers. The air at s left the other drone the time
(width s + spreading s^2 / 2) / (convection w) ago; r and s are taken from where that drone was then, and which way it
pointed. ``coefficient`` contains the drag of the body and the thrust that the rotors lose in the inflow, ``lever`` the
moments of rotors and body in uneven air: about two for Crazyflies 2.1 that came below another (flights of
Neural-Swarm, 2020). The other drone is assumed to have this drone's mass. Within two and a half motor distances of the
other drone the wake is four jets rather than one; there the formula is an extrapolation.

The memory holds, for each other drone, its position and the vector -R e_z sqrt(T / m) along its wake, with derivatives
of both. A drone that flies alone has a wake of zero. Swarms (`cfb_mjx.model.swarm`) set the memory at every exchange,
logs of drones that flew together at every row; in between, and in predictions, the other drone flies on along these
polynomials.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Memory, Reading, Wrench
from cfb_mjx.model.effects.fields import hub_positions, number
from cfb_mjx.model.vector import Vec, rotate, rotate_inverse
from cfb_mjx.parameters.parameters import Limits, Parameters

AIR_DENSITY = 1.2
"""kg/m^3."""
MOMENTUM = 0.805 * math.pi * AIR_DENSITY
"""Momentum flux of the jet over the square of w, kg/m^3."""
LONGEST_S = 1.0
"""Greatest age of a wake, s. Older ones, more than about a metre and a half below, are taken to be of this age."""
ROUNDS = 3
"""Evaluations of where the other drone was when the air left it; each uses the age that follows from the one before."""
_FALL = math.sqrt(2.0) - 1.0
FORECAST, KNOWN = (3, 2), (6, 6)
"""Number of vectors of another drone's path, i.e. its position and derivatives, and of its wake: in a simulation, which
forecasts them from the present state, and along a log, where the whole path is known."""


class Other(NamedTuple):
    """Another drone, as the memory of `Downwash` holds it; world axes, SI."""

    path: tuple[Vec, ...]
    """Position and its derivatives."""
    wake: tuple[Vec, ...]
    """-R e_z sqrt(T / m), the root of the thrust over the mass along the wake, and its derivatives."""

    def memory(self) -> Vec:
        """As the memory of `Downwash` holds it."""
        return Vec(*(number for part in (*self.path, *self.wake) for number in part))

    def after(self, time: Any) -> Other:
        """The other drone after some time, s."""
        path, wake = (tuple(_later(own[k:], time) for k in range(len(own))) for own in self)
        return Other(path, wake)


def _later(derivatives: Sequence[Vec], time: Any) -> Vec:
    """Taylor series of a vector with these derivatives, of order zero and up."""
    total = derivatives[-1]
    for k in range(len(derivatives) - 1, 0, -1):
        total = derivatives[k - 1] + total * (time / k)
    return total


def others_in(memory: Memory) -> list[Other]:
    """The other drones in a memory of `Downwash`."""
    found = []
    for numbers in memory:
        path, wake = next(sizes for sizes in (FORECAST, KNOWN) if len(numbers) == 3 * sum(sizes))
        parts = tuple(Vec(*numbers[k : k + 3]) for k in range(0, 3 * (path + wake), 3))
        found.append(Other(parts[:path], parts[path:]))
    return found


class Downwash(Effect):
    """f_i = coefficient / 4 |u_i| u_i, with the air speed u_i in the jet of another drone at rotor i."""

    name: ClassVar[str] = "downwash"
    meaning: ClassVar[str] = "the wake of another drone pushes this one down"
    experiment: ClassVar[str] = "slow passes below another drone, at several distances"
    units: ClassVar[dict[str, str]] = {
        "coefficient": "N s^2/m^2",
        "width": "m",
        "spreading": "1",
        "convection": "1",
        "lever": "1",
    }
    source: ClassVar[str] = (
        "L. Bauersfeld, K. Muller, D. Ziegler, F. Coletti, D. Scaramuzza, Robotics meets Fluid Dynamics: A "
        "Characterization of the Induced Airflow below a Quadrotor as a Turbulent Jet, IEEE RA-L 2025 (spreading "
        "0.0767, virtual origin 5.8 motor distances above the drone); K. P. Jain, T. Fortmuller, J. Byun, S. "
        "Makiharju, M. Mueller, Modeling of aerodynamic disturbances for proximity flight of multirotors, ICUAS 2019; "
        "P. Davies, M. Fisher, M. Barratt, The characteristics of the turbulence in the mixing region of a round jet, "
        "J. Fluid Mech. 15, 1963 (convection)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "coefficient": (0.0, 0.03),
        "width": (0.01, 0.15),
        "spreading": (0.03, 0.25),
        "convection": (0.3, 1.5),
        "lever": (0.5, 3.0),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "coefficient": Limits(-1.0, 10.0, -0.001, 0.1),
        "width": Limits(1e-3, 10.0, 0.005, 0.5),
        "spreading": Limits(0.0, 2.0, 0.02, 0.5),
        "convection": Limits(0.05, 1e6, 0.2, 2.0),
        "lever": Limits(0.0, 100.0, 0.3, 4.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)
    needs: ClassVar[str | None] = "other"
    # A wake is narrow: it is found only if its age is known to a tenth of a second.
    probes: ClassVar[tuple[dict[str, float], ...]] = tuple(
        {"width": 0.045, "spreading": 0.0767, "convection": x, "lever": 1.0} for x in (0.4, 0.5, 0.62, 0.8, 1.1)
    )

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)
    """Force on the whole drone over the square of the air's speed."""
    width: Float[Array, "*batch"] = eqx.field(converter=number, default=0.045)
    """Distance from the axis at which the speed has fallen to half, beside the other drone."""
    spreading: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0767)
    """Growth of that distance per distance from the other drone."""
    convection: Float[Array, "*batch"] = eqx.field(converter=number, default=0.6)
    """Speed at which the wake moves on over the speed of the air on its axis; about 0.6 in turbulent round jets."""
    lever: Float[Array, "*batch"] = eqx.field(converter=number, default=1.0)
    """Torque over that of the forces at the hubs."""

    @classmethod
    def neutral(cls) -> Downwash:
        return cls(coefficient=0.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        zero = jnp.zeros_like(rotor_speed[0])
        return (Vec(*(zero,) * (3 * sum(KNOWN))),)

    def sense(self, memory: Memory, reading: Reading) -> Memory:
        if not reading.other:
            return memory
        # Selected before use: NaN passes through any weight, and through the derivative. An unknown drone has no wake.
        return tuple(
            Vec(*(jnp.where(jnp.isfinite(new[0]), x, 0.0).astype(m.dtype) for x, m in zip(new, old, strict=True)))
            for new, old in zip(reading.other, memory, strict=True)
        )

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        return tuple(other.after(dt).memory() for other in others_in(condition.memory))

    def wake_at(self, point: Vec, other: Other, parameters: Parameters) -> tuple[Vec, Vec]:
        """The part of another drone's wake that is near a point.

        Args:
            point: world, m.
            other: the other drone.
            parameters: of a drone of the same mass.

        Returns:
            Where the other drone was when this air left it, m, and the vector w along the wake, m^2/s; world.
        """
        strength = jnp.sqrt(parameters.mass / MOMENTUM)
        size = jnp.sqrt(other.wake[0].dot(other.wake[0]) + 1e-9)
        pace = self.convection * strength * size
        age: Any = 0.0
        place, wake = other.path[0], other.wake[0]
        for _ in range(ROUNDS):
            axis = wake * (1 / size)
            along = (point - place).dot(axis)
            below = jnp.where(along > 0, along, 0.0)
            # Newton's method for the age at which the air has travelled as far. Where the other drone sinks as fast as
            # its wake there is no such age; the slope is limited.
            missing = below * (self.width + 0.5 * self.spreading * below) - pace * age
            slope = (self.width + self.spreading * below) * _later(other.path[1:], -age).dot(axis) - pace
            age = age - missing / jnp.minimum(slope, -0.2 * pace)
            age = jnp.minimum(jnp.maximum(age, 0.0), LONGEST_S)
            place, wake = _later(other.path, -age), _later(other.wake, -age)
        return place, wake * strength

    def air_velocity(self, away: Vec, wake: Vec) -> Vec:
        """Velocity of the air in a wake, world, m/s.

        Args:
            away: point, relative to where the wake began, world, m.
            wake: the vector w along the wake, world, m^2/s.
        """
        axis = wake * (1 / jnp.sqrt(wake.dot(wake) + 1e-9))
        along = away.dot(axis)
        beside = away.dot(away) - along * along
        b = self.width + self.spreading * jnp.where(along > 0, along, 0.0)
        profile = 1 / (1 + _FALL * beside / b**2)
        begins = 0.5 * (1 + jnp.tanh(2 * along / self.width))
        return wake * (begins * profile * profile / b)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        parameters = condition.parameters
        center = condition.position - rotate(condition.quaternion, Vec.unstack(parameters.center_of_gravity))
        wakes = [self.wake_at(center, other, parameters) for other in others_in(condition.memory)]
        force, torque = wrench.force, Vec(0.0, 0.0, 0.0)
        for x, y in zip(*hub_positions(parameters), strict=True):
            hub = center + rotate(condition.quaternion, Vec(x, y, 0.0))
            air = Vec(0.0, 0.0, 0.0)
            for place, wake in wakes:
                air = air + self.air_velocity(hub - place, wake)
            size = jnp.sqrt(air.dot(air) + 1e-12)
            fx, fy, fz = pushed = rotate_inverse(condition.quaternion, air * (0.25 * self.coefficient * size))
            force = force + pushed
            torque = torque + Vec(y * fz, -x * fz, x * fy - y * fx)
        return Wrench(force, wrench.torque + self.lever * torque)
