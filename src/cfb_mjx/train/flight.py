"""One flight of a controller: on a drawn drone, with noise and late estimates, to a target or along a path.

Flights can be written as logs for `cfb evaluate`, `cfb fit` and `cfb view`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control.controllers import Controller
from cfb_mjx.envs.episode import Episode, reset, step
from cfb_mjx.envs.observation import Layout
from cfb_mjx.envs.path import Path
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.rotation import to_body
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State


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


def off_target(flown: Flight, dt: float, settled_s: float) -> Float[Array, "*drones steps"]:
    """Distance from the target in ``watched`` after every command, m, without the first ``settled_s`` seconds."""
    return jnp.linalg.norm(flown.position - flown.watched, axis=-1)[..., round(settled_s / dt) :]


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


def horizons_s(controller: Controller) -> tuple[float, ...]:
    """How far ahead of the target a controller sees, s; empty if it does not."""
    layout = getattr(controller, "layout", None)
    return layout.preview_s if isinstance(layout, Layout) else ()


def rows_along(controller: Controller, path: Path, steps: int) -> Rows:
    """Targets along a path, for a controller."""
    times = controller.control_dt_s * jnp.arange(steps + 1)
    places = jax.vmap(path)(times)
    ahead = None
    if horizons_s(controller):
        horizons = jnp.asarray(horizons_s(controller))
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
    path: Path | Rows | None = None,
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
