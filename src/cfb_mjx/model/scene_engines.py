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
from jaxtyping import Array, Bool, Float, Int

from cfb_mjx.engine.host import on_host
from cfb_mjx.errors import CfbError
from cfb_mjx.model.mjcf import World, compiled_scene, numbers_of
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
    inertia: Float[AnyArray, "*batch drones 3"]
    center: Float[AnyArray, "*batch drones 3"]
    """Centres of gravity of the drones, body axes, m."""
    mass: Float[AnyArray, "*batch drones"]
    gravity: Float[AnyArray, "*batch"]


class Moved(NamedTuple):
    """State after a step."""

    positions: Float[AnyArray, "*batch nq"]
    velocities: Float[AnyArray, "*batch nv"]
    activations: Float[AnyArray, "*batch na"]
    constraint: Float[AnyArray, "*batch nv"]
    """Generalised forces of contacts and cables."""


def by_mjx(world: World, inputs: Inputs) -> Moved:
    """One step in MuJoCo XLA, from the state alone (no warm start)."""
    model, data = set_mjx(world, inputs)
    after = mjx.step(model, data)
    return Moved(after.qpos, after.qvel, after.act, after.qfrc_constraint)


def set_mjx(world: World, inputs: Inputs) -> tuple[mjx.Model, mjx.Data]:
    """MJX model and data of a scene before its step; one example."""
    x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]  # jax adds it as it loads
    model, data = jax.tree.map(jnp.asarray, _template(world, x64))
    bodies, mass, gravity = numbers_of(compiled_scene(world), world.bodies), inputs.mass, inputs.gravity
    change = mass - model.body_mass[bodies]
    model = model.replace(
        opt=model.opt.replace(gravity=jnp.stack([0.0 * gravity, 0.0 * gravity, -gravity]), timestep=inputs.dt),
        body_mass=model.body_mass.at[bodies].set(mass),
        body_subtreemass=model.body_subtreemass.at[bodies].add(change).at[0].add(jnp.sum(change)),
        body_inertia=model.body_inertia.at[bodies].set(inputs.inertia),
        body_ipos=model.body_ipos.at[bodies].set(inputs.center),
        body_iquat=model.body_iquat.at[bodies].set(jnp.array([1.0, 0.0, 0.0, 0.0])),
        body_invweight0=model.body_invweight0.at[bodies].set(
            jnp.stack([1 / mass, jnp.mean(1 / inputs.inertia, axis=-1)], axis=-1)
        ),
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
def _template(world: World, x64: bool) -> Any:
    return on_mjx(world.mjcf, compiled_scene(world))


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
    """Decorator of functions of a world and arrays: their derivatives raise what is ``said`` of its file."""

    def decorate(function: Callable) -> Callable:
        outer = functools.partial(jax.custom_jvp, nondiff_argnums=(0,))(function)

        @outer.defjvp
        def none(world, primals, tangents):
            raise CfbError(f"{world.mjcf}: {said}")

        return outer

    return decorate


@_without_derivatives('the engine "c" has no derivatives; use Scene(..., engine="mjx") for those.')
def by_c(world: World, inputs: Inputs) -> Moved:
    """One step in MuJoCo's C, of all examples at once on all cores (`mujoco.batch`); it has no derivatives."""
    model = compiled_scene(world)

    def step(rows: np.ndarray) -> np.ndarray:
        with _TURN:
            worker = _worker(world, len(rows))
            worker.take(_taken(world, rows))
            return worker.step()

    ends = np.cumsum([model.nq, model.nv, model.na, model.nv])
    return Moved(*jnp.split(on_host(step, int(ends[-1]), _packed(inputs)), ends[:-1]))


@_without_derivatives("MujocoBody has no derivatives; use MjxBody(floor=False) or RigidBody for those.")
def accelerations_by_c(world: World, real: Bool[AnyArray, ""], inputs: Inputs) -> Float[AnyArray, " nv"]:
    """Generalised accelerations in MuJoCo's C, of all ``real`` examples at once; it has no derivatives.

    Those of the others are zero.
    """
    model = compiled_scene(world)

    def accelerate(rows: np.ndarray) -> np.ndarray:
        found, real = np.zeros((len(rows), model.nv)), np.flatnonzero(rows[:, -1])
        with _TURN:
            worker = _worker(world, len(rows))
            worker.take(_taken(world, rows), real)
            worker.batch.forward(ids=real)
            found[real] = worker.acceleration[real]
        return found

    packed = _packed(inputs)
    return on_host(accelerate, model.nv, jnp.append(packed, real.astype(packed.dtype)))


def _packed(inputs: Inputs) -> Float[Array, " numbers"]:
    return jnp.concatenate([jnp.ravel(x) for x in inputs])


def _taken(world: World, rows: np.ndarray) -> Inputs:
    """`_packed` undone, of many examples."""
    model = compiled_scene(world)
    shapes = (
        (model.nq,),
        (model.nv,),
        (model.na,),
        (model.nu,),
        (model.nmocap, 3),
        (model.nmocap, 4),
        (model.nv,),
        (),
        (world.drones, 3),
        (world.drones, 3),
        (world.drones,),
        (),
    )
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    parts = np.split(rows[:, : ends[-1]], ends[:-1], axis=1)
    return Inputs(*(part.reshape(len(rows), *shape) for part, shape in zip(parts, shapes, strict=True)))


def cast_by_mjx(
    world: World, unseen: int, inputs: Inputs, origin: Float[Array, "3"], directions: Float[Array, "rays 3"]
) -> tuple[Float[Array, " rays"], Int[Array, " rays"]]:
    """Cast rays from ``origin`` [m], in MJX; the body ``unseen`` is not seen (-1: all are).

    Returns:
        Distances in lengths of the directions, and numbers of the geoms that were hit; -1 for none.
    """
    compiled, (model, data) = compiled_scene(world), set_mjx(world, inputs)
    # MJX leaves out what it cannot hit, without a word.
    if missed := set(compiled.geom_type[compiled.geom_bodyid != unseen].tolist()) - _SEEN_BY_MJX:
        kinds = ", ".join(sorted(mujoco.mjtGeom(kind).name for kind in missed))
        raise CfbError(f'{world.mjcf}: MJX casts no rays at {kinds}; use Scene(..., engine="c").')
    if not compiled.nmat:
        # It also looks up the material of geoms without one.
        model = model.replace(mat_rgba=jnp.ones((1, 4), model.geom_rgba.dtype))
    data = mjx.kinematics(model, data)
    return jax.vmap(lambda ray: mjx.ray(model, data, origin, ray, bodyexclude=unseen))(directions)


_SEEN_BY_MJX = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "BOX", "MESH")
}


