"""One step of a scene in MuJoCo XLA, and in MuJoCo's C."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

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
    model, data = jax.tree.map(jnp.asarray, _on_device(path, x64))
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
def _on_device(path: str, x64: bool) -> Any:
    # Host copies: a device array that is cached during one trace must not leak into another.
    with jax.ensure_compile_time_eval():
        model = on_mjx(path, compiled_scene(path))
        data = mjx.make_data(model)
    return jax.tree.map(np.asarray, (model, data))


def on_mjx(path: str, model: mujoco.MjModel) -> mjx.Model:
    """Put a compiled MJCF into MJX.

    Raises:
        CfbError: it has a feature that MJX lacks.
    """
    try:
        return mjx.put_model(model, impl="jax")
    except NotImplementedError as error:
        said = " ".join(str(error).split())
        raise CfbError(f'{path}: MJX cannot simulate this MJCF ({said}); use Scene(..., engine="c").') from None


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def by_c(path: str, inputs: Inputs) -> Moved:
    """One step in MuJoCo's C, of all examples at once on all cores (`mujoco.batch`); it has no derivatives."""
    model = compiled_scene(path)
    kind = inputs.positions.dtype
    sizes = tuple(jax.ShapeDtypeStruct((n,), kind) for n in (model.nq, model.nv, model.na, model.nv))
    return Moved(*jax.pure_callback(functools.partial(_stepped, path), sizes, inputs, vmap_method="broadcast_all"))


@by_c.defjvp
def _no_derivative(path, primals, tangents):
    raise CfbError(f'{path}: the engine "c" has no derivatives; use Scene(..., engine="mjx") for those.')


def _stepped(path: str, inputs: Inputs) -> tuple[np.ndarray, ...]:
    """`by_c` on the host: arrays with any number of leading axes."""
    given = Inputs(*map(np.asarray, inputs))
    batch = given.dt.shape
    count = int(np.prod(batch, dtype=int))
    worker = _worker(path, count)
    found = worker(Inputs(*(x.reshape(count, *x.shape[len(batch) :]) for x in given)))
    return tuple(np.asarray(x, given.positions.dtype).reshape(*batch, -1) for x in found)


@functools.lru_cache(maxsize=4)
def _worker(path: str, count: int) -> Callable[[Inputs], Moved]:
    from mujoco.batch import Batch

    model = compiled_scene(path)
    body = int(model.body(BODY_NAME).id)
    batch = Batch(model, count)
    names = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "qfrc_applied")
    state = [batch.bind(name) for name in names]
    start, outcome = batch.bind("qacc_warmstart"), batch.bind("qfrc_constraint")
    mass, inertia, center = (batch.expand(name) for name in ("body_mass", "body_inertia", "body_ipos"))
    gravity, dt = batch.expand("opt.gravity"), batch.expand("opt.timestep")
    batch.expand("body_iquat")[:, body] = (1.0, 0.0, 0.0, 0.0)
    before: list[np.ndarray] = []

    def step(inputs: Inputs) -> Moved:
        for own, given in zip(state, inputs, strict=False):
            own[...] = given
        # From the state alone, as in MJX.
        start[...] = 0.0
        constants = inputs[len(names) :]
        if not before or any(not np.array_equal(old, new) for old, new in zip(before, constants, strict=True)):
            before[:] = [np.array(x) for x in constants]
            dt[...] = np.reshape(inputs.dt, dt.shape)
            inertia[:, body], center[:, body] = inputs.inertia, inputs.center
            mass[:, body] = inputs.mass_gravity[:, 0]
            gravity[:, 2] = -inputs.mass_gravity[:, 1]
            # The softness of contacts follows from masses and inertias.
            batch.set_const()
        batch.step()
        return Moved(state[0], state[1], state[2], outcome)

    return step


ENGINES: dict[str, Callable[[str, Inputs], Moved]] = {"mjx": by_mjx, "c": by_c}
