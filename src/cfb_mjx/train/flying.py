"""Fly controllers and measure them: hover, a step of six metres, recovery.

Named sets of drones are flown alike. Flights can be written as logs for `cfb evaluate`, `cfb fit` and `cfb view`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control.controllers import Controller
from cfb_mjx.documents import is_named, load_named, refuse_unknown, told
from cfb_mjx.envs.episode import Episode, reset, step
from cfb_mjx.envs.observation import Layout
from cfb_mjx.envs.path import Path as Way
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import Task, with_room
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.rotation import to_body
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rotors import balanced_thrust_to_weight
from cfb_mjx.model.state import State
from cfb_mjx.parameters import ModelFile

HOVER_S, SETTLING_S = 6.0, 1.0
"""The paper's hover test: its duration, and the initial time that is not counted."""
STEP_DISTANCE_M, ARRIVED_M, STEP_S = 6.0, 0.10, 4.0
"""The paper's back-and-forth test: distance, radius of arrival, and duration."""


class Flight(NamedTuple):
    """States and commands after every command; positions are relative to the target."""

    position: Float[Array, "*drones steps 3"]
    velocity: Float[Array, "*drones steps 3"]
    quaternion: Float[Array, "*drones steps 4"]
    body_rate: Float[Array, "*drones steps 3"]
    command: Float[Array, "*drones steps 4"]
    failed: Bool[Array, "*drones steps"]
    """Whether a limit of speed or rate has been exceeded so far."""
    watched: Any = None
    """Watched part of the controller's memory."""
    rotor_speed: Any = None
    """(*drones, steps, 4), rad/s."""


def steps_flown(flown: Flight, drone: int = 0) -> int:
    """Number of steps that a drone flew before it failed; all steps if it never did.

    Args:
        flown: flights, axes (drones, steps).
        drone: index of the drone.
    """
    numbers = [np.asarray(x)[drone] for x in (*flown[:5], flown.rotor_speed)]
    well = np.isfinite(np.concatenate(numbers, axis=1)).all(axis=1) & ~np.asarray(flown.failed)[drone]
    return len(well) if well.all() else int(np.argmin(well))


class Rows(NamedTuple):
    """Targets of every command, as a path has them (`rows_along`)."""

    target: Float[Array, "*steps 3"]
    ahead: Float[Array, "*steps displacements"] | None
    """How far the target will have moved after each of the controller's ``layout.preview_s``, m."""
    later: Float[Array, "*steps 3"] | None
    """Target after the command."""


def rows_along(controller: Controller, path: Way, steps: int) -> Rows:
    """Targets along a path, for a controller."""
    layout, dt = getattr(controller, "layout", None), controller.control_dt_s
    times = dt * jnp.arange(steps + 1)
    places = jax.vmap(path)(times)
    ahead = None
    if isinstance(layout, Layout) and layout.preview_s:
        horizons = jnp.asarray(layout.preview_s)
        seen = jax.vmap(lambda time: jax.vmap(lambda ahead: path(time + ahead))(horizons))(times[:-1])
        ahead = (seen - places[:-1, None]).reshape(steps, -1)
    return Rows(places[:-1], ahead, places[1:])


def fly(
    controller: Controller,
    task: TargetTask,
    nominal: Quadrotor,
    key: PRNGKeyArray,
    seconds: float,
    state: State | None = None,
    watch: Callable[[Any], Any] = lambda memory: None,
    targets: Float[Array, "steps 3"] | None = None,
    path: Way | Rows | None = None,
    between: Callable[[Episode, Rows], tuple[Episode, Rows]] | None = None,
    stop: Callable[[Any], Bool[Array, ""]] | None = None,
) -> Flight:
    """Fly to the origin once, on a drone drawn by the task. Use ``vmap`` over ``key`` (and ``state``) for many flights.

    If the controller's control step is shorter than the model's step, the simulation uses the control step.

    Args:
        controller: the controller.
        task: determines the drone and the noise.
        nominal: the nominal drone.
        key: determines drone, start and noise.
        seconds: duration, s.
        state: initial state; drawn by the task by default.
        watch: function of the controller's memory; its result is kept in ``watched``.
        targets: target of every command. With it, positions are in the world, and ``watched`` is the target.
        path: path of the target instead; policies that were trained to see ahead of it do so. ``watched`` is the
            target after every command, which the position after it should have reached.
        between: function that is called before every command, and may change the episode and the target. It is also
            called at the start, for the memory of effects that it adds to.
        stop: function of the controller's memory: whether its motors stop, whatever it commands. Default: never.
    """
    dt = controller.control_dt_s
    if dt < nominal.dt:
        nominal = replace(nominal, dt=dt)
    layout = getattr(controller, "layout", None)
    action = layout.action if isinstance(layout, Layout) else "motors"
    # Other controllers do not need the history that the episode keeps for a network, so keep it small.
    task = replace(task, layout=Layout(control_dt_s=dt, past_estimates=0, past_commands=0, action=action))
    steps = round(seconds / dt) if targets is None else len(targets)
    rows = Rows(targets, None, None) if targets is not None else path
    if rows is not None and not isinstance(rows, Rows):
        rows = rows_along(controller, rows, steps)
    episode = reset(task, nominal, key, state)
    if between is not None:
        episode, _ = between(episode, jax.tree.map(lambda x: x[0], rows))
    memory = controller.start(episode.estimate, task.action.settled(episode.motors))

    def one(carry, row):
        episode, memory, failed = carry
        if between is not None:
            episode, row = between(episode, row)
        target, ahead, later = (None, None, None) if row is None else row
        if target is not None:
            # The estimate was relative to the last target; make it relative to this one.
            seen = replace(episode.estimate, position=episode.estimate.position + episode.target - target)
            episode = replace(episode, origin=target, target=target, estimate=seen)
        given = () if ahead is None else (ahead,)
        memory, command = controller.command(memory, episode.estimate, *given)
        episode, outcome = step(task, episode, command, stopped=None if stop is None else stop(memory))
        failed = failed | outcome.failed
        state = episode.state
        moving = (state.position, state.velocity, state.quaternion, state.body_rate)
        position, velocity, quaternion, body_rate = map(jnp.asarray, moving)
        watched = watch(memory) if target is None else (target if later is None else later)
        row = Flight(position, velocity, quaternion, body_rate, episode.motors, failed, watched, state.rotor_speed)
        return (episode, memory, failed), row

    return jax.lax.scan(one, (episode, memory, jnp.asarray(False)), rows, length=steps)[1]


