"""Episodes of any task: on randomly drawn drones, seen through delayed, offset and noisy estimates.

`reset` begins an episode, `observe` returns what the controller sees, `step` flies one command. All are pure functions
of one drone; use ``vmap`` for many. Each episode carries its own drone, so randomisation needs nothing else. A `Task`
defines what the drone should do: `cfb_mjx.envs.target` and `cfb_mjx.envs.flip`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cfb_mjx.engine.draws import normal
from cfb_mjx.envs import observation as seen
from cfb_mjx.envs.observation import Memory, StateEstimate
from cfb_mjx.envs.task import Task, room_s
from cfb_mjx.firmware.actions import InnerLoop, start
from cfb_mjx.firmware.actions import command as follow
from cfb_mjx.firmware.pid import FirmwarePid
from cfb_mjx.model.delay import DelayLine
from cfb_mjx.model.quadrotor import Prepared, Quadrotor, advance, begin, prepare
from cfb_mjx.model.randomised import differences, require_possible, sample_drone
from cfb_mjx.model.rotors import steady_command
from cfb_mjx.model.state import AnyArray, Components, State, stack, unstack
from cfb_mjx.model.vector import Vec, exponential, multiply
from cfb_mjx.optional import not_none


class Streams(NamedTuple):
    """One key for each random part of an episode; nothing else may be drawn or derived from it.

    The position of a key determines its value, so add new keys at the end to keep the draws of the others.
    """

    drone: PRNGKeyArray
    start: PRNGKeyArray
    noise: PRNGKeyArray
    first_estimate: PRNGKeyArray
    mildness: PRNGKeyArray
    """Key of the factor on the ranges of randomisation."""
    setpoint: PRNGKeyArray

    @classmethod
    def of(cls, key: PRNGKeyArray) -> Streams:
        """Return the keys of the episode that ``key`` determines."""
        return cls(*(jax.random.fold_in(key, place) for place in range(len(cls._fields))))


class Pose(eqx.Module):
    """The part of the state that an estimator can know."""

    position: AnyArray
    velocity: AnyArray
    quaternion: AnyArray
    body_rate: AnyArray


class Episode(eqx.Module):
    """One flight in progress."""

    model: Quadrotor
    """The drone of this episode."""
    state: State
    origin: Float[Array, "3"]
    """The target as it was given to `reset`; paths begin here."""
    target: Float[Array, "3"]
    setpoint: Float[Array, " setpoints"]
    """Set-point beside the target; empty for tasks without one."""
    past: DelayLine
    """Past values of `Pose`, because estimates are delayed."""
    memory: Memory
    estimate: StateEstimate
    """What the controller sees now."""
    count: Int[Array, ""]
    key: PRNGKeyArray
    motors: Float[Array, "4"]
    """Command of the motors in the last step, 0 to 1; beneath a loop of the firmware its mean."""
    loop: InnerLoop | None
    """The firmware's loop between policy and motors; None without one."""


class Outcome(NamedTuple):
    """Result of a step."""

    reward: Float[Array, ""]
    failed: Bool[Array, ""]
    """The episode is over because a limit was passed or the state is not finite."""
    timed_out: Bool[Array, ""]
    """The episode is over because its time is up."""
    diverged: Bool[Array, ""]
    """It failed because its state is not finite."""


