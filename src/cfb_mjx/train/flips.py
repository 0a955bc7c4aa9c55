"""Fly flips and measure them: rotations, height, times to stop the rotation and the fall, and the error of return.

`search` chooses the numbers that shape a flip in simulation, by the cross-entropy method over many flights at once.

Each round draws candidates from a Gaussian, flies them all, and fits the Gaussian to the best (Rubinstein 1999).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control.manoeuvre import CATCH, Knobs, Manoeuvre, roll_angle, unwrapped
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.envs.episode import observe, reset, step
from cfb_mjx.envs.flip import FlipTask, deviations
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import QUIET, with_room
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rollout import rollout
from cfb_mjx.model.rotors import thrust
from cfb_mjx.train.flight import Flight, fly
from cfb_mjx.train.flying import CAUGHT_M, nominal_task

FLIPS = {"flip": 1, "double-flip": 2, "triple-flip": 3}
"""Number of rotations of each manoeuvre."""
FLIP_S, COUNTED_S = 6.0, 1.0
"""Duration of a flip's flight, and of its end over which the return is measured, s."""
STOPPED_RADPS = np.radians(100.0)
"""Rate below which a drone has stopped turning (paper section VI)."""
FLOOR_M = 2.0
"""Height of the start of a flip above the floor, m."""


class Flips(NamedTuple):
    """Measurements of flips, per drone."""

    rotations: Float[Array, "*drones"]
    """Rotations about the x axis in the whole flight."""
    vertical_extent_m: Float[Array, "*drones"]
    """Height of the highest point above the lowest."""
    lowest_m: Float[Array, "*drones"]
    """Lowest point relative to the start."""
    peak_rate_radps: Float[Array, "*drones"]
    """Largest body rate about x."""
    rate_stop_s: Float[Array, "*drones"]
    """Time from the switch to the target policy until the body rate is below `STOPPED_RADPS`; infinite if never."""
    vertical_stop_s: Float[Array, "*drones"]
    """Time from that switch until the drone no longer falls; infinite if never."""
    fall_mps: Float[Array, "*drones"]
    """Largest downward speed."""
    return_error_m: Float[Array, "*drones"]
    """Mean distance from the start over the last `COUNTED_S`."""
    failed: Bool[Array, "*drones"]
    """Whether a limit of speed or rate was exceeded."""

    def completed(self, rotations: int, floor_m: float = FLOOR_M) -> Bool[Array, "*drones"]:
        """Whether a flip has the right rotations, is caught within `CAUGHT_M`, did not fail and stayed above the floor.

        Args:
            rotations: required number of rotations.
            floor_m: distance of the floor below the start, m.
        """
        right = jnp.abs(self.rotations - rotations) < 0.25
        return right & ~self.failed & (self.return_error_m < CAUGHT_M) & (self.lowest_m > -floor_m)


def flips(
    manoeuvre: Manoeuvre, task: TargetTask, nominal: Quadrotor, keys: PRNGKeyArray, seconds: float = FLIP_S
) -> tuple[Flips, Flight]:
    """Hover at the start, flip and return; one flight per key.

    Args:
        manoeuvre: manoeuvre to fly.
        task: determines the drones and the noise.
        nominal: the nominal drone.
        keys: one key per flight.
        seconds: duration of a flight; at least that of the manoeuvre plus `COUNTED_S`.

    Returns:
        The measurements and the flights.
    """
    return _flips(manoeuvre, with_room(task, nominal), nominal, keys, seconds)


@eqx.filter_jit
def _flips(manoeuvre, task, nominal, keys, seconds):
    start = nominal.hover_state((0.0, 0.0, 0.0))
    flown = jax.vmap(lambda key: fly(manoeuvre, task, nominal, key, seconds, start, lambda m: m.phase))(keys)
    return measure(flown, manoeuvre.control_dt_s), flown


