"""Safety of a simulated manoeuvre: its extremes, and whether the stabiliser caught the drone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cfb_mjx.sysid.excitation.experiment import CATCH, TICK, Experiment
from cfb_mjx.sysid.excitation.manoeuvres import Limits

SETTLED_TILT_DEG, SETTLED_SPEED = 10.0, 0.3
"""A drone is caught if it stays below this tilt and speed, m/s, from at most `CATCH` seconds after the handover."""


@dataclass(frozen=True)
class Attained:
    """Extremes of one repetition, from its start until `CATCH` seconds after the handover.

    Attributes:
        tilt_deg: largest tilt, deg.
        rate: largest norm of the body rate, rad/s.
        altitude_loss: largest loss of height since the start, m.
        drift: largest horizontal distance from the start, m, which is the space needed.
        lowest: smallest height above the floor, m.
        settled: time from the handover until tilt and speed stay small, s; NaN if never.
        caught: whether it settled in time and never fell below the floor.
    """

    tilt_deg: float
    rate: float
    altitude_loss: float
    drift: float
    lowest: float
    settled: float
    caught: bool

    def within(self, limits: Limits) -> bool:
        """Whether tilt, body rate and loss of height kept the limits."""
        return (
            self.tilt_deg <= limits.tilt_deg and self.rate <= limits.rate and self.altitude_loss <= limits.altitude_loss
        )


def attained(experiment: Experiment) -> list[Attained]:
    """Extremes of every repetition of an experiment."""
    return [_one(experiment, start) for start in experiment.starts]


def _one(experiment: Experiment, start: int) -> Attained:
    catch = round(CATCH / TICK)
    rows = slice(start, start + experiment.length + catch)
    position, velocity = experiment.state.position[rows], experiment.state.velocity[rows]
    _, x, y, _ = np.moveaxis(np.asarray(experiment.state.quaternion[rows]), -1, 0)
    tilt = np.degrees(2 * np.arcsin(np.clip(np.hypot(x, y), 0.0, 1.0)))
    restless = (tilt > SETTLED_TILT_DEG) | (np.linalg.norm(velocity, axis=1) > SETTLED_SPEED)
    last = np.flatnonzero(restless[experiment.length :])
    settled = (last[-1] + 1) * TICK if len(last) else 0.0
    settled = settled if settled < CATCH else float("nan")
    lowest = float(position[:, 2].min())
    return Attained(
        tilt_deg=float(tilt.max()),
        rate=float(np.linalg.norm(experiment.state.body_rate[rows], axis=1).max()),
        altitude_loss=float(position[0, 2] - lowest),
        drift=float(np.linalg.norm(position[:, :2] - position[0, :2], axis=1).max()),
        lowest=lowest,
        settled=settled,
        caught=bool(np.isfinite(settled) and lowest > 0),
    )


def worst_of(repetitions: list[Attained], limits: Limits) -> dict[str, float | int | None]:
    """Extremes over repetitions, and how many kept the limits and were caught, as a JSON-compatible dictionary."""
    return {
        "max_tilt_deg": max(a.tilt_deg for a in repetitions),
        "max_rate_radps": max(a.rate for a in repetitions),
        "altitude_loss_m": max(a.altitude_loss for a in repetitions),
        "drift_m": max(a.drift for a in repetitions),
        "settled_s": max(a.settled for a in repetitions) if all(a.caught for a in repetitions) else None,
        "within_limits": sum(a.within(limits) for a in repetitions),
        "caught": sum(a.caught for a in repetitions),
        "repetitions": len(repetitions),
    }
