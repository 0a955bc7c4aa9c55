"""One step of a scene in MuJoCo XLA, and in MuJoCo's C."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from cfb_mjx.engine.host import on_host
from cfb_mjx.errors import CfbError
from cfb_mjx.model.mjcf import BODY_NAME, compiled_scene
from cfb_mjx.model.state import AnyArray
from cfb_mjx.quiet import quietly

with quietly():
    from mujoco import mjx


class Inputs(NamedTuple):
    """What a step needs, in MuJoCo's order."""

    positions: Float[AnyArray, "*batch nq"]
    velocities: Float[AnyArray, "*batch nv"]
    activations: Float[AnyArray, "*batch na"]
    controls: Float[AnyArray, "*batch nu"]
    mocap_positions: Float[AnyArray, "*batch mocaps 3"]
    mocap_quaternions: Float[AnyArray, "*batch mocaps 4"]
    forces: Float[AnyArray, "*batch nv"]
    """Generalised forces of the rotors and effects."""
    dt: Float[AnyArray, "*batch"]
    inertia: Float[AnyArray, "*batch 3"]
    center: Float[AnyArray, "*batch 3"]
    """Centre of gravity of the drone, body axes, m."""
    mass_gravity: Float[AnyArray, "*batch 2"]


class Moved(NamedTuple):
    """State after a step."""

    positions: Float[AnyArray, "*batch nq"]
    velocities: Float[AnyArray, "*batch nv"]
    activations: Float[AnyArray, "*batch na"]
    constraint: Float[AnyArray, "*batch nv"]
    """Generalised forces of contacts and cables."""


def by_mjx(path: str, inputs: Inputs) -> Moved:
    """One step in MuJoCo XLA, from the state alone (no warm start)."""
    model, data = set_mjx(path, inputs)
    after = mjx.step(model, data)
    return Moved(after.qpos, after.qvel, after.act, after.qfrc_constraint)


def set_mjx(path: str, inputs: Inputs) -> tuple[mjx.Model, mjx.Data]:
    """MJX model and data of a scene before its step; one example."""
    x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]  # jax adds it as it loads
    model, data = jax.tree.map(jnp.asarray, _template(path, x64))
    body = int(compiled_scene(path).body(BODY_NAME).id)
    mass, gravity = inputs.mass_gravity
    change = mass - model.body_mass[body]
    model = model.replace(
        opt=model.opt.replace(gravity=jnp.stack([0.0 * gravity, 0.0 * gravity, -gravity]), timestep=inputs.dt),
        body_mass=model.body_mass.at[body].set(mass),
        body_subtreemass=model.body_subtreemass.at[body].add(change).at[0].add(change),
        body_inertia=model.body_inertia.at[body].set(inputs.inertia),
        body_ipos=model.body_ipos.at[body].set(inputs.center),
        body_iquat=model.body_iquat.at[body].set(jnp.array([1.0, 0.0, 0.0, 0.0])),
        body_invweight0=model.body_invweight0.at[body].set(jnp.stack([1 / mass, jnp.mean(1 / inputs.inertia)])),
    )
    data = data.replace(
        qpos=inputs.positions,
        qvel=inputs.velocities,
        act=inputs.activations,
        ctrl=inputs.controls,
        mocap_pos=inputs.mocap_positions,
        mocap_quat=inputs.mocap_quaternions,
        qfrc_applied=inputs.forces,
    )
    return model, data


@functools.lru_cache(maxsize=8)
def _template(path: str, x64: bool) -> Any:
    return on_mjx(path, compiled_scene(path))


def on_mjx(path: str, compiled: mujoco.MjModel) -> tuple[mjx.Model, mjx.Data]:
    """Put a compiled MJCF into MJX, as arrays on the host.

    A device array that is cached during one trace must not leak into another.

    Raises:
        CfbError: it has a feature that MJX lacks.
    """
    try:
        with jax.ensure_compile_time_eval():
            model = mjx.put_model(compiled, impl="jax")
            data = mjx.make_data(model)
    except NotImplementedError as error:
        said = " ".join(str(error).split())
        raise CfbError(f'{path}: MJX cannot simulate this MJCF ({said}); use Scene(..., engine="c").') from None
    return jax.tree.map(np.asarray, (model, data))


def _without_derivatives(said: str) -> Callable:
    """Decorator of functions of a path and arrays: their derivatives raise what is ``said`` of the path."""

    def decorate(function: Callable) -> Callable:
        outer = functools.partial(jax.custom_jvp, nondiff_argnums=(0,))(function)

        @outer.defjvp
        def none(path, primals, tangents):
            raise CfbError(f"{path}: {said}")

        return outer

    return decorate


@_without_derivatives('the engine "c" has no derivatives; use Scene(..., engine="mjx") for those.')
def by_c(path: str, inputs: Inputs) -> Moved:
    """One step in MuJoCo's C, of all examples at once on all cores (`mujoco.batch`); it has no derivatives."""
    model = compiled_scene(path)

    def step(rows: np.ndarray) -> np.ndarray:
        with _TURN:
            worker = _worker(path, len(rows))
            worker.take(_taken(model, rows))
            return worker.step()

    ends = np.cumsum([model.nq, model.nv, model.na, model.nv])
    return Moved(*jnp.split(on_host(step, int(ends[-1]), _packed(inputs)), ends[:-1]))


@_without_derivatives("MujocoBody has no derivatives; use MjxBody(floor=False) or RigidBody for those.")
def accelerations_by_c(path: str, inputs: Inputs) -> Float[AnyArray, " nv"]:
    """Generalised accelerations in MuJoCo's C, of all examples at once; it has no derivatives."""
    model = compiled_scene(path)

    def accelerate(rows: np.ndarray) -> np.ndarray:
        with _TURN:
            worker = _worker(path, len(rows))
            worker.take(_taken(model, rows))
            worker.batch.forward()
            return worker.acceleration.copy()

    return on_host(accelerate, model.nv, _packed(inputs))