class Hover(NamedTuple):
    """Measurements of the paper's hover test, per drone."""

    mean_distance_m: Float[Array, "*drones"]
    horizontal_m: Float[Array, "*drones"]
    """Mean distance from the vertical line through the target."""
    vertical_m: Float[Array, "*drones"]
    """Mean absolute height difference to the target."""
    command_std: Float[Array, "*drones"]
    """Standard deviation of the command over time, mean of the four motors."""
    failed: Bool[Array, "*drones"]


def hover(controller: Controller, task: TargetTask, nominal: Quadrotor, keys: PRNGKeyArray) -> tuple[Hover, Flight]:
    """Hold the target for `HOVER_S` from a level start there, and measure after `SETTLING_S` (paper section VI).

    Args:
        controller: the controller.
        task: determines the drones and the noise.
        nominal: the nominal drone.
        keys: one key per flight.

    Returns:
        The measurements and the flights.
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
    """Measurements of a flight to a target at `STEP_DISTANCE_M`, per drone."""

    arrival_s: Float[Array, "*drones"]
    """First time within `ARRIVED_M` of the target; infinite if never."""
    peak_speed_mps: Float[Array, "*drones"]
    overshoot_m: Float[Array, "*drones"]
    """Largest distance beyond the target, along the path."""
    failed: Bool[Array, "*drones"]


def six_metres(controller: Controller, task: TargetTask, nominal: Quadrotor, keys: PRNGKeyArray) -> tuple[Step, Flight]:
    """Fly from hover to a target at a distance of `STEP_DISTANCE_M` along x; arguments as for `hover`."""
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
    """Fly from hover at the origin to a target that jumps between `STEP_DISTANCE_M` along x and the origin.

    Args:
        controller: the controller.
        task: determines the drone and the noise.
        nominal: the nominal drone.
        key: determines drone and noise.
        legs: number of jumps of the target; the first is at once.
        leg_s: time between two jumps, s.

    Returns:
        One flight with its ``position`` in the world; ``watched`` is the target (steps, 3).
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
    """Measurements of a throw, per drone."""

    recovered: Bool[Array, "*drones"]
    """No limit exceeded, and slow, level and within `CAUGHT_M` at the end."""
    lost_height_m: Float[Array, "*drones"]
    final_distance_m: Float[Array, "*drones"]
    failed: Bool[Array, "*drones"]
    thrust_to_weight: Float[Array, "*drones"]
    """Of the drone, with balanced torques: `balanced_thrust_to_weight`."""


RECOVERY_S, CAUGHT_M = 6.0, 0.75
"""Duration of the recovery test and radius of a catch. The duration is that of the hover test: the weakest drones of
the paper's randomisation lift hardly more than their weight, and need that long to climb back."""


