"""Fly controllers and measure how: hover, a step of six metres, recovery."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control.controllers import Controller
from cfb_mjx.envs.episode import Task, reset, settled_command, step, with_room
from cfb_mjx.envs.observation import Layout
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State

HOVER_S, SETTLING_S = 6.0, 1.0
"""The paper's hover test: so long, of which the first second is not counted."""
STEP_DISTANCE_M, ARRIVED_M, STEP_S = 6.0, 0.10, 4.0
"""The paper's back-and-forth: how far, what counts as there, and how long it is watched."""


class Flight(NamedTuple):
    """After every command; positions relative to the target."""

    position: Float[Array, "*drones steps 3"]
    velocity: Float[Array, "*drones steps 3"]
    quaternion: Float[Array, "*drones steps 4"]
    body_rate: Float[Array, "*drones steps 3"]
    command: Float[Array, "*drones steps 4"]
    failed: Bool[Array, "*drones steps"]
    """Whether limits of speed or rate have been passed up to here."""
    watched: Any = None
    """What was asked to be seen of the controller's memory."""
    rotor_speed: Any = None
    """(*drones, steps, 4), rad/s."""


def steps_flown(flown: Flight, drone: int = 0) -> int:
    """How many steps one drone of several flew before it was lost; all of them if it never was.

    Args:
        flown: flights, axes (drones, steps).
        drone: which.
    """
    numbers = [np.asarray(x)[drone] for x in (*flown[:5], flown.rotor_speed)]
    well = np.isfinite(np.concatenate(numbers, axis=1)).all(axis=1) & ~np.asarray(flown.failed)[drone]
    return len(well) if well.all() else int(np.argmin(well))


def fly(
    controller: Controller,
    task: TargetTask,
    nominal: Quadrotor,
    key: PRNGKeyArray,
    seconds: float,
    state: State | None = None,
    watch: Callable[[Any], Any] = lambda memory: None,
    targets: Float[Array, "steps 3"] | None = None,
) -> Flight:
    """One flight to the origin on a drone drawn as the task says; ``vmap`` over ``key`` (and ``state``) for many.

    The simulation takes steps of the controller's control step where that is shorter than the model's. ``watch`` says
    what of the controller's memory to keep. With ``targets``, the target of every command, positions are the world's
    and the targets are what is watched.
    """
    dt = controller.control_dt_s
    if dt < nominal.dt:
        nominal = replace(nominal, dt=dt)
    # What the episode remembers for a network is of no use to other controllers; keep it small.
    task = replace(task, layout=Layout(control_dt_s=dt, past_estimates=0, past_commands=0))
    episode = reset(task, nominal, key, state)
    memory = controller.start(episode.estimate, settled_command(episode.model, episode.state))

    def one(carry, target):
        episode, memory, failed = carry
        if target is not None:
            # What was estimated for the last target is told for this one.
            seen = replace(episode.estimate, position=episode.estimate.position + episode.target - target)
            episode = replace(episode, target=target, estimate=seen)
        memory, command = controller.command(memory, episode.estimate)
        episode, outcome = step(task, episode, command)
        failed = failed | outcome.failed
        state = episode.state
        moving = (state.position, state.velocity, state.quaternion, state.body_rate)
        position, velocity, quaternion, body_rate = map(jnp.asarray, moving)
        watched = watch(memory) if target is None else target
        row = Flight(position, velocity, quaternion, body_rate, command, failed, watched, state.rotor_speed)
        return (episode, memory, failed), row

    steps = round(seconds / dt) if targets is None else len(targets)
    return jax.lax.scan(one, (episode, memory, jnp.asarray(False)), targets, length=steps)[1]


class Hover(NamedTuple):
    """Of the paper's hover test, per drone."""

    mean_distance_m: Float[Array, "*drones"]
    horizontal_m: Float[Array, "*drones"]
    """Mean distance from the vertical through the target."""
    vertical_m: Float[Array, "*drones"]
    """Mean difference in height, above or below."""
    command_std: Float[Array, "*drones"]
    """Standard deviation over time, mean of the four motors."""
    failed: Bool[Array, "*drones"]


def hover(controller: Controller, task: TargetTask, nominal: Quadrotor, keys: PRNGKeyArray) -> tuple[Hover, Flight]:
    """Start level at the target, hold it `HOVER_S` seconds, count all but the first `SETTLING_S` (paper section VI).

    Args:
        controller: what flies.
        task: says which drones and how much noise.
        nominal: the drone.
        keys: one per flight.
    """
    return _hover(controller, with_room(task, nominal), nominal, keys)


@eqx.filter_jit
def _hover(controller, task, nominal, keys):
    start = nominal.hover_state((0.0, 0.0, 0.0))
    flown = jax.vmap(lambda key: fly(controller, task, nominal, key, HOVER_S, start))(keys)
    counted = round(SETTLING_S / controller.control_dt_s)
    position = flown.position[:, counted:]
    distance, horizontal = (jnp.linalg.norm(position[..., :axes], axis=-1).mean(axis=1) for axes in (3, 2))
    vertical = jnp.abs(position[..., 2]).mean(axis=1)
    spread = flown.command[:, counted:].std(axis=1).mean(axis=-1)
    return Hover(distance, horizontal, vertical, spread, flown.failed[:, -1]), flown


class Step(NamedTuple):
    """Of a flight to a target `STEP_DISTANCE_M` away, per drone."""

    arrival_s: Float[Array, "*drones"]
    """First time nearer than `ARRIVED_M`; infinite if never."""
    peak_speed_mps: Float[Array, "*drones"]
    overshoot_m: Float[Array, "*drones"]
    """How far beyond the target, along the way."""
    failed: Bool[Array, "*drones"]