def reset(
    task: Task,
    nominal: Quadrotor,
    key: PRNGKeyArray,
    state: State | None = None,
    target: Float[AnyArray, "3"] | tuple[float, float, float] = (0.0, 0.0, 0.0),
    magnitude: Float[Array, ""] | float | None = None,
    setpoint: Float[AnyArray, " setpoints"] | tuple[float, ...] | None = None,
) -> Episode:
    """Begin an episode.

    Args:
        task: the task.
        nominal: drone about which the drone of this episode is drawn.
        key: determines the drone, the start and all noise.
        state: initial state; drawn by default.
        target: position to which estimates are relative, world, m; for a moving target the origin of its path.
        magnitude: magnitude of the randomisation; default: the task's. May be traced.
        setpoint: set-point beside the target; drawn by default.

    Returns:
        The episode at its start.

    Raises:
        CfbError: the ranges allow impossible drones (`cfb_mjx.model.require_possible`), the task has no room for the
            delays that can be drawn, or these are unknown because the model is traced.
    """
    room = room_s(task, nominal, magnitude)
    nominal = task.stepped(nominal)
    streams = Streams.of(key)
    model = nominal
    if task.randomisation is not None:
        factor = task.magnitude if magnitude is None else magnitude
        # Checked for the whole magnitude: the result must not depend on the grade that this key draws.
        require_possible(nominal, task.randomisation, factor)
        factor = factor * mildness(task, streams.mildness)
        model = sample_drone(streams.drone, nominal, task.randomisation, factor)
    origin = jnp.asarray(target, model.parameters.mass.dtype)
    drawn = task.draw_setpoint(streams.setpoint) if setpoint is None else setpoint
    setpoint = jnp.asarray(drawn, origin.dtype)
    target = task.target(setpoint, origin)
    state = task.draw_start(model, target, setpoint, streams.start) if state is None else state
    state = begin(model, state)
    past = DelayLine.filled(_pose(state), model.dt, room)
    estimate = _estimate(task, model, past, target, streams.first_estimate)
    motors = settled_command(model, state)
    memory = seen.start(task.layout, estimate, task.action.settled(motors))
    loop = None
    if task.action.has_loop:
        # The firmware was set for the nominal drone, not for the one that is flown.
        loop = start(task.action, FirmwarePid.hovering(nominal.changed_parameters()), state)
    count = jnp.asarray(0)
    return Episode(model, state, origin, target, setpoint, past, memory, estimate, count, streams.noise, motors, loop)


def mildness(task: Task, key: PRNGKeyArray) -> Float[Array, ""] | float:
    """Factor in [0, 1] on an episode's randomisation: uniform for a share ``task.graded`` of the episodes, else 1."""
    if not task.graded:
        return 1.0
    which, grade = jax.random.uniform(key, (2,))
    return jnp.where(which < task.graded, grade, 1.0)


def settled_command(model: Quadrotor, state: State) -> Float[Array, "4"]:
    """Command [0 to 1] that keeps the rotors at their present speeds, as a controller finds it at take-over."""
    return jnp.clip(steady_command(model.parameters, state.rotor_speed), 0.0, 1.0)


def choose(condition: Array, yes: Any, no: Any) -> Any:
    """``jnp.where`` on every array of two pytrees of the same structure; the condition's axes come first."""
    return jax.tree.map(
        lambda a, b: jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - condition.ndim)), a, b), yes, no
    )


def observe(task: Task, episode: Episode) -> Float[Array, " size"]:
    """Observation of the controller's network."""
    return seen.observation(task.layout, episode.memory, episode.estimate, task.shown(episode.setpoint))


def privileged(task: Task, nominal: Quadrotor, episode: Episode) -> Float[Array, " n"]:
    """Input of a value network: true frame, errors, rotor speeds, integral, set-points, differences of the drone.

    The reward decreases with norms of errors, whose kinks at zero a small network learns only slowly by itself.
    """
    state, parameters = episode.state, episode.model.parameters
    position = state.position - episode.target
    true = seen.frame(task.layout, StateEstimate(position, state.velocity, state.quaternion, state.body_rate))
    errors = task.errors(state, episode.target, episode.setpoint)
    parts = [true, errors, jnp.sqrt(errors), state.rotor_speed / parameters.reference_rotor_speed]
    parts.append(episode.memory.integral / task.layout.integral_limit_ms)
    if task.layout.shown:
        scales = (task.layout.preview_scale_m,) * (3 * len(task.layout.preview_s)) + task.layout.setpoint_scales
        parts.append(task.shown(episode.setpoint) / jnp.asarray(scales))
    if task.randomisation is not None:
        parts.append(differences(nominal, episode.model, task.randomisation))
    return jnp.concatenate(parts)


