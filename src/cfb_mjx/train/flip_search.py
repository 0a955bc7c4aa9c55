"""Search the knobs of a flip in simulation: the cross-entropy method over many flights at once.

Each round draws candidates from a Gaussian, flies them all, and fits the Gaussian to the best (Rubinstein 1999).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.control.manoeuvre import Knobs, Manoeuvre
from cfb_mjx.envs.episode import with_room
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.train.flips import FLOOR_M, Flips, flips
from cfb_mjx.train.flying import nominal_task


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