def cast_by_c(
    world: World, unseen: int, inputs: Inputs, origin: Float[Array, "3"], directions: Float[Array, "rays 3"]
) -> tuple[Float[Array, " rays"], Int[Array, " rays"]]:
    """`cast_by_mjx` in MuJoCo's C."""
    own, rays = _packed(inputs), directions.shape[0]

    def cast(rows: np.ndarray) -> np.ndarray:
        ray = rows[:, own.size :]
        starts, ways = ray[:, None, :3], ray[:, 3:].reshape(len(rows), rays, 3)
        with _TURN:
            worker = _worker(world, len(rows))
            worker.take(_taken(world, rows))
            return np.concatenate(worker.batch.ray(starts, ways, bodyexclude=unseen)[:2], axis=1)

    found = on_host(cast, 2 * rays, jnp.concatenate([own, origin, directions.reshape(-1)]))
    return found[:rays], found[rays:].astype(jnp.int32)


class _Worker:
    """A batch of simulations in C, set and stepped from the host."""

    def __init__(self, world: World, count: int):
        from mujoco.batch import Batch

        model = compiled_scene(world)
        self.bodies, self.batch = numbers_of(model, world.bodies), Batch(model, count)
        names = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "qfrc_applied")
        self.state = [self.batch.bind(name) for name in names]
        self.start, self.constraint = self.batch.bind("qacc_warmstart"), self.batch.bind("qfrc_constraint")
        self.acceleration = self.batch.bind("qacc")
        self.constants = [self.batch.expand(name) for name in ("body_mass", "body_inertia", "body_ipos")]
        self.gravity, self.dt = self.batch.expand("opt.gravity"), self.batch.expand("opt.timestep")
        self.batch.expand("body_iquat")[:, self.bodies] = (1.0, 0.0, 0.0, 0.0)
        drones = len(self.bodies)
        self.before = np.full((count, 7 * drones + 2), np.nan)
        """Constants that the models have: time step, inertias, centres, masses and gravity."""

    def take(self, inputs: Inputs, which: np.ndarray | None = None) -> None:
        """Set states and models of the simulations, or of those with the numbers ``which``."""
        ids = np.arange(len(self.gravity)) if which is None else which
        for own, given in zip(self.state, inputs, strict=False):
            own[ids] = given[ids]
        # From the state alone, as in MJX.
        self.start[ids] = 0.0
        constants = [np.reshape(x, (len(x), -1)) for x in inputs[len(self.state) :]]
        given = np.concatenate(constants, axis=1)
        ids = ids[np.any(self.before[ids] != given[ids], axis=1)]
        if not len(ids):
            return
        self.before[ids] = given[ids]
        mass, inertia, center = self.constants
        self.dt[ids] = np.reshape(inputs.dt, self.dt.shape)[ids]
        rows = np.ix_(ids, self.bodies)
        inertia[rows], center[rows], mass[rows] = inputs.inertia[ids], inputs.center[ids], inputs.mass[ids]
        self.gravity[ids, 2] = -inputs.gravity[ids]
        # The softness of contacts follows from masses and inertias.
        self.batch.set_const(ids=ids)

    def step(self) -> np.ndarray:
        """Advance all simulations by one step; return positions, velocities, activations and constraint forces."""
        self.batch.step()
        return np.concatenate([*self.state[:3], self.constraint], axis=1)


_TURN = threading.Lock()
"""Held while a worker is set, computes and is read: each device calls from a thread of its own."""


@functools.lru_cache(maxsize=4)
def _worker(world: World, count: int) -> _Worker:
    return _Worker(world, count)


ENGINES: dict[str, Callable[[World, Inputs], Moved]] = {"mjx": by_mjx, "c": by_c}
