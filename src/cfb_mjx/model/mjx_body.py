"""The body in MuJoCo XLA: the paper's simulator, optionally with floor contact."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.engine.batching import for_some
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.model.bodies import RigidBody
from cfb_mjx.model.effects.base import Wrench
from cfb_mjx.model.mjcf import BODY_NAME, compiled, specification, warn_of_untouched
from cfb_mjx.model.near import near, surroundings, where_touching
from cfb_mjx.model.scene_engines import on_mjx
from cfb_mjx.model.state import Components
from cfb_mjx.model.vector import Vec, rotate
from cfb_mjx.parameters.parameters import Parameters
from cfb_mjx.quiet import quietly

with quietly():
    from mujoco import mjx

_NOT_NEEDED = (
    mujoco.mjtDisableBit.mjDSBL_EQUALITY
    | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    | mujoco.mjtDisableBit.mjDSBL_LIMIT
    | mujoco.mjtDisableBit.mjDSBL_ACTUATION
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
    | mujoco.mjtDisableBit.mjDSBL_EULERDAMP
)


BLOCK = 32
"""Drones per call of the contact solver."""


class _Prepared(eqx.Module):
    model: mjx.Model
    data: mjx.Data
    mass_diagonal: Float[Array, "6"]
    """Diagonal of the joint-space inertia. For one free body in its centre-of-gravity frame the matrix is diagonal and
    the same in every state, so it is computed once, not at every step."""
    center: Vec
    free: Any
    """What the closed form needs, which flies a drone that nothing is near to."""


class MjxBody:
    """Accelerations from MJX for an MJCF whose only moving body has a free joint and the name ``cfb``.

    Contact forces are computed at every call from the state alone (no warm start), so that a simulation remains a pure
    function of the 17 state variables. MuJoCo computes only the drones of a batch that may touch something; the others
    fly in closed form, unless more than contacts acts on them (MuJoCo's drag, damping). Reverse-mode derivatives exist
    only without the floor, because the contact solver has none.

    Args:
        floor: whether the drone can touch the floor and other static geometry of the MJCF.
        mjcf: path of another MJCF; a copy of ``assets/cfb.xml`` may be given any static geometry.

    Raises:
        CfbError: the MJCF cannot be compiled, lacks the free joint, or has other moving bodies (`Scene` has those).

    Warns:
        CfbWarning: the drone cannot touch some of its geoms.
    """

    name = "mjx"

    def __init__(self, floor: bool = True, mjcf: str | Path | None = None):
        self.floor = bool(floor)
        self.mjcf = None if mjcf is None else str(mjcf)
        self.mujoco_model = _compile(self.mjcf, self.floor)
        self.around = surroundings(self.mujoco_model)

    def prepare(self, parameters: Parameters, dt) -> _Prepared:
        x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]  # jax adds it as it loads
        template = _on_device(self.mjcf, self.floor, x64)
        model, data = jax.tree.map(jnp.asarray, template)
        body = _body_index(self.mujoco_model)
        mass, inertia = parameters.mass, Vec.unstack(parameters.inertia).stack()
        center = Vec.unstack(parameters.center_of_gravity).stack()
        moving = jnp.asarray(self.mujoco_model.geom_bodyid == body)
        # The softness of contacts scales with the inverse inertia of the free body: exact, without mj_setConst.
        inverse = jnp.stack([1 / mass, jnp.mean(1 / inertia)])
        model = model.replace(
            opt=model.opt.replace(
                gravity=jnp.stack([jnp.zeros_like(mass), jnp.zeros_like(mass), -parameters.gravity]),
                # MuJoCo keeps contacts at least as soft as the step can resolve.
                timestep=jnp.asarray(dt, model.opt.timestep.dtype),
            ),
            body_mass=model.body_mass.at[body].set(mass),
            body_subtreemass=model.body_subtreemass.at[body].set(mass).at[0].set(mass),
            body_inertia=model.body_inertia.at[body].set(inertia),
            body_ipos=model.body_ipos.at[body].set(0.0),
            body_iquat=model.body_iquat.at[body].set(jnp.array([1.0, 0.0, 0.0, 0.0])),
            # The body frame is at the centre of gravity (see Components), so the geoms are moved.
            geom_pos=jnp.where(moving[:, None], model.geom_pos - center, model.geom_pos),
            body_invweight0=model.body_invweight0.at[body].set(inverse),
        )
        free = RigidBody().prepare(parameters, dt)
        return _Prepared(model, data, _mass_diagonal(model, data), Vec.unstack(center), free)

    def accelerations(
        self, prepared: _Prepared, state: Components, wrench: Wrench, gyroscopic: bool = True
    ) -> tuple[Vec, Vec]:
        torque = wrench.torque
        if not gyroscopic:
            # MuJoCo subtracts the gyroscopic torque; adding it here cancels it.
            inertia = Vec.unstack(prepared.mass_diagonal[3:])
            torque = torque + state.body_rate.cross(inertia * state.body_rate)
        positions = jnp.concatenate([state.position.stack(), state.quaternion.stack()])
        velocities = jnp.concatenate([state.velocity.stack(), state.body_rate.stack()])
        # Generalised force of a free joint: world force at its origin, torque in body axes.
        forces = jnp.concatenate([rotate(state.quaternion, wrench.force).stack(), torque.stack()])
        if not self.floor:
            data = prepared.data.replace(qpos=positions, qvel=velocities, qfrc_applied=forces)
            acceleration = _contact_free(prepared.model, data, prepared.mass_diagonal)
            return Vec.unstack(acceleration[:3]), Vec.unstack(acceleration[3:])
        touching = near(self.around, state.position - rotate(state.quaternion, prepared.center))
        leaves, structure = jax.tree.flatten((prepared.model, prepared.data))

        def contact(_, positions, velocities, forces, *leaves):
            model, data = jax.tree.unflatten(structure, leaves)
            return [_with_contact(model, data.replace(qpos=positions, qvel=velocities, qfrc_applied=forces))]

        (found,) = for_some(contact, touching, [positions, velocities, forces, *leaves], BLOCK)
        free = RigidBody().accelerations(prepared.free, state, wrench, gyroscopic)
        return where_touching(touching, found, free)

    def __eq__(self, other) -> bool:
        return type(other) is MjxBody and (self.floor, self.mjcf) == (other.floor, other.mjcf)

    def __hash__(self) -> int:
        return hash((MjxBody, self.floor, self.mjcf))

    def __repr__(self) -> str:
        return f"MjxBody(floor={self.floor}, mjcf={self.mjcf!r})"


# Jitted, so that they are traced once for all stages of an integrator.
@jax.jit
def _with_contact(model: mjx.Model, data: mjx.Data) -> jax.Array:
    return mjx.forward(model, data).qacc


@jax.jit
def _contact_free(model: mjx.Model, data: mjx.Data, mass_diagonal: jax.Array) -> jax.Array:
    """Compute qacc of `mjx.forward` without contacts: its stages without geoms, sites, actuators and constraints."""
    data = mjx.kinematics(model, data)
    data = mjx.com_pos(model, data)
    data = mjx.com_vel(model, data)
    data = mjx.rne(model, data)
    return (data.qfrc_applied - data.qfrc_bias) / mass_diagonal


@jax.jit
def _mass_diagonal(model: mjx.Model, data: mjx.Data) -> jax.Array:
    data = mjx.kinematics(model, data)
    data = mjx.com_pos(model, data)
    return jnp.diagonal(mjx.full_m(model, mjx.crb(model, data)))


@functools.lru_cache(maxsize=8)
def _compile(mjcf: str | None, floor: bool) -> mujoco.MjModel:
    path = str(shipped("assets", "cfb.xml")) if mjcf is None else mjcf
    spec = specification(path)
    spec.option.disableflags |= int(_NOT_NEEDED)
    if not floor:
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    elif mjcf is not None and spec.body(BODY_NAME) is not None:
        warn_of_untouched(path, compiled(path, spec))
    geoms = list(spec.geoms)
    for geom in geoms:
        # Geoms cost kinematics even if they cannot touch; those with a mass may be all the mass that a body has.
        if not floor or (geom.mass == 0 and not any(_touch(geom, other) for other in geoms)):
            spec.delete(geom)
    for site in list(spec.sites):
        spec.delete(site)
    model = compiled(path, spec)
    joints = model.njnt == 1 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    if not joints or model.body(model.jnt_bodyid[0]).name != BODY_NAME:
        raise CfbError(
            f"{path}: must have exactly one joint, the free joint of a body named '{BODY_NAME}'; use Scene for a world "
            "in which other bodies move."
        )
    body = _body_index(model)
    if np.any(model.body_weldid[np.arange(model.nbody) != body] == body):
        raise CfbError(f"{path}: body '{BODY_NAME}' has child bodies; put their geoms on '{BODY_NAME}' itself.")
    return model


def _touch(one, other) -> bool:
    """Whether two geoms of a specification, one of them the drone's, can touch."""
    bodies = {one.parent.name, other.parent.name}
    kinds = one.contype & other.conaffinity or other.contype & one.conaffinity
    return BODY_NAME in bodies and len(bodies) > 1 and bool(kinds)


def _body_index(model: mujoco.MjModel) -> int:
    return int(model.jnt_bodyid[0])


@functools.lru_cache(maxsize=8)
def _on_device(mjcf: str | None, floor: bool, x64: bool):
    return on_mjx(str(mjcf), _compile(mjcf, floor))
