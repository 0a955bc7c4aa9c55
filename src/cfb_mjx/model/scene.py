"""A world of one's own around the drone: any MJCF with gates, poles, platforms, other bodies, cables.

    scene = Scene("gates.xml")                           # without a drone: it is added
    state = scene.begin(drone, drone.hover_state())
    flown = scene.rollout(drone, state, commands)        # jit and vmap work as with `rollout`
    swarm = Scene("gates.xml", drones=4)                 # models, states and commands with an axis of drones

MuJoCo moves all bodies and computes contacts and cables; this library computes the rotors' loads and the effects, and
applies them to the body ``cfb``. Several drones collide, and fly in each other's wakes if their models have the effect
`Downwash`, which is computed as in `cfb_mjx.model.swarm`.

Two engines compute the same: ``mjx`` (MuJoCo XLA, on any device, forward-mode derivatives) and ``c`` (MuJoCo's own C by
`mujoco.batch`, on the CPU, no derivatives).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.engine.cpu_kernel import apart
from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.model import rotors, wakes
from cfb_mjx.model.effects.base import Condition
from cfb_mjx.model.mjcf import World, compiled_scene
from cfb_mjx.model.quadrotor import (
    Prepared,
    Quadrotor,
    advanced,
    begin,
    commanded_path,
    conditions,
    loaded,
    prepare,
    remembering,
)
from cfb_mjx.model.rollout import require_kept
from cfb_mjx.model.scene_engines import ENGINES, Inputs
from cfb_mjx.model.state import AnyArray, Components, State, stacked, unstack
from cfb_mjx.model.vector import Vec, rotate
from cfb_mjx.parameters.parameters import concrete


class SceneState(eqx.Module):
    """State of a scene, or a batch or trajectory of states (leading axes)."""

    drone: State
    """State of the drone; in a scene with several their axis follows the batch axes."""
    positions: Float[AnyArray, "*batch nq"]
    """Generalised positions of everything but the drone, in MuJoCo's order."""
    velocities: Float[AnyArray, "*batch nv"]
    activations: Float[AnyArray, "*batch na"]
    controls: Float[AnyArray, "*batch nu"]
    """Controls of the scene's own actuators; replace them to move what they drive."""
    mocap_positions: Float[AnyArray, "*batch mocaps 3"]
    """Positions of mocap bodies, m; replace them to move a platform along a path."""
    mocap_quaternions: Float[AnyArray, "*batch mocaps 4"]
    time: Float[AnyArray, "*batch"]
    constraint: Float[AnyArray, "*batch_and_drones 6"]
    """Force [N, world] and torque [N m, body] of contacts and cables on the drone: the largest since the last state
    that was returned, whatever was between. Zero: nothing was touched."""


