"""Effects somebody names, fitted to innovations: the search's last step without the search."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import CATALOGUE, Effect, Wind
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors
from cfb_mjx.sysid.tracing.trace import deviations
from cfb_mjx.sysid.velocity_band import with_band

ROUNDS = 3
"""Fits, each with the noise levels learned from the one before."""


@dataclass(frozen=True)
class Given:
    """Outcome of `fit_given`."""

    effects: tuple[Effect, ...]
    uncertainty: dict[str, dict[str, float | list[float]]]
    """Standard deviations by effect and field."""
    faults: SensorFaults


def fit_given(
    logs: Sequence[FlightLog],
    parameters: Parameters,
    names: Sequence[str],
    declared: tuple[Effect, ...] = (),
    delay: float = 0.008,
    progress: Callable[[str], None] = lambda _: None,
    as_logged: bool = False,
) -> Given:
    """Fit named effects together, by the likelihood of whitened innovations, which feedback does not bias.

    Args:
        logs: flights; run with x64 enabled.
        parameters: the declared drone.
        names: of effects of the catalogue; all are taken to be there.
        declared: effects the declared model has already; they start the fit.
        delay: declared age of pose and velocity in a row, s.
        progress: told what happens.
        as_logged: take no sensor fault out of the flights, only biases; a stretch of the velocity is
            one of the attitude too (`SensorFaults.as_logged`).

    Raises:
        CfbError: an effect the catalogue does not have.
    """
    for name in names:
        if name not in CATALOGUE:
            raise CfbError(f"{name}: no such effect; the catalogue has {', '.join(sorted(CATALOGUE))}.")
    progress("comparing the sensors with each other")
    sensors = check_sensors(list(logs), delay, float(parameters.gyro_delay))
    faults = with_band(sensors.faults, logs)
    sensors = replace(sensors, faults=faults.as_logged if as_logged else faults)
    search = Search.start(list(logs), parameters, delay, sensors, declared, names)
    progress("replaying the declared model")
    nothing = search.learned(search.nothing())
    # Where nobody declared a wind, one is a force, as in a search.
    new = Wind.name not in {type(effect).name for effect in declared}
    effects = tuple(replace(e, felt=jnp.zeros(())) if new and isinstance(e, Wind) else e for e in nothing.effects)
    hypothesis = search.settled(replace(nothing, effects=effects, present=tuple(names)))
    for number in range(1, ROUNDS):
        progress(f"fitting {', '.join(names)}, round {number + 1}")
        hypothesis = search.settled(hypothesis)
    linear = search.whole(hypothesis)
    uncertainty: dict[str, dict] = {name: {} for name in names}
    for column, std in deviations(search, hypothesis, linear).items():
        own = uncertainty[column.effect]
        if column.index is None:
            own[column.field] = std
        else:
            own.setdefault(column.field, []).append(std)
    kept = tuple(e for e in declared if type(e).name not in names)
    return Given((*kept, *(hypothesis.effect(name) for name in names)), uncertainty, sensors.faults)
