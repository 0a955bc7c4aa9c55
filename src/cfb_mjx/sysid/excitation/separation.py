"""Which flight tells effects apart that the flights so far hardly tell apart.

Every path is flown in simulation by a drone that has one of the effects; each of the others is then given the chance to
explain that flight in its place. What it cannot explain, in nats of log-likelihood, is what the path tells about the
pair; a path is worth what it tells about the pair it tells least about.
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
"""Strength assumed of an effect the model does not have, as a share of its prior range's upper end."""
ENOUGH = 10.0
"""Nats that settle a question: odds of twenty thousand to one."""
REACH = 5.0
"""A flight that ends up farther than this from its path, m, has not followed it."""


@dataclass(frozen=True)
class Told:
    """What a path tells.

    Attributes:
        path: its name.
        nats: (true effect, effect in its place) -> log-likelihood the other one cannot explain, of one flight.
        flown: the flight with the first effect there.
        followed: whether every drone followed the path.
    """

    path: str
    nats: dict[tuple[str, str], float]
    flown: Experiment
    followed: bool

    @property
    def worst(self) -> float:
        """Nats about the pair it tells least about; nothing if a drone did not follow it."""
        return min(self.nats.values()) if self.followed else 0.0

    @property
    def flights(self) -> int | None:
        """Flights that settle every pair; None if no number of them would."""
        return max(1, int(np.ceil(ENOUGH / self.worst))) if self.worst > ENOUGH / 100 else None

    def to_json(self) -> dict[str, Any]:
        """All but the flight."""
        nats = {f"{true} against {other}": value for (true, other), value in self.nats.items()}
        return {"nats": nats, "flights": self.flights, "followed": self.followed}


def assumed(name: str, present: Sequence[Effect]) -> Effect:
    """The effect as the model has it, else at a typical strength (`TYPICAL`, signs alternating).

    Raises:
        CfbError: not an effect of the catalogue.
    """
    if name in SENSOR_FAULTS:
        raise CfbError(
            f"{name} is a fault of the recording: cfb close-loop tells it from other sensors, not by flying."
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
    """What every path tells about some effects, the most telling first.

    Args:
        model: the drone so far; effects it has are taken at its strengths. Run with x64 enabled.
        names: two effects or more.
        conditions: noise and disturbances to expect.
        paths: of `PATHS`.
        seed: of noise and disturbances.
        progress: called with (done, total).

    Raises:
        CfbError: fewer than two effects, one twice, or one that is not in the catalogue.
    """
    if len(set(names)) < 2 or len(set(names)) < len(names):
        raise CfbError(f"name two different effects or more to tell apart, found {', '.join(names) or 'none'}.")
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
    """Nats that each other effect cannot explain of a flight with ``effect``."""
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
        # An effect without a probe, its sign making no sense, explains nothing of this flight.
        if name in probes:
            evidence, variant = probes[name]
            best = search.settled(search.with_candidate(nothing, variant, evidence))
        found[name] = confirm(search, replace(best, levels=right.levels), right).gain
    return found
