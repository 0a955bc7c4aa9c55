"""What ``cfb fly`` does for flips: put the manoeuvre together, and look for its knobs if that is asked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax

from cfb_mjx.cli.flying import Turn, asks_for_setpoints
from cfb_mjx.control.manoeuvre import Knobs, Manoeuvre
from cfb_mjx.control.manoeuvre_file import ManoeuvreFile, load_manoeuvre, save_manoeuvre
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.control.pilot import Pilot, find_pilot
from cfb_mjx.envs import TargetTask
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.runtime import Progress
from cfb_mjx.train.flip_search import Goal, bounds, search
from cfb_mjx.train.flips import FLIPS

OF_SEARCH = 2**32 - 1
"""Derives the key of a search: the flights that judge what it finds have the keys 0, 1, 2 ... of the same seed."""


def prepared(
    turner: Pilot, controller: str, task: str, turn: Turn, wild: TargetTask, nominal: Quadrotor, seed: int
) -> tuple[Manoeuvre, int]:
    """The manoeuvre to fly, and how often it turns.

    Args:
        turner: the flip policy.
        controller: its name.
        task: which flip.
        turn: the user's wishes.
        wild: with the randomisation that a search for margin is about.
        nominal: the drone.
        seed: of a search.

    Raises:
        CfbError: no flip policy, no target policy, or bad knobs.
    """
    if not asks_for_setpoints(turner):
        raise CfbError(
            f"{controller}: is no flip policy and cannot fly --task {task}; give flip, or one of cfb train flip."
        )
    described = load_manoeuvre(turn.knobs or task, turn.changes)
    described = replace(described, holder=turn.holder or described.holder)
    holder = find_pilot(described.holder, nominal)
    if not isinstance(holder, NeuralController) or asks_for_setpoints(holder):
        raise CfbError(f"holder {described.holder}: must be a target policy, for instance target or target-adaptive.")
    if described.rotations != FLIPS[task]:
        raise CfbError(f"--knobs {turn.knobs}: turn {described.rotations} times, --task {task} {FLIPS[task]} times.")
    manoeuvre = Manoeuvre(holder, turner, described.knobs)
    if turn.search is not None:
        bar, goal = Progress("searching"), Goal(described.rotations, turn.search)
        rounds = 20
        found = search(
            manoeuvre,
            wild,
            nominal,
            goal,
            jax.random.fold_in(jax.random.PRNGKey(seed), OF_SEARCH),
            bounds(described.rotations, **_fixed(turn.changes, described.knobs)),
            rounds,
            report=lambda done, cost: bar(done, rounds, f"cost {cost:.4f}"),
        )
        manoeuvre = Manoeuvre(holder, turner, Knobs(*(round(float(x), 4) for x in found.knobs)))
        print("knobs: " + ", ".join(f"{name} {float(x):.4g}" for name, x in manoeuvre.knobs._asdict().items()))
    if turn.keep is not None:
        _keep(manoeuvre, described, turn.keep)
    return manoeuvre, described.rotations


def _fixed(changes: tuple[str, ...], knobs: Knobs) -> dict[str, float]:
    return {name: getattr(knobs, name) for name in (change.partition("=")[0] for change in changes)}


def _keep(manoeuvre: Manoeuvre, described: ManoeuvreFile, path: Path) -> None:
    save_manoeuvre(replace(described, knobs=manoeuvre.knobs), path)
    print(f"knobs: {path}")