def _packed(inputs: Inputs) -> Float[Array, " numbers"]:
    return jnp.concatenate([jnp.ravel(x) for x in inputs])


def _taken(model: mujoco.MjModel, rows: np.ndarray) -> Inputs:
    """`_packed` undone, of many examples."""
    shapes = (
        (model.nq,),
        (model.nv,),
        (model.na,),
        (model.nu,),
        (model.nmocap, 3),
        (model.nmocap, 4),
        (model.nv,),
        (),
        (3,),
        (3,),
        (2,),
    )
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    parts = np.split(rows[:, : ends[-1]], ends[:-1], axis=1)
    return Inputs(*(part.reshape(len(rows), *shape) for part, shape in zip(parts, shapes, strict=True)))


def cast_by_mjx(
    path: str, inputs: Inputs, origin: Float[Array, "3"], directions: Float[Array, "rays 3"]
) -> tuple[Float[Array, " rays"], Int[Array, " rays"]]:
    """Cast rays from ``origin`` [m], in MJX; the drone is not seen.

    Returns:
        Distances in lengths of the directions, and numbers of the geoms that were hit; -1 for none.
    """
    compiled, (model, data) = compiled_scene(path), set_mjx(path, inputs)
    body = int(compiled.body(BODY_NAME).id)
    # MJX leaves out what it cannot hit, without a word.
    if unseen := set(compiled.geom_type[compiled.geom_bodyid != body].tolist()) - _SEEN_BY_MJX:
        kinds = ", ".join(sorted(mujoco.mjtGeom(kind).name for kind in unseen))
        raise CfbError(f'{path}: MJX casts no rays at {kinds}; use Scene(..., engine="c").')
    if not compiled.nmat:
        # It also looks up the material of geoms without one.
        model = model.replace(mat_rgba=jnp.ones((1, 4), model.geom_rgba.dtype))
    data = mjx.kinematics(model, data)
    return jax.vmap(lambda ray: mjx.ray(model, data, origin, ray, bodyexclude=body))(directions)


_SEEN_BY_MJX = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "BOX", "MESH")
}


def cast_by_c(
    path: str, inputs: Inputs, origin: Float[Array, "3"], directions: Float[Array, "rays 3"]
) -> tuple[Float[Array, " rays"], Int[Array, " rays"]]:
    """`cast_by_mjx` in MuJoCo's C."""
    model, rays = compiled_scene(path), directions.shape[0]
    own = _packed(inputs)

    def cast(rows: np.ndarray) -> np.ndarray:
        ray = rows[:, own.size :]
        starts, ways = ray[:, None, :3], ray[:, 3:].reshape(len(rows), rays, 3)
        with _TURN:
            worker = _worker(path, len(rows))
            worker.take(_taken(model, rows))
            return np.concatenate(worker.batch.ray(starts, ways, bodyexclude=worker.body)[:2], axis=1)

    found = on_host(cast, 2 * rays, jnp.concatenate([own, origin, directions.reshape(-1)]))
    return found[:rays], found[rays:].astype(jnp.int32)


class _Worker:
    """A batch of simulations in C, set and stepped from the host."""

    def __init__(self, path: str, count: int):
        from mujoco.batch import Batch

        model = compiled_scene(path)
        self.body, self.batch = int(model.body(BODY_NAME).id), Batch(model, count)
        names = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "qfrc_applied")
        self.state = [self.batch.bind(name) for name in names]
        self.start, self.constraint = self.batch.bind("qacc_warmstart"), self.batch.bind("qfrc_constraint")
        self.acceleration = self.batch.bind("qacc")
        self.constants = [self.batch.expand(name) for name in ("body_mass", "body_inertia", "body_ipos")]
        self.gravity, self.dt = self.batch.expand("opt.gravity"), self.batch.expand("opt.timestep")
        self.batch.expand("body_iquat")[:, self.body] = (1.0, 0.0, 0.0, 0.0)
        self.before: list[np.ndarray] = []

    def take(self, inputs: Inputs) -> None:
        """Set states and models."""
        for own, given in zip(self.state, inputs, strict=False):
            own[...] = given
        # From the state alone, as in MJX.
        self.start[...] = 0.0
        constants = inputs[len(self.state) :]
        if self.before and all(np.array_equal(old, new) for old, new in zip(self.before, constants, strict=True)):
            return
        self.before = [np.array(x) for x in constants]
        mass, inertia, center = self.constants
        self.dt[...] = np.reshape(inputs.dt, self.dt.shape)
        inertia[:, self.body], center[:, self.body] = inputs.inertia, inputs.center
        mass[:, self.body] = inputs.mass_gravity[:, 0]
        self.gravity[:, 2] = -inputs.mass_gravity[:, 1]
        # The softness of contacts follows from masses and inertias.
        self.batch.set_const()

    def step(self) -> np.ndarray:
        """Advance all simulations by one step; return positions, velocities, activations and constraint forces."""
        self.batch.step()
        return np.concatenate([*self.state[:3], self.constraint], axis=1)


_TURN = threading.Lock()
"""Held while a worker is set, computes and is read: each device calls from a thread of its own."""


@functools.lru_cache(maxsize=4)
def _worker(path: str, count: int) -> _Worker:
    return _Worker(path, count)


ENGINES: dict[str, Callable[[str, Inputs], Moved]] = {"mjx": by_mjx, "c": by_c}