def step(
    task: Task,
    episode: Episode,
    command: Float[Array, "4"],
    prepared: Prepared | None = None,
    stopped: Bool[Array, ""] | None = None,
) -> tuple[Episode, Outcome]:
    """Fly ``command`` [0 to 1] for one control step.

    If the state becomes non-finite the episode has failed; it then keeps the last finite state and its estimates.

    Args:
        task: the task.
        episode: the episode so far.
        command: outputs of the policy, commands of M1..M4 unless ``task.layout.action`` says otherwise; clipped to
            [0, 1].
        prepared: `prepare(episode.model)`, if it has been computed already.
        stopped: whether the motors are switched off, whatever is commanded, and whatever the firmware's loop does.

    Returns:
        The episode after the step, and the outcome.
    """
    model = episode.model
    prepared = prepare(model) if prepared is None else prepared
    command = jnp.clip(command, 0.0, 1.0)
    of_state, of_estimate = jax.random.split(jax.random.fold_in(episode.key, episode.count))
    hold, noise = task.hold(model), task.noise
    scale = jnp.array([noise.state_velocity_mps] * 3 + [noise.state_rate_radps] * 3, command.dtype)
    kicks = scale * normal(of_state, (hold, 6), command.dtype)
    on = 1.0 if stopped is None else jnp.where(stopped, 0.0, 1.0)
    row, center = Vec.unstack(on * command), prepared.parameters.center_of_gravity

    def fly(carry: tuple[Components, tuple[InnerLoop, Array] | None], kick: Vec):
        at, beneath = carry
        motors = row
        if beneath is not None:
            # As arrays that XLA must not take apart again; see below.
            measured = jax.lax.optimization_barrier(stack(replace(at, memory=()), center))
            loop, motors = follow(task.action, beneath[0], measured, command, episode.target)
            beneath = loop, on * motors
            motors = Vec.unstack(jax.lax.optimization_barrier(beneath[1]))
        at = advance(prepared, at, motors)
        velocity, body_rate = at.velocity + Vec(*kick[:3]), at.body_rate + Vec(*kick[3:])
        at = Components(at.position, velocity, at.quaternion, body_rate, at.rotor_speed, at.memory)
        return (at, beneath), (at, None if beneath is None else beneath[1])

    # A loop, even of one step, and arrays stacked only after it: otherwise XLA fuses the dynamics into every such array
    # and, on CPU without multi-output fusion, computes them once per number, twenty times slower.
    beneath = None if episode.loop is None else (episode.loop, command)
    begun = unstack(episode.state, center), beneath
    (moved, beneath), (passed, commanded) = jax.lax.scan(fly, begun, Vec.unstack(kicks))
    loop, motors = (None, on * command) if beneath is None else (beneath[0], jnp.mean(not_none(commanded), axis=0))
    state, poses = stack(moved, center), _pose(stack(passed, center))
    finite = _finite(state)
    state = choose(finite, state, episode.state)
    poses = jax.tree.map(lambda new, old: jnp.where(finite, new, old), poses, _pose(episode.state))
    command = jnp.where(finite, command, 0.0)
    past = episode.past.push_all(poses)
    memory = seen.remember(task.layout, episode.memory, episode.estimate, command)
    setpoint = task.next_setpoint(episode.setpoint, state)
    target = task.target(setpoint, episode.origin)
    estimate = _estimate(task, model, past, target, of_estimate)
    count = episode.count + 1
    motors, loop = jnp.where(finite, motors, 0.0), choose(finite, loop, episode.loop)
    after = Episode(
        model, state, episode.origin, target, setpoint, past, memory, estimate, count, episode.key, motors, loop
    )
    reward = task.judge(state, target, setpoint, command, model.parameters)
    reward = jnp.where(finite, reward, task.diverged_reward)
    return after, Outcome(reward, task.failed(state) | ~finite, count >= task.episode_steps, ~finite)


def _finite(state: State) -> Bool[Array, ""]:
    parts = (state.position, state.velocity, state.quaternion, state.body_rate, state.rotor_speed)
    return jnp.all(jnp.isfinite(jnp.concatenate(parts)))


def _pose(state: State) -> Pose:
    return Pose(state.position, state.velocity, state.quaternion, state.body_rate)


def _estimate(task: Task, model: Quadrotor, past: DelayLine, target: Array, key: PRNGKeyArray) -> StateEstimate:
    parameters, noise = model.parameters, task.noise
    delay = parameters.pose_delay
    if noise.pose_jitter_s:
        # A separate key, so that the other noise is the same with and without jitter.
        delay = delay + noise.pose_jitter_s * jax.random.uniform(jax.random.fold_in(key, 1), (), delay.dtype)
    late = past.read(delay)
    if not task.lumped_delay:
        gyro = DelayLine(past.samples.body_rate, past.dt).read(parameters.gyro_delay)
        late = Pose(late.position, late.velocity, late.quaternion, gyro)
    errors = normal(key, (12,), late.position.dtype)
    # Interpolation between two unit quaternions is slightly shorter than one.
    q = late.quaternion / jnp.sqrt(jnp.sum(late.quaternion**2))
    turned = Vec.unstack(parameters.attitude_offset + noise.attitude_rad * errors[6:9])
    return StateEstimate(
        late.position - target + noise.position_m * errors[:3],
        late.velocity + noise.velocity_mps * errors[3:6],
        multiply(Vec.unstack(q), exponential(turned * 0.5)).stack(),
        late.body_rate + noise.rate_radps * errors[9:],
    )