def six_metres(controller: Controller, task: TargetTask, nominal: Quadrotor, keys: PRNGKeyArray) -> tuple[Step, Flight]:
    """From hover, `STEP_DISTANCE_M` away along x; the flights too."""
    return _six_metres(controller, with_room(task, nominal), nominal, keys)


@eqx.filter_jit
def _six_metres(controller, task, nominal, keys):
    start = nominal.hover_state((-STEP_DISTANCE_M, 0.0, 0.0))
    flown = jax.vmap(lambda key: fly(controller, task, nominal, key, STEP_S, start))(keys)
    distance = jnp.linalg.norm(flown.position, axis=-1)
    times = controller.control_dt_s * (1 + jnp.arange(distance.shape[1]))
    arrival = jnp.min(jnp.where(distance < ARRIVED_M, times, jnp.inf), axis=1)
    speed = jnp.linalg.norm(flown.velocity, axis=-1).max(axis=1)
    return Step(arrival, speed, jnp.maximum(0.0, flown.position[..., 0].max(axis=1)), flown.failed[:, -1]), flown


def back_and_forth(
    controller: Controller, task: TargetTask, nominal: Quadrotor, key: PRNGKeyArray, legs: int = 4, leg_s: float = 3.0
) -> Flight:
    """From hover at the origin, to a target that jumps between `STEP_DISTANCE_M` along x and the origin.

    Args:
        controller: what flies.
        task: says which drone and how much noise.
        nominal: the drone.
        key: of drone and noise.
        legs: how often the target jumps, at once and then every ``leg_s`` [s].
        leg_s: see there.

    Returns:
        One flight, its ``position`` in the world; ``watched`` is the target (steps, 3).
    """
    return _back_and_forth(controller, with_room(task, nominal), nominal, key, legs, leg_s)


@eqx.filter_jit
def _back_and_forth(controller, task, nominal, key, legs, leg_s):
    far = jnp.array([STEP_DISTANCE_M, 0.0, 0.0])
    targets = jnp.repeat(
        jnp.stack([far * ((leg + 1) % 2) for leg in range(legs)]), round(leg_s / controller.control_dt_s), 0
    )
    return fly(controller, task, nominal, key, legs * leg_s, nominal.hover_state((0.0, 0.0, 0.0)), targets=targets)


class Recovery(NamedTuple):
    """Of a throw, per drone."""

    recovered: Bool[Array, "*drones"]
    """No limit passed, and slow, level and within `CAUGHT_M` at the end."""
    lost_height_m: Float[Array, "*drones"]
    final_distance_m: Float[Array, "*drones"]
    failed: Bool[Array, "*drones"]


RECOVERY_S, CAUGHT_M = 6.0, 0.75
"""As long as the hover test: the weakest drones of the paper's randomisation lift hardly more than their weight, and
need that long to climb back."""


def recovery(
    controller: Controller,
    task: TargetTask,
    nominal: Quadrotor,
    keys: PRNGKeyArray,
    tilt_deg: float = 60.0,
    speed: float = 3.0,
) -> tuple[Recovery, Flight]:
    """Thrown at ``speed`` [m/s] in a random direction with ``tilt_deg`` of tilt about a random level axis.

    Recovered is who is below 0.5 m/s, tilted less than 30 deg and within `CAUGHT_M` after `RECOVERY_S` without having
    passed a limit on the way.
    """
    return _recovery(controller, with_room(task, nominal), nominal, keys, jnp.asarray(tilt_deg), jnp.asarray(speed))


@eqx.filter_jit
def _recovery(controller, task, nominal, keys, tilt_deg, speed):
    hovering = nominal.hover_state((0.0, 0.0, 0.0))

    def thrown(key):
        of_flight, of_axis, of_way = jax.random.split(key, 3)
        angle = jax.random.uniform(of_axis, minval=0.0, maxval=2 * jnp.pi)
        half = jnp.radians(tilt_deg) / 2
        quaternion = jnp.stack(
            [jnp.cos(half), jnp.sin(half) * jnp.cos(angle), jnp.sin(half) * jnp.sin(angle), jnp.zeros(())]
        )
        way = jax.random.normal(of_way, (3,))
        state = State(
            hovering.position,
            speed * way / jnp.linalg.norm(way),
            quaternion,
            hovering.body_rate,
            hovering.rotor_speed,
            hovering.memory,
        )
        return fly(controller, task, nominal, of_flight, RECOVERY_S, state)

    flown = jax.vmap(thrown)(keys)
    distance = jnp.linalg.norm(flown.position[:, -1], axis=-1)
    slow = jnp.linalg.norm(flown.velocity[:, -1], axis=-1) < 0.5
    _, x, y, _ = jnp.moveaxis(flown.quaternion[:, -1], -1, 0)
    level = 1 - 2 * (x * x + y * y) > np.cos(np.radians(30.0))
    well = ~flown.failed[:, -1] & slow & level & (distance < CAUGHT_M)
    lost = -jnp.minimum(0.0, flown.position[..., 2].min(axis=1))
    return Recovery(well, lost, distance, flown.failed[:, -1]), flown


_AnyTask = TypeVar("_AnyTask", bound=Task)


def nominal_task(task: _AnyTask) -> _AnyTask:
    """The same task on the nominal drone."""
    return replace(task, randomisation=None)


TESTS: dict[str, Callable[..., tuple[Any, Flight]]] = {"hover": hover, "step": six_metres, "recover": recovery}
"""Each takes controller, task, nominal drone and keys, and returns what it measured and the flights."""