def recovery(
    controller: Controller,
    task: TargetTask,
    nominal: Quadrotor,
    keys: PRNGKeyArray,
    tilt_deg: float = 60.0,
    speed: float = 3.0,
) -> tuple[Recovery, Flight]:
    """Throw drones at ``speed`` in a random direction, tilted about a random horizontal axis.

    A drone has recovered if after `RECOVERY_S` it is slower than 0.5 m/s, tilted by less than 30 deg and within
    `CAUGHT_M`, and has exceeded no limit on the way.

    Args:
        controller: the controller.
        task: determines the drones and the noise.
        nominal: the nominal drone.
        keys: one key per flight.
        tilt_deg: initial tilt, deg.
        speed: initial speed, m/s.

    Returns:
        The measurements and the flights.
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
        # The drone that `fly` draws from this key.
        drone = reset(task, nominal, of_flight, state).model.parameters
        return fly(controller, task, nominal, of_flight, RECOVERY_S, state), balanced_thrust_to_weight(drone)

    flown, strength = jax.vmap(thrown)(keys)
    distance = jnp.linalg.norm(flown.position[:, -1], axis=-1)
    slow = jnp.linalg.norm(flown.velocity[:, -1], axis=-1) < 0.5
    _, x, y, _ = jnp.moveaxis(flown.quaternion[:, -1], -1, 0)
    level = 1 - 2 * (x * x + y * y) > np.cos(np.radians(30.0))
    well = ~flown.failed[:, -1] & slow & level & (distance < CAUGHT_M)
    lost = -jnp.minimum(0.0, flown.position[..., 2].min(axis=1))
    return Recovery(well, lost, distance, flown.failed[:, -1], strength), flown


_AnyTask = TypeVar("_AnyTask", bound=Task)


def nominal_task(task: _AnyTask) -> _AnyTask:
    """Return the task without randomisation."""
    return replace(task, randomisation=None)


FORMAT = "cfb_mjx plants 1"


def load_plants(base: ModelFile, name_or_path: str | Path = "off-nominal") -> dict[str, Quadrotor]:
    """Read the drones of a shipped set or a YAML file: ``base`` with the effects that each entry adds.

    Args:
        base: model without these effects.
        name_or_path: name of a set, or file.

    Raises:
        CfbError: there is no such set, an entry has no name, an effect is unknown, or a value is impossible.
    """
    path, document = load_named(name_or_path, "set of plants", FORMAT, "plants")
    plants = {}
    refuse_unknown(document, {"format", "name", "description", "plants"}, path, "")
    listed = document.get("plants") or []
    if not isinstance(listed, list):
        raise CfbError(f"{path}: 'plants' must be a list, found {told(listed)}.")
    for item in listed:
        effects = item.get("effects") if isinstance(item, dict) else None
        if not isinstance(effects, list) or not all(map(is_named, effects)) or "name" not in item:
            raise CfbError(f"{path}: every plant needs a name and a list of effects, found {told(item)}.")
        refuse_unknown(item, {"name", "why", "effects"}, path, "plants.")
        if str(item["name"]) in plants:
            raise CfbError(f"{path}: two plants have the name {item['name']}; give each its own name.")
        where = f"{path}: plant {item['name']}"
        described = replace(base, name=str(item["name"]), effects=(*base.effects, *effects), path=where)
        plants[described.name] = Quadrotor.from_file(described)
    if not plants:
        raise CfbError(f"{path}: contains no plants.")
    return plants


def flight_log(flown: Flight, dt: float, name: str, gravity: float = 9.81, drone: int = 0) -> FlightLog:
    """Convert one flight to a log: true states, without delay or sensor noise, one row per command.

    The specific force is the mean over the control step before a row, as from a filtered accelerometer, in the body
    axes at the middle of that step: in a flip the body turns by a tenth of a radian from there to the end of the step.

    Args:
        flown: flights, axes (drones, steps).
        dt: time between two commands, s.
        name: name of the log.
        gravity: gravitational acceleration, m/s^2.
        drone: index of the drone.

    Raises:
        CfbError: the drone failed so early that its flight has no rows.
    """
    flight = {key: np.asarray(getattr(flown, key), float)[drone] for key in _FIELDS}
    # A row holds the command after it.
    rows = steps_flown(flown, drone) - 1
    if rows < 2:
        raise CfbError(f"{name}: the drone failed at once; there is no flight to log.")
    velocity, quaternion = flight["velocity"], flight["quaternion"][:rows]
    change = np.diff(velocity[:rows], axis=0, prepend=velocity[:1]) / dt
    change[0] = change[1]
    # Same sign as the row before: a quaternion and its negative are the same attitude.
    along = quaternion * np.sign(np.sum(quaternion * np.roll(quaternion, 1, axis=0), axis=1, keepdims=True))
    middle = along + np.roll(quaternion, 1, axis=0)
    middle[0] = quaternion[0]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return FlightLog(
        time=dt * np.arange(1, rows + 1),
        position=flight["position"][:rows],
        velocity=velocity[:rows],
        quaternion=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        body_rate=flight["body_rate"][:rows],
        specific_force=to_body(middle, change + np.array([0.0, 0.0, gravity])),
        command=np.clip(flight["command"][1 : rows + 1], 0.0, 1.0),
        rotor_speed=flight["rotor_speed"][:rows],
        metadata={"name": name, "source": "simulated by cfb fly", "format": "simulated", "observation_delay": 0.0},
    )


_FIELDS = ("position", "velocity", "quaternion", "body_rate", "command", "rotor_speed")
