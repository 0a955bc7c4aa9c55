"""The body in MuJoCo's own C: floor and static geometry on the CPU, faster than MJX there, without derivatives."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.model.effects.base import Wrench
from cfb_mjx.model.mjcf import World, compiled_scene
from cfb_mjx.model.scene_engines import Inputs, accelerations_by_c
from cfb_mjx.model.state import Components
from cfb_mjx.model.vector import Vec, rotate
from cfb_mjx.parameters.parameters import Parameters


class _Prepared(eqx.Module):
    dt: Float[Array, ""]
    inertia: Vec
    center: Vec
    mass: Float[Array, ""]
    gravity: Float[Array, ""]


class MujocoBody:
    """Accelerations from MuJoCo's C (`mujoco.batch`), all drones of a batch at once on all cores.

    The interface of `MjxBody` with its floor: `rollout`, `jit` and `vmap` work alike. It has no derivatives, and runs
    on the CPU, whatever the device of the rest; ``docs/scenes.md`` measures where it is faster.

    Args:
        mjcf: path of an MJCF with the drone and static geometry; default: ``assets/cfb.xml``, the drone and a floor.

    Raises:
        CfbError: the MJCF cannot be compiled, or has other moving bodies (`Scene` has those).
    """

    name = "mujoco"

    def __init__(self, mjcf: str | Path | None = None):
        self.mjcf = str(shipped("assets", "cfb.xml") if mjcf is None else mjcf)
        self.mujoco_model = compiled_scene(World(self.mjcf))
        if self.mujoco_model.nq != 7:
            raise CfbError(f"{self.mjcf}: other bodies than the drone move in this MJCF; use Scene for such a world.")

    def prepare(self, parameters: Parameters, dt) -> _Prepared:
        return _Prepared(
            jnp.asarray(dt, parameters.mass.dtype),
            Vec.unstack(parameters.inertia),
            Vec.unstack(parameters.center_of_gravity),
            parameters.mass,
            parameters.gravity,
        )

    def accelerations(
        self, prepared: _Prepared, state: Components, wrench: Wrench, gyroscopic: bool = True
    ) -> tuple[Vec, Vec]:
        center, omega, torque = prepared.center, state.body_rate, wrench.torque
        if not gyroscopic:
            # MuJoCo subtracts the gyroscopic torque; adding it here cancels it.
            torque = torque + omega.cross(prepared.inertia * omega)
        # MuJoCo's free joint is at the rotors' centre; the state and the wrench are at the centre of gravity.
        origin = state.position - rotate(state.quaternion, center)
        velocity = state.velocity - rotate(state.quaternion, omega.cross(center))
        torque = torque + center.cross(wrench.force)
        none = jnp.zeros(0, prepared.dt.dtype)
        inputs = Inputs(
            jnp.concatenate([origin.stack(), state.quaternion.stack()]),
            jnp.concatenate([velocity.stack(), omega.stack()]),
            none,
            none,
            none.reshape(0, 3),
            none.reshape(0, 4),
            jnp.concatenate([rotate(state.quaternion, wrench.force).stack(), torque.stack()]),
            prepared.dt,
            prepared.inertia.stack()[None],
            center.stack()[None],
            prepared.mass[None],
            prepared.gravity,
        )
        found = accelerations_by_c(World(self.mjcf), inputs)
        linear, angular = Vec.unstack(found[:3]), Vec.unstack(found[3:])
        # qacc of the origin is its coordinate acceleration in the world.
        lever = angular.cross(center) + omega.cross(omega.cross(center))
        return linear + rotate(state.quaternion, lever), angular

    def __eq__(self, other) -> bool:
        return type(other) is MujocoBody and self.mjcf == other.mjcf

    def __hash__(self) -> int:
        return hash((MujocoBody, self.mjcf))

    def __repr__(self) -> str:
        return f"MujocoBody({self.mjcf!r})"