def measure(flown: Flight, dt: float) -> Flips:
    """Measure flights of manoeuvres, axes (drones, steps), with their phases watched and a command every ``dt`` [s]."""
    # A command of the catch phase has been flown for dt when its row is written.
    since = dt * jnp.cumsum(flown.watched == CATCH, axis=-1)

    def first(condition: Array) -> Array:
        return jnp.min(jnp.where(condition & (since > 0), since, jnp.inf), axis=-1)

    height, rising = flown.position[..., 2], flown.velocity[..., 2]
    distance = jnp.linalg.norm(flown.position[..., -round(COUNTED_S / dt) :, :], axis=-1)
    return Flips(
        rotations=unwrapped(roll_angle(flown.quaternion))[..., -1] / (2 * jnp.pi),
        vertical_extent_m=jnp.max(height, axis=-1) - jnp.min(height, axis=-1),
        lowest_m=jnp.min(height, axis=-1),
        peak_rate_radps=jnp.max(flown.body_rate[..., 0], axis=-1),
        rate_stop_s=first(jnp.linalg.norm(flown.body_rate, axis=-1) < STOPPED_RADPS),
        vertical_stop_s=first(rising >= 0),
        fall_mps=jnp.max(-rising, axis=-1),
        return_error_m=distance.mean(axis=-1),
        failed=flown.failed[..., -1],
    )


class Turning(NamedTuple):
    """Measurements of a flip policy alone, per drone; means from `SPUN_UP_S` on."""

    rate_error_radps: Float[Array, "*drones"]
    axis_error: Float[Array, "*drones"]
    """Distance of the body's x axis from its wanted direction."""
    command_change: Float[Array, "*drones"]
    """Root mean square change from one command to the next."""
    failed: Bool[Array, "*drones"]


TURNING_S, SPUN_UP_S, RISING_MPS = 1.0, 0.3, 3.5
"""Duration of a policy's turn, start of the counted part, and initial upward speed."""


def turning(controller: NeuralController, task: FlipTask, nominal: Quadrotor, keys: PRNGKeyArray) -> Turning:
    """Turn for `TURNING_S` at the middle of the task's set-points, from level flight at `RISING_MPS` upwards.

    Args:
        controller: flip policy.
        task: determines the set-points, the drones and the noise.
        nominal: the nominal drone.
        keys: one key per flight.
    """
    return _turning(controller, with_room(task, nominal), nominal, keys)


@eqx.filter_jit
def _turning(controller, task, nominal, keys):
    ranges = jnp.array([task.setpoints.speed_mps, task.setpoints.rate_radps])
    hovering = nominal.hover_state((0.0, 0.0, 0.0))
    start = eqx.tree_at(lambda s: s.velocity, hovering, jnp.array([0.0, 0.0, RISING_MPS]))

    def one(key):
        episode = reset(task, nominal, key, start, setpoint=ranges.mean(axis=1))

        def forward(carry, _):
            episode, failed = carry
            command = controller.act(observe(task, episode))
            after, outcome = step(task, episode, command)
            _, axis, rate = deviations(after.state, after.setpoint, task.reward.axis_direction)
            failed = failed | outcome.failed
            return (after, failed), (jnp.linalg.norm(rate), jnp.linalg.norm(axis), command)

        steps = round(TURNING_S / task.layout.control_dt_s)
        (_, failed), (rate, axis, command) = jax.lax.scan(forward, (episode, jnp.asarray(False)), length=steps)
        counted = round(SPUN_UP_S / task.layout.control_dt_s)
        change = jnp.sqrt(jnp.mean(jnp.diff(command[counted:], axis=0) ** 2))
        return Turning(rate[counted:].mean(), axis[counted:].mean(), change, failed)

    return jax.vmap(one)(keys)


class Replay(NamedTuple):
    """A flip without noise on the nominal drone, and its commands flown again in open loop."""

    apart_m: Float[Array, ""]
    """Largest distance between the two flights."""
    largest_thrust_n: Float[Array, ""]
    """Largest force other than gravity in the flight: mass times the velocity change over a control step, per time."""
    model_thrust_n: Float[Array, ""]
    """Thrust of the motor model at full command."""


def replay(manoeuvre: Manoeuvre, nominal: Quadrotor) -> Replay:
    """Fly a manoeuvre without noise, and fly its commands again in open loop."""
    return _replay(manoeuvre, with_room(TargetTask(noise=QUIET), nominal), nominal)


@eqx.filter_jit
def _replay(manoeuvre, task, nominal):
    start, dt = nominal.hover_state((0.0, 0.0, 0.0)), manoeuvre.control_dt_s
    flown = fly(manoeuvre, task, nominal, jax.random.PRNGKey(0), FLIP_S, start)
    again = rollout(nominal, start, flown.command, hold=round(dt / nominal.dt))
    apart = jnp.max(jnp.linalg.norm(again.position - flown.position, axis=-1))
    parameters = nominal.changed_parameters()
    force = jnp.diff(flown.velocity, axis=0) / dt + parameters.gravity * jnp.array([0.0, 0.0, 1.0])
    full = thrust(parameters, parameters.motor_gain * jnp.ones(4) + parameters.motor_speed_offset)
    return Replay(apart, parameters.mass * jnp.max(jnp.linalg.norm(force, axis=-1)), jnp.sum(full))


