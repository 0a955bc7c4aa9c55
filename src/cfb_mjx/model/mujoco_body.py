"""The body in MuJoCo's own C: floor and static geometry on the CPU, faster than MJX there, without derivatives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.engine.batching import for_some
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.model.bodies import RigidBody
from cfb_mjx.model.effects.base import Wrench
from cfb_mjx.model.mjcf import World, compiled_scene
from cfb_mjx.model.near import near, surroundings, where_touching
from cfb_mjx.model.scene_engines import Inputs, accelerations_by_c
from cfb_mjx.model.state import Components
from cfb_mjx.model.vector import Vec, renormalise, rotate, rotate_inverse
from cfb_mjx.parameters.parameters import Parameters


class _Prepared(eqx.Module):
    dt: Float[Array, ""]
    inertia: Vec
    center: Vec
    mass: Float[Array, ""]
    gravity: Float[Array, ""]
    free: Any
    """What the closed form needs, which flies a drone that nothing is near to."""


BLOCK = 512
"""Largest number of drones per call of the host, where jax computes on a CPU."""


class MujocoBody:
    """Accelerations from MuJoCo's C (`mujoco.batch`) for the drones that may touch something, at once on all cores.

    The others fly in closed form, as in `MjxBody`, whose interface it has: `rollout`, `jit` and `vmap` work alike. It
    has no derivatives, and MuJoCo runs on the CPU, whatever the device of the rest; ``docs/scenes.md`` measures where
    it is faster.

    Args:
        mjcf: path of an MJCF with the drone and static geometry; default: ``assets/cfb.xml``, the drone and a floor.

    Raises:
        CfbError: the MJCF cannot be compiled, or has other moving bodies or actuators (`Scene` has those).
    """

    name = "mujoco"

    def __init__(self, mjcf: str | Path | None = None):
        self.mjcf = str(shipped("assets", "cfb.xml") if mjcf is None else mjcf)
        self.mujoco_model = compiled_scene(World(self.mjcf))
        model = self.mujoco_model
        if model.nq != 7 or model.nmocap or model.nu:
            raise CfbError(
                f"{self.mjcf}: other bodies than the drone move in this MJCF, or it has actuators; use Scene for such "
                "a world."
            )
        self.around = surroundings(self.mujoco_model)

    def prepare(self, parameters: Parameters, dt) -> _Prepared:
        return _Prepared(
            jnp.asarray(dt, parameters.mass.dtype),
            Vec.unstack(parameters.inertia),
            Vec.unstack(parameters.center_of_gravity),
            parameters.mass,
            parameters.gravity,
            RigidBody().prepare(parameters, dt),
        )

    def accelerations(
        self, prepared: _Prepared, state: Components, wrench: Wrench, gyroscopic: bool = True
    ) -> tuple[Vec, Vec]:
        center, omega, torque = prepared.center, state.body_rate, wrench.torque
        if not gyroscopic:
            # MuJoCo subtracts the gyroscopic torque; adding it here cancels it.
            torque = torque + omega.cross(prepared.inertia * omega)
        # MuJoCo's free joint is at the rotors' centre; the state and the wrench are at the centre of gravity. MuJoCo
        # makes quaternions unit ones; within a step of an integrator they are so only nearly.
        unit, force = renormalise(state.quaternion), rotate(state.quaternion, wrench.force)
        origin = state.position - rotate(unit, center)
        velocity = state.velocity - rotate(unit, omega.cross(center))
        torque = torque + center.cross(rotate_inverse(unit, force))
        none = jnp.zeros(0, prepared.dt.dtype)
        inputs = Inputs(
            jnp.concatenate([origin.stack(), unit.stack()]),
            jnp.concatenate([velocity.stack(), omega.stack()]),
            none,
            none,
            none.reshape(0, 3),
            none.reshape(0, 4),
            jnp.concatenate([force.stack(), torque.stack()]),
            prepared.dt,
            prepared.inertia.stack()[None],
            center.stack()[None],
            prepared.mass[None],
            prepared.gravity,
        )
        world, touching = World(self.mjcf), near(self.around, origin)

        def contact(real, *inputs):
            return [accelerations_by_c(world, real, Inputs(*inputs))]

        (found,) = for_some(contact, touching, list(inputs), BLOCK)
        linear, angular = Vec.unstack(found[:3]), Vec.unstack(found[3:])
        # qacc of the origin is its coordinate acceleration in the world.
        lever = angular.cross(center) + omega.cross(omega.cross(center))
        linear = linear + rotate(unit, lever)
        free = RigidBody().accelerations(prepared.free, state, wrench, gyroscopic)
        return where_touching(touching, jnp.concatenate([linear.stack(), angular.stack()]), free)

    def __eq__(self, other) -> bool:
        return type(other) is MujocoBody and self.mjcf == other.mjcf

    def __hash__(self) -> int:
        return hash((MujocoBody, self.mjcf))

    def __repr__(self) -> str:
        return f"MujocoBody({self.mjcf!r})"