class Scene:
    """A world with the drone. Static and hashable: functions may close over it under ``jit``.

    Args:
        mjcf: MJCF of the world. Its body ``cfb`` with a free joint is the drone, with the mass, the inertia and the
            centre of gravity of the parameters. If there is none, the drone of ``assets/cfb.xml`` is added; a body
            ``cfb`` that holds only sites or cameras, to which cables can be tied, becomes that drone.
        engine: ``mjx`` or ``c``.
        drones: number of drones; None: one, without an axis of drones. The bodies of the others are ``cfb1``, ``cfb2``
            and so on, each added if it is not there. Above four drones, each sees the four strongest wakes near it.

    Raises:
        CfbError: the MJCF cannot be compiled, its body ``cfb`` has other joints, or it has a feature that MJX lacks.

    Warns:
        CfbWarning: the drone cannot touch some of its geoms (``contype`` and ``conaffinity``), drones cannot touch each
            other, or MuJoCo's own drag acts on the drone (``density`` and ``viscosity``).
    """

    def __init__(self, mjcf: str | Path, engine: Literal["mjx", "c"] = "mjx", drones: int | None = None):
        if engine not in ENGINES:
            raise CfbError(f"engine must be one of {', '.join(ENGINES)}, found {engine!r}.")
        if drones is not None and drones < 1:
            raise CfbError(f"the number of drones of a scene must be at least 1, found {drones}.")
        self.mjcf, self.engine, self.drones = str(mjcf), engine, drones
        self.world = World(self.mjcf, drones or 1)
        model = self.mujoco_model = compiled_scene(self.world)
        joints = [int(model.body(name).jntadr[0]) for name in self.world.bodies]
        self._positions = _spans(model.jnt_qposadr[joints], 7, model.nq, drones is not None)
        self._velocities = _spans(model.jnt_dofadr[joints], 6, model.nv, drones is not None)

    def begin(self, drone: Quadrotor, state: State) -> SceneState:
        """Return the MJCF's initial state with the drone in ``state``.

        Args:
            drone: the drone, for the memory of its effects; several have a leading axis, in all methods.
            state: state of the drone, likewise.

        Raises:
            CfbError: the number of drones is another, or they differ in gravity.

        Warns:
            CfbWarning: the MJCF asks for shorter steps than the drone's.
        """
        self._warn_of_steps(drone)
        self._require_one_world(drone, state)
        model, data = self.mujoco_model, mujoco.MjData(self.mujoco_model)
        mujoco.mj_resetData(model, data)
        kind = jnp.asarray(state.position).dtype
        rest = (
            data.qpos[self._positions[1]],
            data.qvel[self._velocities[1]],
            data.act,
            data.ctrl,
            data.mocap_pos,
            data.mocap_quat,
            np.zeros(()),
            np.zeros((6,) if self.drones is None else (self.drones, 6)),
        )
        return SceneState(self._begun(drone, state), *(jnp.asarray(x, kind) for x in rest))

    def _begun(self, drone: Quadrotor, state: State) -> State:
        if self.drones is None:
            return begin(drone, state)
        if not wakes.interact(drone):
            return jax.vmap(begin)(drone, state)
        others = min(wakes.NEIGHBOURS, self.drones - 1)
        return jax.vmap(lambda model, state: wakes.begin_among(model, state, others))(drone, state)

    def _require_one_world(self, drone: Quadrotor, state: State) -> None:
        if self.drones is None:
            return
        wakes.require_drones(drone, self.drones)
        if jnp.shape(state.position) != (self.drones, 3):
            raise CfbError(
                f"the states of a scene have a leading axis of its {self.drones} drones; the position has shape "
                f"{jnp.shape(state.position)}."
            )
        gravity = concrete(drone.parameters.gravity)
        if gravity is not None and np.ptp(gravity):
            raise CfbError("the drones of a scene fly under one gravity; their models have several.")

    def step(self, drone: Quadrotor, state: SceneState, command: Float[Array, "*drones 4"]) -> SceneState:
        """Advance everything by ``drone.dt`` with a constant ``command`` (clipped to [0, 1]).

        The integrator is the one of the MJCF's option, with steps of ``drone.dt / drone.substeps``; ``drone.body`` and
        ``drone.integrator`` are not used.
        """
        prepared = self.each(prepare)(drone)
        return self._advanced(prepared, _untouched(state), command, self._near(prepared, state))

    def rollout(
        self,
        drone: Quadrotor,
        state: SceneState,
        commands: Float[Array, "steps *drones 4"],
        *,
        hold: int = 1,
        every: int = 1,
    ) -> SceneState:
        """Fly ``commands``, and return the states after every ``every``-th command; arguments as for `rollout`.

        Raises:
            ValueError: ``hold`` or ``every`` is below one, or ``every`` does not divide the number of commands.
        """
        steps = commands.shape[0]
        require_kept(steps, hold, every)
        prepared = self.each(prepare)(drone)
        searched = wakes.divisor(every, wakes.SEARCHED_S / (hold * drone.dt))

        def search(state, rows):
            near = self._near(prepared, state)

            def one(state, row):
                def again(state, _):
                    return self._advanced(prepared, state, row, near), None

                return jax.lax.scan(again, state, length=hold)[0], None

            return jax.lax.scan(one, state, rows)[0], None

        def some(state, rows):
            state = jax.lax.scan(search, _untouched(state), rows)[0]
            return state, state

        return jax.lax.scan(some, state, commands.reshape(steps // every, -1, searched, *commands.shape[1:]))[1]

    def each(self, function: Callable) -> Callable:
        """A function of one drone, for each."""
        return function if self.drones is None else jax.vmap(function)

    def _near(self, prepared: Prepared, state: SceneState):
        """Indices of the drones in whose wakes each is; None if they do not interact."""
        if self.drones is None or not wakes.interact(prepared.model):
            return None
        if self.drones <= wakes.FEW:
            return wakes.all_others(self.drones)
        return wakes.neighbours(prepared, jax.vmap(_components)(prepared, state.drone))[0]

    def _advanced(self, prepared: Prepared, state: SceneState, command: Array, near) -> SceneState:
        for _ in range(prepared.model.substeps):
            state = self._integrated(prepared, state, command, near)
        return state

    def _integrated(self, prepared: Prepared, state: SceneState, command: Array, near) -> SceneState:
        def drive():
            at = self.each(_components)(prepared, state.drone)
            if near is not None:
                at = wakes.sense(prepared, at, near)
            return self.each(_driven)(prepared, at, command)

        at, felt, speed, wrench = apart(drive) if self.engine == "c" else drive()
        force = jnp.concatenate(wrench, axis=-1)
        moved = ENGINES[self.engine](self.world, self.inputs(prepared, state, force))
        pose, twist = moved.positions[self._positions[0]], moved.velocities[self._velocities[0]]
        after = self.each(_moved)(prepared, at, felt, speed, pose, twist)
        force = moved.constraint[self._velocities[0]]
        larger = jnp.sum(force**2, axis=-1) > jnp.sum(jnp.asarray(state.constraint) ** 2, axis=-1)
        return SceneState(
            after,
            moved.positions[self._positions[1]],
            moved.velocities[self._velocities[1]],
            moved.activations,
            state.controls,
            state.mocap_positions,
            state.mocap_quaternions,
            state.time + _first(jnp.asarray(prepared.dt, state.positions.dtype)),
            jnp.where(larger[..., None], force, state.constraint),
        )

    def inputs(self, prepared: Prepared, state: SceneState, force: Float[Array, "*drones 6"] | None = None) -> Inputs:
        """What an engine needs of a state.

        Args:
            prepared: the drone.
            state: one state.
            force: force [N, world] and torque [N m, body] of rotors and effects about the rotors' centre; None: none.
        """
        parameters, now = prepared.parameters, state.drone
        kind = jnp.asarray(state.positions).dtype
        force = jnp.zeros(self._velocities[0].shape, kind) if force is None else force
        pose = jnp.concatenate([now.position, now.quaternion], axis=-1)
        twist = jnp.concatenate([now.velocity, now.body_rate], axis=-1)
        return Inputs(
            self._whole(self._positions, pose, state.positions),
            self._whole(self._velocities, twist, state.velocities),
            state.activations,
            state.controls,
            state.mocap_positions,
            state.mocap_quaternions,
            self._whole(self._velocities, force, jnp.zeros_like(state.velocities)),
            _first(jnp.asarray(prepared.dt, kind)),
            Vec.unstack(parameters.inertia).stack().reshape(-1, 3),
            Vec.unstack(parameters.center_of_gravity).stack().reshape(-1, 3),
            parameters.mass.reshape(-1),
            _first(parameters.gravity),
        )

    def _warn_of_steps(self, drone: Quadrotor) -> None:
        """MJCFs that do not say ask for MuJoCo's 2 ms, which stiff contacts need; only what was chosen is told."""
        own, asked = drone.dt / drone.substeps, float(self.mujoco_model.opt.timestep)
        if own > 1.01 * asked and asked != mujoco.MjModel.from_xml_string("<mujoco/>").opt.timestep:
            warnings.warn(
                f"{self.mjcf}: asks for steps of {1e3 * asked:g} ms, and is stepped every {1e3 * own:g} ms; give the "
                f"drone substeps={math.ceil(drone.dt / asked)} if things shake or fall through each other.",
                CfbWarning,
                stacklevel=3,
            )

    def _whole(self, places: tuple[np.ndarray, np.ndarray], own: Array, others: AnyArray) -> Array:
        """Numbers of the drone and of the others, in MuJoCo's order."""
        # Not by setting elements of an array: jaxlib 0.10 aborts while it fuses several of those, with the option of
        # `cfb_mjx.runtime.XLA_CPU_FLAGS`.
        return jnp.concatenate([own.reshape(-1), others])[
            np.argsort(np.concatenate([places[0].reshape(-1), places[1]]))
        ]

    def __eq__(self, other) -> bool:
        return type(other) is Scene and self._key == other._key

    def __hash__(self) -> int:
        return hash((Scene, self._key))

    @property
    def _key(self) -> tuple:
        return self.mjcf, self.engine, self.drones

    def __repr__(self) -> str:
        drones = "" if self.drones is None else f", drones={self.drones}"
        return f"Scene({self.mjcf!r}, engine={self.engine!r}{drones})"


def _components(prepared: Prepared, state: State) -> Components:
    return unstack(state, Vec.unstack(prepared.parameters.center_of_gravity))


def _driven(
    prepared: Prepared, at: Components, command: Array
) -> tuple[Components, tuple[Condition, ...], Vec, tuple[Array, Array]]:
    """Advance the rotors; return what every effect feels, the rotors' speeds after the step, and the wrench.

    That is the force [N, world] and the torque [N m, body] of rotors and effects about the rotors' centre.
    """
    path, memory = commanded_path(prepared, at.rotor_speed, at.memory, Vec.unstack(command))
    at = remembering(at, memory)
    loads = path.mean
    if prepared.model.rotor_loads == "instant":
        loads = rotors.loads_at(prepared.rotors, path.start, path.rate_start)
    felt = conditions(prepared, at, path.start)
    wrench = loaded(prepared.model, prepared.parameters, loads, felt)
    return at, felt, path.end, (rotate(at.quaternion, wrench.force).stack(), wrench.torque.stack())


def _moved(
    prepared: Prepared, at: Components, felt: tuple[Condition, ...], speed: Vec, pose: Array, twist: Array
) -> State:
    """State after a step that led to this pose and twist."""
    after, memory = State(pose[:3], twist[:3], pose[3:], twist[3:], speed.stack()), at.memory
    if prepared.model.effects:
        pushed = (_components(prepared, after).velocity - at.velocity) * prepared.rotors.inverse_dt
        memory = advanced(prepared, felt, pushed)
    return replace(after, memory=stacked(memory))


def _first(x: Array) -> Array:
    """A number that all drones share."""
    return x.reshape(-1)[0]


def _untouched(state: SceneState) -> SceneState:
    return replace(state, constraint=jnp.zeros_like(state.constraint))


def _spans(first: np.ndarray, count: int, total: int, several: bool) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the drones, and of everything else."""
    own = np.asarray(first)[:, None] + np.arange(count)
    return own if several else own[0], np.setdiff1d(np.arange(total), own)
