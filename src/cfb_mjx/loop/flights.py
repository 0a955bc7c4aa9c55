"""Flights of a policy that give the logs for the model correction: it follows set-points that excite the drone.

A policy holds a target. If its input is position and velocity relative to a moving target, it follows that target. The
set-points are those of the reference simulator's own manoeuvres, raised by `RAISE`, because a policy trained without
the effect may sink. A policy has no rate set-point; the manoeuvre with rates is replaced by jumps of the target. Two of
the flights have a dither on the commands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.loop.trials import controller_of
from cfb_mjx.reference_simulator import Case
from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator.campaigns import draw_drone, recorded
from cfb_mjx.reference_simulator.controller import DITHER, POSITION, SETPOINT_COLUMNS
from cfb_mjx.reference_simulator.manoeuvres import MANOEUVRES, STEP
from cfb_mjx.reference_simulator.sensors import Instruments, row_ticks
from cfb_mjx.reference_simulator.simulation import Lane, simulate

FIT = ("lateral", "jumps", "vertical", "low_altitude", "motor_excitation", "long_hover")
HELD_OUT = ("figure8", "waypoints", "climb_dive")
SECONDS = {"long_hover": (20.0, 25.0)}
USUAL_SECONDS = (13.0, 17.0)
RAISE = 0.4
"""Height added to the set-points, m."""
DITHER_OF_JUMPS = 0.02
"""Amplitude of the dither on the commands in the flight with jumps."""
TRIES, GENTLER = 6, 0.85
"""Largest number of tries of a flight that crashes, and the factor on its vigour for each further try."""
_OWN = 7
"""Part of the random seed that distinguishes these flights from the reference simulator's own campaigns."""


@dataclass(frozen=True)
class Flown:
    """A campaign of flights.

    Attributes:
        fit: logs of the fit flights.
        held_out: logs of the held-out flights.
        manoeuvres: names of the manoeuvres, fit flights first.
        tries: number of tries of each flight.
        truth: true effects and constants of the drone.
    """

    fit: list[FlightLog]
    held_out: list[FlightLog]
    manoeuvres: tuple[str, ...]
    tries: tuple[int, ...]
    truth: dict


def fly_campaign(
    case: Case,
    controller: NeuralController,
    duration_scale: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> Flown:
    """Fly a drone with a policy and log the flights.

    Args:
        case: the drone.
        controller: the policy.
        duration_scale: factor on the durations of the flights.
        progress: called with a line of text for each round of flights.

    Raises:
        CfbError: a flight still crashes at the last, gentlest try.
    """
    names = FIT + HELD_OUT
    drone, instruments, truth = draw_drone(case)
    logs: dict[int, FlightLog] = {}
    tries = [0] * len(names)
    for attempt in range(TRIES):
        waiting = [i for i in range(len(names)) if i not in logs]
        if not waiting:
            break
        progress(f"flying {', '.join(names[i] for i in waiting)}")
        lanes = [_lane(case, i, names[i], attempt, drone, instruments, duration_scale) for i in waiting]
        flights = simulate(lanes, controller_of([controller] * len(lanes)))
        for i, lane, flight in zip(waiting, lanes, flights, strict=True):
            tries[i] = attempt + 1
            if not flight.crashed:
                logs[i] = recorded(lane, flight, _logging(case, i, attempt), f"log_{i + 1:02d}")
    if len(logs) < len(names):
        lost = ", ".join(name for i, name in enumerate(names) if i not in logs)
        raise CfbError(f"{case.name}: the policy cannot keep this drone in the air ({lost}).")
    ordered = [logs[i] for i in range(len(names))]
    return Flown(ordered[: len(FIT)], ordered[len(FIT) :], names, tuple(tries), truth)


def _streams(case: Case, index: int, attempt: int) -> list[np.random.Generator]:
    """Random generators of the set-points, of the noise in flight, and of the noise of the logs."""
    # One `spawn` for all three: it appends 0, 1, 2 to this seed, and a longer seed could equal one of the results.
    return np.random.default_rng([case.seed, index, attempt, _OWN]).spawn(3)


def _logging(case: Case, index: int, attempt: int) -> np.random.Generator:
    return _streams(case, index, attempt)[2]


def _lane(
    case: Case, index: int, manoeuvre: str, attempt: int, drone: dict, instruments: Instruments, duration_scale: float
) -> Lane:
    rng, noise, _ = _streams(case, index, attempt)
    seconds = duration_scale * rng.uniform(*SECONDS.get(manoeuvre, USUAL_SECONDS))
    generate = jumps if manoeuvre == "jumps" else MANOEUVRES[manoeuvre]
    setpoints = generate(rng, seconds, GENTLER**attempt)
    setpoints[:, POSITION.stop - 1] += RAISE * (1 + attempt)
    return Lane(
        drone,
        instruments,
        setpoints,
        # From the end of the warm-up, when a command is due, so that rows show command changes when they occur.
        row_ticks(rng, len(setpoints) * c.SETPOINT_TICKS, instruments.irregular, rng.random() < 0.4),
        voltage=rng.uniform(3.4, 3.95),
        gyro_bias=0.003 * rng.standard_normal(3),
        rng=noise,
    )


def jumps(rng: np.random.Generator, seconds: float, vigour: float) -> np.ndarray:
    """Set-points (n, 17) at 100 Hz of a target that jumps by up to about a metre, with a dither on every command.

    Args:
        rng: random generator.
        seconds: duration, s.
        vigour: factor on the size of the jumps.
    """
    goal = np.zeros((round(seconds / STEP), SETPOINT_COLUMNS))
    start = 0
    while start < len(goal):
        goal[start:, POSITION] = [*(0.7 * vigour * rng.uniform(-1, 1, 2)), rng.uniform(0.8, 1.5)]
        start += round(rng.uniform(0.7, 1.5) / STEP)
    goal[:, DITHER] = DITHER_OF_JUMPS * rng.uniform(-1, 1, (len(goal), 4))
    return goal
