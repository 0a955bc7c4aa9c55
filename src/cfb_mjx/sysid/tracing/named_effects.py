"""Fit named effects to innovations: the last step of the search, without the search."""

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
"""Number of fits; each uses the noise levels estimated from the residuals of the one before."""


@dataclass(frozen=True)
class NamedFit:
    """Outcome of `fit_named_effects`.

    Attributes:
        effects: declared effects that were not fitted, then the fitted ones.
        uncertainty: standard deviations by effect and field.
        faults: sensor faults that were found and taken out of the flights.
    """

    effects: tuple[Effect, ...]
    uncertainty: dict[str, dict[str, float | list[float]]]
    faults: SensorFaults


def fit_named_effects(
    logs: Sequence[FlightLog],
    parameters: Parameters,
    names: Sequence[str],
    declared: tuple[Effect, ...] = (),
    delay: float = 0.008,
    progress: Callable[[str], None] = lambda _: None,
    as_logged: bool = False,
) -> NamedFit:
    """Fit named effects together, by the likelihood of whitened innovations, which feedback does not bias.

    Args:
        logs: flights; run with x64 enabled.
        parameters: the declared drone.
        names: effects of the catalogue to fit; all are assumed to be present.
        declared: effects that the declared model already has; their values are the starting point.
        delay: declared age of pose and velocity in a row, s.
        progress: called with a message at each step.
        as_logged: remove only biases from the flights and no sensor fault; a stretch of the velocity then applies to
            the attitude too (`SensorFaults.as_logged`).

    Raises:
        CfbError: a name is not in the catalogue.
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
    # A wind that is not declared is fitted as a force, as in a search.
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
    return NamedFit((*kept, *(hypothesis.effect(name) for name in names)), uncertainty, sensors.faults)
