"""A world of one's own around the drone: any MJCF with gates, poles, platforms, other bodies, cables.

    scene = Scene("gates.xml")                           # without a drone: it is added
    state = scene.begin(drone, drone.hover_state())
    flown = scene.rollout(drone, state, commands)        # jit and vmap work as with `rollout`

MuJoCo moves all bodies and computes contacts and cables; this library computes the rotors' loads and the effects, and
applies them to the body ``cfb``. Two engines compute the same: ``mjx`` (MuJoCo XLA, on any device, forward-mode
derivatives) and ``c`` (MuJoCo's own C by `mujoco.batch`, on the CPU, no derivatives).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.model import rotors
from cfb_mjx.model.mjcf import BODY_NAME, compiled_scene
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
from cfb_mjx.model.state import AnyArray, State, stacked, unstack
from cfb_mjx.model.vector import Vec, rotate


class SceneState(eqx.Module):
    """State of a scene, or a batch or trajectory of states (leading axes)."""

    drone: State
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
    constraint: Float[AnyArray, "*batch 6"]
    """Force [N, world] and torque [N m, body] of contacts and cables on the drone: the largest since the last state
    that was returned, whatever was between. Zero: nothing was touched."""


class Scene:
    """A world with the drone. Static and hashable: functions may close over it under ``jit``.

    Args:
        mjcf: MJCF of the world. Its body ``cfb`` with a free joint is the drone, with the mass, the inertia and the
            centre of gravity of the parameters. If there is none, the drone of ``assets/cfb.xml`` is added; a body
            ``cfb`` that holds only sites or cameras, to which cables can be tied, becomes that drone.
        engine: ``mjx`` or ``c``.

    Raises:
        CfbError: the MJCF cannot be compiled, its body ``cfb`` has other joints, or it has a feature that MJX lacks.

    Warns:
        CfbWarning: the drone cannot touch some of its geoms (``contype`` and ``conaffinity``), or MuJoCo's own drag
            acts on the drone (``density`` and ``viscosity``).
    """

    def __init__(self, mjcf: str | Path, engine: Literal["mjx", "c"] = "mjx"):
        if engine not in ENGINES:
            raise CfbError(f"engine must be one of {', '.join(ENGINES)}, found {engine!r}.")
        self.mjcf, self.engine = str(mjcf), engine
        self.mujoco_model = compiled_scene(self.mjcf)
        joint = int(self.mujoco_model.body(BODY_NAME).jntadr[0])
        self._positions = _span(int(self.mujoco_model.jnt_qposadr[joint]), 7, self.mujoco_model.nq)
        self._velocities = _span(int(self.mujoco_model.jnt_dofadr[joint]), 6, self.mujoco_model.nv)

    def begin(self, drone: Quadrotor, state: State) -> SceneState:
        """Return the MJCF's initial state with the drone in ``state``.

        Args:
            drone: the drone, for the memory of its effects.
            state: state of the drone.

        Warns:
            CfbWarning: the MJCF asks for shorter steps than the drone's.
        """
        self._warn_of_steps(drone)
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
            np.zeros(6),
        )
        return SceneState(begin(drone, state), *(jnp.asarray(x, kind) for x in rest))

    def step(self, drone: Quadrotor, state: SceneState, command: Float[Array, "4"]) -> SceneState:
        """Advance everything by ``drone.dt`` with a constant ``command`` (clipped to [0, 1]).

        The integrator is the one of the MJCF's option, with steps of ``drone.dt / drone.substeps``; ``drone.body`` and
        ``drone.integrator`` are not used.
        """
        return self._advanced(prepare(drone), _untouched(state), Vec.unstack(command))

    def rollout(
        self, drone: Quadrotor, state: SceneState, commands: Float[Array, "steps 4"], *, hold: int = 1, every: int = 1
    ) -> SceneState:
        """Fly ``commands``, and return the states after every ``every``-th command; arguments as for `rollout`.

        Raises:
            ValueError: ``hold`` or ``every`` is below one, or ``every`` does not divide the number of commands.
        """
        steps = commands.shape[0]
        require_kept(steps, hold, every)
        prepared = prepare(drone)

        def one(state, row):
            def again(state, _):
                return self._advanced(prepared, state, Vec.unstack(row)), None

            return jax.lax.scan(again, state, length=hold)[0], None

        def some(state, rows):
            state = jax.lax.scan(one, _untouched(state), rows)[0]
            return state, state

        return jax.lax.scan(some, state, commands.reshape(steps // every, every, 4))[1]

    def _advanced(self, prepared: Prepared, state: SceneState, command: Vec) -> SceneState:
        for _ in range(prepared.model.substeps):
            state = self._integrated(prepared, state, command)
        return state

    def _integrated(self, prepared: Prepared, state: SceneState, command: Vec) -> SceneState:
        parameters, drone = prepared.parameters, prepared.model
        center = Vec.unstack(parameters.center_of_gravity)
        at = unstack(state.drone, center)
        path, memory = commanded_path(prepared, at.rotor_speed, at.memory, command)
        at = remembering(at, memory)
        loads = path.mean
        if drone.rotor_loads == "instant":
            loads = rotors.loads_at(prepared.rotors, path.start, path.rate_start)
        felt = conditions(prepared, at, path.start)
        wrench = loaded(drone, parameters, loads, felt)
        force = jnp.concatenate([rotate(at.quaternion, wrench.force).stack(), wrench.torque.stack()])
        moved = ENGINES[self.engine](self.mjcf, self.inputs(prepared, state, force))
        pose, twist = moved.positions[self._positions[0]], moved.velocities[self._velocities[0]]
        after = State(pose[:3], twist[:3], pose[3:], twist[3:], path.end.stack())
        if drone.effects:
            pushed = (unstack(after, center).velocity - at.velocity) * prepared.rotors.inverse_dt
            memory = advanced(prepared, felt, pushed)
        after = replace(after, memory=stacked(memory))
        force = moved.constraint[self._velocities[0]]
        larger = jnp.sum(force**2) > jnp.sum(jnp.asarray(state.constraint) ** 2)
        return SceneState(
            after,
            moved.positions[self._positions[1]],
            moved.velocities[self._velocities[1]],
            moved.activations,
            state.controls,
            state.mocap_positions,
            state.mocap_quaternions,
            state.time + jnp.asarray(prepared.dt, state.positions.dtype),
            jnp.where(larger, force, state.constraint),
        )

    def inputs(self, prepared: Prepared, state: SceneState, force: Float[Array, "6"] | None = None) -> Inputs:
        """What an engine needs of a state.

        Args:
            prepared: the drone.
            state: one state.
            force: force [N, world] and torque [N m, body] of rotors and effects about the rotors' centre; None: none.
        """
        parameters, now = prepared.parameters, state.drone
        kind = jnp.asarray(state.positions).dtype
        force = jnp.zeros(6, kind) if force is None else force
        return Inputs(
            self._whole(self._positions, jnp.concatenate([now.position, now.quaternion]), state.positions),
            self._whole(self._velocities, jnp.concatenate([now.velocity, now.body_rate]), state.velocities),
            state.activations,
            state.controls,
            state.mocap_positions,
            state.mocap_quaternions,
            self._whole(self._velocities, force, jnp.zeros_like(state.velocities)),
            jnp.asarray(prepared.dt, kind),
            Vec.unstack(parameters.inertia).stack(),
            Vec.unstack(parameters.center_of_gravity).stack(),
            jnp.stack([parameters.mass, parameters.gravity]),
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
        return jnp.concatenate([own, others])[np.argsort(np.concatenate(places))]

    def __eq__(self, other) -> bool:
        return type(other) is Scene and (self.mjcf, self.engine) == (other.mjcf, other.engine)

    def __hash__(self) -> int:
        return hash((Scene, self.mjcf, self.engine))

    def __repr__(self) -> str:
        return f"Scene({self.mjcf!r}, engine={self.engine!r})"


def _untouched(state: SceneState) -> SceneState:
    return replace(state, constraint=jnp.zeros_like(state.constraint))


def _span(first: int, count: int, total: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the drone, and of everything else."""
    own = np.arange(first, first + count)
    return own, np.setdiff1d(np.arange(total), own)
