"""Choose a flight that distinguishes effects which earlier flights hardly distinguish.

Every path is flown in simulation by a drone that has one of the effects. Then each other effect is fitted to that
flight in its place. The log-likelihood that it fails to explain, in nats, is the information of the path about this
pair of effects. A path is ranked by the pair about which it has the least information.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from cfb_mjx.control import FirmwarePid, PositionHold
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import CATALOGUE, SENSOR_FAULTS, Effect
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.sysid.excitation.conditions import Conditions
from cfb_mjx.sysid.excitation.experiment import TICK, Experiment, follow
from cfb_mjx.sysid.excitation.paths import PATHS, path
from cfb_mjx.sysid.tracing.fits import confirm
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors

TYPICAL = 0.2
"""Assumed strength of an effect that the model does not have, as a share of the upper end of its prior range."""
ENOUGH = 10.0
"""Nats required to decide between two effects: odds of twenty thousand to one."""
REACH = 5.0
"""A flight that deviates by more than this from its path, m, counts as not having followed it."""


@dataclass(frozen=True)
class Told:
    """Information of a path about pairs of effects.

    Attributes:
        path: name of the path.
        nats: log-likelihood per flight that the second effect cannot explain, by (true effect, second effect).
        flown: flight with the first of the effects.
        followed: whether every simulated drone followed the path.
    """

    path: str
    nats: dict[tuple[str, str], float]
    flown: Experiment
    followed: bool

    @property
    def worst(self) -> float:
        """Smallest number of nats over all pairs; zero if a drone did not follow the path."""
        return min(self.nats.values()) if self.followed else 0.0

    @property
    def flights(self) -> int | None:
        """Number of flights that decide every pair; None if 100 or more would be needed."""
        return max(1, int(np.ceil(ENOUGH / self.worst))) if self.worst > ENOUGH / 100 else None

    def to_json(self) -> dict[str, Any]:
        """All results except the flight as a JSON-compatible dictionary."""
        nats = {f"{true} against {other}": value for (true, other), value in self.nats.items()}
        return {"nats": nats, "flights": self.flights, "followed": self.followed}


def assumed(name: str, present: Sequence[Effect]) -> Effect:
    """The effect as in the model, or at a typical strength (`TYPICAL`, with alternating signs) if the model lacks it.

    Args:
        name: of the effect.
        present: effects of the model.

    Raises:
        CfbError: the effect is not in the catalogue.
    """
    if name in SENSOR_FAULTS:
        raise CfbError(
            f"{name} is a fault of the recording and not an effect on the flight; cfb close-loop looks for it."
        )
    if name not in CATALOGUE:
        raise CfbError(f"unknown effect {name}; the catalogue has {', '.join(sorted(CATALOGUE))}.")
    kind = CATALOGUE[name]
    own = next((effect for effect in present if type(effect).name == name), None)
    if own is not None and any(np.any(np.asarray(getattr(own, field)) != 0) for field in kind.strengths):
        return own
    effect = kind.neutral()
    for field in kind.strengths:
        old = np.asarray(getattr(effect, field))
        signs = np.resize([1.0, -1.0], old.shape) if kind.prior[field][0] < 0 else np.ones(old.shape)
        value = jnp.asarray(TYPICAL * kind.prior[field][1] * signs)
        effect = eqx.tree_at(lambda e, f=field: getattr(e, f), effect, value)
    return effect


def separate(
    model: Quadrotor,
    names: Sequence[str],
    conditions: Conditions = Conditions(),
    paths: Sequence[str] = tuple(PATHS),
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[Told]:
    """Rank paths by how well they distinguish some effects, the most informative first.

    Args:
        model: the drone; effects that it has are used with its strengths. Run with x64 enabled.
        names: at least two effects.
        conditions: expected noise and disturbances.
        paths: names of `PATHS`.
        seed: of noise and disturbances.
        progress: called with (done, total) simulations.

    Raises:
        CfbError: there are fewer than two effects, one is repeated, or one is not in the catalogue.
    """
    if len(set(names)) < 2 or len(set(names)) < len(names):
        raise CfbError(f"name at least two different effects to distinguish, found {', '.join(names) or 'none'}.")
    there = {name: assumed(name, model.effects) for name in names}
    others = tuple(effect for effect in model.effects if type(effect).name not in names)
    stabiliser = PositionHold(FirmwarePid.hovering(model.parameters))
    found = []
    for index, which in enumerate(paths):
        nats, flights, wanted = {}, [], path(which, TICK)
        for true, effect in there.items():
            flying = eqx.tree_at(lambda m: m.effects, model, (*others, effect), is_leaf=lambda x: isinstance(x, tuple))
            flown = follow(flying, stabiliser, wanted, conditions, seed, name=which)
            flights.append(flown)
            if progress is not None:
                progress(len(there) * index + len(flights), len(there) * len(paths))
            if not _followed(flown, wanted):
                continue
            nats |= {(true, n): x for n, x in _unexplained(flown.log, model, others, true, effect, names).items()}
        found.append(Told(which, nats, flights[0], len(nats) == len(names) * (len(names) - 1)))
    return sorted(found, key=lambda told: -told.worst)


def _followed(flown: Experiment, wanted: np.ndarray) -> bool:
    away = np.linalg.norm(flown.state.position - wanted[:, :3], axis=1)
    return bool(np.isfinite(away).all() and away.max() < REACH)


def _unexplained(
    log: FlightLog, model: Quadrotor, others: tuple[Effect, ...], true: str, effect: Effect, names: Sequence[str]
) -> dict[str, float]:
    """Nats of a flight with ``effect`` that each other effect cannot explain."""
    delay, gyro_delay = float(model.parameters.pose_delay), float(model.parameters.gyro_delay)
    search = Search.start([log], model.parameters, delay, check_sensors([log], delay, gyro_delay), others)
    nothing = search.learned(search.nothing())
    right = nothing.having(effect)
    right = search.settled(search.learned(right))
    nothing, linear = search.refine(nothing)
    probes = search.probes(nothing, linear)
    found = {}
    for name in names:
        if name == true:
            continue
        best = nothing
        # An effect whose fitted sign is meaningless has no probe and explains nothing of this flight.
        if name in probes:
            evidence, variant = probes[name]
            best = search.settled(search.with_candidate(nothing, variant, evidence))
        found[name] = confirm(search, replace(best, levels=right.levels), right).gain
    return found
