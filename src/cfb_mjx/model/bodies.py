"""The closed-form rigid body, and the interface of bodies.

A body computes accelerations from a wrench; the integrators in `cfb_mjx.model.integrate` work with every body.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import equinox as eqx

from cfb_mjx.model.effects.base import Wrench
from cfb_mjx.model.state import Components
from cfb_mjx.model.vector import Vec, rotate
from cfb_mjx.parameters.parameters import Parameters


@runtime_checkable
class Body(Protocol):
    """The body that carries the rotors. Static (hashable, no arrays); the parameters are passed with every call."""

    name: str

    def prepare(self, parameters: Parameters, dt) -> object:
        """Compute what is needed once per rollout with integration steps of ``dt`` seconds."""
        ...

    def accelerations(self, prepared, state: Components, wrench: Wrench, gyroscopic: bool = True) -> tuple[Vec, Vec]:
        """Acceleration of the centre of gravity (world, m/s^2) and angular acceleration (body, rad/s^2).

        ``wrench`` is about the centre of gravity in body axes. With ``gyroscopic`` False, -J^-1 (omega x J omega) is
        left out.
        """
        ...


class _Prepared(eqx.Module):
    inverse_mass: object
    gravity: object
    inertia: Vec
    inverse_inertia: Vec


class RigidBody:
    """Newton-Euler equations in closed form (paper eqs. 1-4), without ground contact."""

    name = "rigid"

    def prepare(self, parameters: Parameters, dt) -> _Prepared:
        inertia = Vec.unstack(parameters.inertia)
        return _Prepared(1 / parameters.mass, parameters.gravity, inertia, inertia.map(lambda x: 1 / x))

    def accelerations(
        self, prepared: _Prepared, state: Components, wrench: Wrench, gyroscopic: bool = True
    ) -> tuple[Vec, Vec]:
        omega, torque = state.body_rate, wrench.torque
        if gyroscopic:
            torque = torque - omega.cross(prepared.inertia * omega)
        angular = torque * prepared.inverse_inertia
        x, y, z = rotate(state.quaternion, wrench.force * prepared.inverse_mass)
        return Vec(x, y, z - prepared.gravity), angular

    def __eq__(self, other) -> bool:
        return type(other) is RigidBody

    def __hash__(self) -> int:
        return hash(RigidBody)

    def __repr__(self) -> str:
        return "RigidBody()"
