"""Fly controllers and measure them: hover, a step of six metres, recovery.

Named sets of drones are flown alike.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control.controllers import Controller
from cfb_mjx.documents import is_named, load_named, refuse_unknown, told
from cfb_mjx.envs.episode import reset
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import Task, with_room
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rotors import balanced_thrust_to_weight
from cfb_mjx.model.state import State
from cfb_mjx.parameters import ModelFile
from cfb_mjx.train.flight import Flight, fly

HOVER_S, SETTLING_S = 6.0, 1.0
"""The paper's hover test: its duration, and the initial time that is not counted."""
STEP_DISTANCE_M, ARRIVED_M, STEP_S = 6.0, 0.10, 4.0
"""The paper's back-and-forth test: distance, radius of arrival, and duration."""


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
