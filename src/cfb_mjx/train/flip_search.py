"""Find the knobs of a flip in simulation: the cross-entropy method over many flights at once.

Each round draws candidates from a Gaussian, flies them all, and moves the Gaussian to the best (Rubinstein 1999).
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
    """What is looked for.

    ``height``: the least vertical extent on the nominal drone. ``margin``: the most drones of the task's randomisation
    that complete the flip, and those as far above the floor as they can, while the nominal one keeps within
    ``extent_m``. ``within``: the most drones of the randomisation that complete it within ``extent_m`` themselves. All:
    turned ``rotations`` times, stopped and back within the limits below on the nominal drone.
    """

    rotations: int = 2
    aim: Literal["height", "margin", "within"] = "height"
    extent_m: float = 1.8
    rate_stop_s: float = 0.35
    vertical_stop_s: float = 0.6
    return_m: float = 0.1
    fall_mps: float = 0.0
    """How fast the nominal drone has to fall at least: the paper's does 3.5 m/s, and falling less is easy."""
    floor_m: float = FLOOR_M
    """How far below the start the floor is."""


_OF_SEARCH = 2**32 - 1
"""Derives the key of a search: the flights that judge what it finds have the keys 0, 1, 2 ... of the same seed."""


class Bounds(NamedTuple):
    """Where knobs are looked for: least and largest of each; equal ones stay as they are."""

    low: Knobs
    high: Knobs


def bounds(rotations: int = 2, **fixed: float) -> Bounds:
    """The usual ones for so many turns; keyword arguments fix knobs."""
    low = Knobs(0.5, 0.1, 0.2 * rotations, -3.0, 12.0, 1.0, 2 * jnp.pi * (rotations - 0.6))
    high = Knobs(6.0, 1.2, 0.55 * rotations + 0.2, 5.0, 21.0, 6.0, 2 * jnp.pi * (rotations + 0.1))
    return Bounds(low._replace(**fixed), high._replace(**fixed))


class Found(NamedTuple):
    """What a search came to."""

    knobs: Knobs
    cost: Float[Array, ""]
    history: Float[Array, " rounds"]
    """Cost of the best candidate of each round."""


def shortfall(goal: Goal, measured: Flips) -> Float[Array, "*drones"]:
    """How far nominal flights are from what every goal asks for; zero where it is all met."""

    def over(value: Array, limit: float, scale: float) -> Array:
        # A little less than the limit, so that another seed's noise does not cross it.
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
    """The knobs that serve ``goal`` best.

    Args:
        manoeuvre: what to improve: what is found serves no less than its knobs, where these lie within the bounds.
        task: with the randomisation that ``margin`` and ``within`` are about.
        nominal: the drone.
        goal: what to look for.
        key: decides candidates, drones and noise.
        within: where to look; `bounds` of the goal's rotations by default.
        rounds: of the search.
        candidates: per round.
        plants: randomised drones per candidate, for ``margin`` and ``within``.
        report: called after every round with its number and the cost of its best candidate.

    Raises:
        CfbError: ``margin`` or ``within`` is looked for where nothing is randomised.
    """
    if goal.aim != "height" and task.randomisation is None:
        raise CfbError(f"A flip's {goal.aim} is looked for on randomised drones; give the task a randomisation.")
    within = bounds(goal.rotations) if within is None else within
    task = with_room(task, nominal)
    low, high = (jnp.stack([jnp.asarray(x, float) for x in side]) for side in within)
    of_nominal, of_plants, of_draws = jax.random.split(key, 3)
    # A flight in sixteen that stops late is enough to be noticed.
    few = jax.random.split(of_nominal, 16)
    many = jax.random.split(of_plants, plants)
    mean, std = jnp.full(len(low), 0.5), jnp.full(len(low), 0.35)
    given = jnp.clip(jnp.stack([jnp.asarray(x, float) for x in manoeuvre.knobs]), low, high)
    best = jnp.where(high > low, (given - low) / jnp.where(high > low, high - low, 1.0), 0.0)
    least, history = jnp.asarray(jnp.inf), []
    for i in range(rounds):
        drawn = mean + std * jax.random.normal(jax.random.fold_in(of_draws, i), (candidates, len(low)))
        # The best so far flies again beside the others.
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
    """The manoeuvre with the knobs that serve ``goal`` best, to four decimals as a file has them.

    Args:
        manoeuvre: as for `search`, and so are task, nominal, goal, rounds and report.
        task: see there.
        nominal: see there.
        goal: see there.
        seed: of the search; flights of the same seed have other keys.
        fixed: names of knobs that stay as they are.
        rounds: see there.
        report: see there.
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
    # Where nearly all of them complete it, what tells candidates apart is how much they have left.
    deep = jnp.nan_to_num(-away.lowest_m, nan=9.0) / goal.floor_m
    near = jnp.mean(jnp.clip(deep - 0.5, 0.0, 0.5))
    if goal.aim == "within":
        near = jnp.mean(jnp.clip(high - 0.9 * goal.extent_m, 0.0, 2.0))
    turned = jnp.mean(jnp.minimum(1.0, jnp.abs(jnp.nan_to_num(away.rotations, nan=9.0) - goal.rotations)))
    wide = jnp.clip(extent - 0.97 * goal.extent_m, 0.0, 5.0)
    return lost + 0.3 * near + 0.3 * turned + 3 * missed + wide