@dataclass(frozen=True)
class Goal:
    """Goal of a search.

    ``aim`` is one of: ``height``, the smallest vertical extent on the nominal drone; ``margin``, the largest share of
    the task's randomised drones that complete the flip, as far above the floor as possible, while the nominal drone
    stays within ``extent_m``; ``within``, the largest share of randomised drones that complete it within ``extent_m``
    themselves. In all cases the nominal drone must turn ``rotations`` times, stop, and return within the limits below.
    """

    rotations: int = 2
    aim: Literal["height", "margin", "within"] = "height"
    extent_m: float = 1.8
    rate_stop_s: float = 0.35
    vertical_stop_s: float = 0.6
    return_m: float = 0.1
    fall_mps: float = 0.0
    """Lowest required peak falling speed of the nominal drone: 3.5 m/s in the paper; falling less is easy."""
    floor_m: float = FLOOR_M
    """Distance of the floor below the start."""


_OF_SEARCH = 2**32 - 1
"""Derives the key of a search; the flights that evaluate its result use the keys 0, 1, 2 ... of the same seed."""


class Bounds(NamedTuple):
    """Search range of each knob; knobs with equal bounds are fixed."""

    low: Knobs
    high: Knobs


def bounds(rotations: int = 2, **fixed: float) -> Bounds:
    """Return the default bounds for so many rotations; keyword arguments fix knobs."""
    low = Knobs(0.5, 0.1, 0.2 * rotations, -3.0, 12.0, 1.0, 2 * jnp.pi * (rotations - 0.6))
    high = Knobs(6.0, 1.2, 0.55 * rotations + 0.2, 5.0, 21.0, 6.0, 2 * jnp.pi * (rotations + 0.1))
    return Bounds(low._replace(**fixed), high._replace(**fixed))


class Found(NamedTuple):
    """Result of a search."""

    knobs: Knobs
    cost: Float[Array, ""]
    history: Float[Array, " rounds"]
    """Cost of the best candidate of each round."""


def shortfall(goal: Goal, measured: Flips) -> Float[Array, "*drones"]:
    """Cost of what nominal flights miss of the requirements of every goal; zero if all are met."""

    def over(value: Array, limit: float, scale: float) -> Array:
        # A margin of 3 %, so that the noise of another seed does not exceed the limit.
        return jnp.minimum(1.0, jnp.maximum(0.0, jnp.nan_to_num(value, nan=1e3) - 0.97 * limit) / scale)

    return (
        3 * measured.failed
        + jnp.minimum(2.0, jnp.abs(jnp.nan_to_num(measured.rotations, nan=9.0) - goal.rotations))
        + over(measured.rate_stop_s, goal.rate_stop_s, 0.5)
        + over(measured.vertical_stop_s, goal.vertical_stop_s, 0.5)
        + over(measured.return_error_m, goal.return_m, 0.5)
        + jnp.clip(goal.fall_mps - jnp.nan_to_num(measured.fall_mps), 0.0, 1.0)
    )


def search(
    manoeuvre: Manoeuvre,
    task: TargetTask,
    nominal: Quadrotor,
    goal: Goal,
    key: PRNGKeyArray,
    within: Bounds | None = None,
    rounds: int = 20,
    candidates: int = 48,
    plants: int = 160,
    report: Callable[[int, float], None] = lambda round, cost: None,
) -> Found:
    """Search the knobs that meet ``goal`` best.

    Args:
        manoeuvre: manoeuvre to improve. If its knobs are within the bounds, the result is at least as good.
        task: task whose randomisation the aims ``margin`` and ``within`` use.
        nominal: the drone.
        goal: goal of the search.
        key: determines candidates, drones and noise.
        within: bounds of the knobs; default: `bounds` of the goal's rotations.
        rounds: number of rounds.
        candidates: candidates per round.
        plants: randomised drones per candidate, for ``margin`` and ``within``.
        report: called after every round with its number and the cost of its best candidate.

    Returns:
        The best knobs, their cost, and the history of the search.

    Raises:
        CfbError: the aim is ``margin`` or ``within``, but the task has no randomisation.
    """
    if goal.aim != "height" and task.randomisation is None:
        raise CfbError(f"The aim '{goal.aim}' of a flip needs randomised drones; give the task a randomisation.")
    within = bounds(goal.rotations) if within is None else within
    task = with_room(task, nominal)
    low, high = (jnp.stack([jnp.asarray(x, float) for x in side]) for side in within)
    of_nominal, of_plants, of_draws = jax.random.split(key, 3)
    # With 16 flights, one that stops late is noticed.
    few = jax.random.split(of_nominal, 16)
    many = jax.random.split(of_plants, plants)
    mean, std = jnp.full(len(low), 0.5), jnp.full(len(low), 0.35)
    given = jnp.clip(jnp.stack([jnp.asarray(x, float) for x in manoeuvre.knobs]), low, high)
    best = jnp.where(high > low, (given - low) / jnp.where(high > low, high - low, 1.0), 0.0)
    least, history = jnp.asarray(jnp.inf), []
    for i in range(rounds):
        drawn = mean + std * jax.random.normal(jax.random.fold_in(of_draws, i), (candidates, len(low)))
        # The best candidate so far flies again beside the others.
        units = jnp.clip(drawn, 0.0, 1.0).at[0].set(best)
        found = _costs(units, low, high, manoeuvre, task, nominal, goal, few, many)
        order = jnp.argsort(found)[: max(4, candidates // 8)]
        mean, std = units[order].mean(axis=0), units[order].std(axis=0) + 0.02 * (1 - i / rounds)
        best, least = units[order[0]], found[order[0]]
        history.append(least)
        report(i + 1, float(least))
    return Found(Knobs(*(low + (high - low) * best)), least, jnp.stack(history))


def improved(
    manoeuvre: Manoeuvre,
    task: TargetTask,
    nominal: Quadrotor,
    goal: Goal,
    seed: int,
    fixed: Sequence[str] = (),
    rounds: int = 20,
    report: Callable[[int, float], None] = lambda round, cost: None,
) -> Manoeuvre:
    """Return the manoeuvre with the knobs that meet ``goal`` best, rounded to four decimals as in a file.

    Args:
        manoeuvre: as for `search`.
        task: as for `search`.
        nominal: as for `search`.
        goal: as for `search`.
        seed: seed of the search; flights with the same seed have other keys.
        fixed: names of knobs that stay unchanged.
        rounds: as for `search`.
        report: as for `search`.
    """
    key = jax.random.fold_in(jax.random.PRNGKey(seed), _OF_SEARCH)
    within = bounds(goal.rotations, **{name: getattr(manoeuvre.knobs, name) for name in fixed})
    found = search(manoeuvre, task, nominal, goal, key, within, rounds, report=report)
    return Manoeuvre(manoeuvre.holder, manoeuvre.turner, Knobs(*(round(float(x), 4) for x in found.knobs)))


@eqx.filter_jit
def _costs(units, low, high, manoeuvre, task, nominal, goal, few, many):
    def one(unit):
        knobs = Knobs(*(low + (high - low) * unit))
        return _cost(Manoeuvre(manoeuvre.holder, manoeuvre.turner, knobs), task, nominal, goal, few, many)

    return jax.vmap(one)(units)


def _cost(manoeuvre, task, nominal, goal, few, many) -> Float[Array, ""]:
    at_home = flips(manoeuvre, nominal_task(task), nominal, few)[0]
    missed = jnp.mean(shortfall(goal, at_home))
    extent = jnp.max(jnp.nan_to_num(at_home.vertical_extent_m, nan=1e3))
    if goal.aim == "height":
        return jnp.minimum(extent, 20.0) + 10 * missed
    away = flips(manoeuvre, task, nominal, many)[0]
    completed = away.completed(goal.rotations, goal.floor_m)
    high = jnp.nan_to_num(away.vertical_extent_m, nan=9.0)
    if goal.aim == "within":
        completed &= high <= goal.extent_m
    lost = 1 - jnp.mean(completed)
    # If nearly all drones complete the flip, candidates differ by their remaining margin.
    deep = jnp.nan_to_num(-away.lowest_m, nan=9.0) / goal.floor_m
    near = jnp.mean(jnp.clip(deep - 0.5, 0.0, 0.5))
    if goal.aim == "within":
        near = jnp.mean(jnp.clip(high - 0.9 * goal.extent_m, 0.0, 2.0))
    turned = jnp.mean(jnp.minimum(1.0, jnp.abs(jnp.nan_to_num(away.rotations, nan=9.0) - goal.rotations)))
    wide = jnp.clip(extent - 0.97 * goal.extent_m, 0.0, 5.0)
    return lost + 0.3 * near + 0.3 * turned + 3 * missed + wide
