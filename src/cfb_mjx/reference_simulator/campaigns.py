"""Simulated drones (cases) and the logs that a user would record of them: fit flights and held-out flights."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator import effects, physics
from cfb_mjx.reference_simulator.controller import POSITION
from cfb_mjx.reference_simulator.manoeuvres import MANOEUVRES, crossing
from cfb_mjx.reference_simulator.sensors import Instruments, draw_instruments, row_ticks
from cfb_mjx.reference_simulator.simulation import Flight, Lane, simulate

FIT = ("lateral", "roll_pitch_excitation", "vertical", "low_altitude", "motor_excitation", "long_hover")
SECONDS = {"hover": (10.0, 13.0), "long_hover": (24.0, 30.0)}
TRIES = 6
MARGIN = 25  # ticks between warm-up and first row, so that delayed columns have a history


@dataclass(frozen=True)
class Case:
    """A drone to simulate.

    Attributes:
        name: of the drone; unique among cases.
        seed: of all random draws.
        effects: (name, strength) of each effect; empty for a nominal drone. An effect of strength 0 is absent, but does
            not change the random draws of the others.
    """

    name: str
    seed: int
    effects: tuple[tuple[str, float], ...] = ()

    @property
    def labels(self) -> list[str]:
        """Names that a perfect diagnosis would report; empty for a nominal drone."""
        return sorted({effects.label(name) for name, strength in self.effects if strength})


@dataclass(frozen=True)
class Campaign:
    """Logs of one drone; ``truth`` has the labels and all random draws.

    ``fit_others`` and ``held_out_others`` are the logs of a second drone, one for each flight; empty unless the case
    has the effect ``downwash``.
    """

    case: Case
    fit: list[FlightLog]
    held_out: list[FlightLog]
    truth: dict
    fit_others: list[FlightLog] = field(default_factory=list)
    held_out_others: list[FlightLog] = field(default_factory=list)


@dataclass(frozen=True)
class _Plan:
    """A flight to simulate: its case, its number among the logs, and what the flights of the case share."""

    case: Case
    drone: dict[str, np.ndarray]
    instruments: Instruments
    index: int
    manoeuvre: str
    held_out: bool
    duration_scale: float


def fly_campaigns(cases: list[Case], duration_scale: float = 1.0) -> list[Campaign]:
    """Simulate the logs of all cases in one run. A flight that crashes is drawn again, gentler each time.

    Args:
        cases: drones with different names. The logs of a case do not depend on the other cases.
        duration_scale: factor on the duration of the logs.

    Raises:
        RuntimeError: a flight crashed in every attempt.
    """
    drawn = [_draw(case, duration_scale) for case in cases]
    waiting = [plan for plans, _ in drawn for plan in plans]
    logs: dict[tuple[int, int], FlightLog] = {}
    others: dict[tuple[int, int], FlightLog] = {}
    order = {id(plan): (i, plan.index) for i, (plans, _) in enumerate(drawn) for plan in plans}
    for attempt in range(TRIES):
        lanes = [_lane(plan, attempt) for plan in waiting]
        second = {i: _second(plan, lanes[i], attempt) for i, plan in enumerate(waiting) if plan.drone["wake"] > 0}
        places = {i: len(lanes) + k for k, i in enumerate(second)}
        lanes = [replace(lane, other=places.get(i)) for i, lane in enumerate(lanes)] + list(second.values())
        flights, crashed = simulate(lanes), []
        for i, plan in enumerate(waiting):
            place = places.get(i, i)
            if flights[i].crashed or flights[place].crashed:
                crashed.append(plan)
                continue
            logs[order[id(plan)]] = _log(plan, lanes[i], flights[i], attempt)
            if place != i:
                rng = np.random.default_rng([plan.case.seed, plan.index, attempt, 3])
                name = f"other_{plan.index + 1:02d}"
                others[order[id(plan)]] = recorded(lanes[place], flights[place], rng, name)
            drawn[order[id(plan)][0]][1]["tries"][plan.index] = attempt + 1
        waiting = crashed
        if not waiting:
            break
    if waiting:
        raise RuntimeError("every attempt crashed: " + ", ".join(f"{p.case.name}/{p.manoeuvre}" for p in waiting))
    campaigns = []
    for i, (plans, truth) in enumerate(drawn):
        own = [(plan.held_out, logs[i, plan.index]) for plan in plans]
        fit, held_out = [log for held, log in own if not held], [log for held, log in own if held]
        own = [(plan.held_out, others[i, plan.index]) for plan in plans if (i, plan.index) in others]
        beside = [log for held, log in own if not held], [log for held, log in own if held]
        campaigns.append(Campaign(cases[i], fit, held_out, truth, *beside))
    return campaigns


def draw_drone(case: Case) -> tuple[dict[str, np.ndarray], Instruments, dict]:
    """Draw the drone of a case and its sensors; return them with the truth: labels and all draws."""
    drone = physics.nominal()
    truth: dict = {"labels": case.labels, "effects": {}}
    for order, (name, strength) in enumerate(case.effects):
        rng = np.random.default_rng([case.seed, 1000 + order])
        if strength:
            truth["effects"][name] = effects.apply(name, rng, drone, strength)
    instruments = draw_instruments(_of_case(case))
    return drone, instruments, truth | {"instruments": vars(instruments)}


def _of_case(case: Case) -> np.random.Generator:
    """Generator that draws the sensors first, then the choice of flights."""
    return np.random.default_rng([case.seed, 2000])


def _draw(case: Case, duration_scale: float) -> tuple[list[_Plan], dict]:
    """Draw the flights of a case; return them and the truth of the case."""
    drone, instruments, truth = draw_drone(case)
    rng = _of_case(case)
    draw_instruments(rng)
    fit = [*FIT, "hover"] if rng.random() < 0.6 else list(FIT)
    held_out = [rng.choice(["figure8", "circle"]), "waypoints", rng.choice(["mixed_excitation", "yaw_recovery"])]
    names = [*fit, *map(str, held_out), "climb_dive"]
    plans = [_Plan(case, drone, instruments, i, name, i >= len(fit), duration_scale) for i, name in enumerate(names)]
    return plans, truth | {"manoeuvres": names, "tries": [0] * len(names)}


def _lane(plan: _Plan, attempt: int) -> Lane:
    """Draw one flight."""
    rng, noise = np.random.default_rng([plan.case.seed, plan.index, attempt]).spawn(2)
    seconds = plan.duration_scale * rng.uniform(*SECONDS.get(plan.manoeuvre, (13.0, 17.0)))
    setpoints = MANOEUVRES[plan.manoeuvre](rng, seconds, 0.85**attempt)
    if plan.drone["bob_mass"] > 0:
        setpoints[:, POSITION.stop - 1] += plan.drone["bob_length"] + 0.1  # the load must not touch the floor
    rows = row_ticks(rng, len(setpoints) * c.SETPOINT_TICKS - MARGIN, plan.instruments.irregular, rng.random() < 0.4)
    return Lane(
        plan.drone,
        plan.instruments,
        setpoints,
        rows + MARGIN,
        voltage=rng.uniform(3.4, 3.95),
        gyro_bias=0.003 * rng.standard_normal(3),
        rng=noise,
    )


def _second(plan: _Plan, lane: Lane, attempt: int) -> Lane:
    """Draw the flight of a second, nominal drone that crosses over the first."""
    rng, noise = np.random.default_rng([plan.case.seed, plan.index, attempt, 2]).spawn(2)
    return replace(
        lane,
        drone=physics.nominal(),
        setpoints=crossing(rng, lane.setpoints),
        voltage=rng.uniform(3.4, 3.95),
        gyro_bias=0.003 * rng.standard_normal(3),
        rng=noise,
    )


def _log(plan: _Plan, lane: Lane, flight: Flight, attempt: int) -> FlightLog:
    rng = np.random.default_rng([plan.case.seed, plan.index, attempt, 1])
    return recorded(lane, flight, rng, f"log_{plan.index + 1:02d}")


def recorded(lane: Lane, flight: Flight, rng: np.random.Generator, name: str) -> FlightLog:
    """Return the log of a flight; ``rng`` draws the noise of signals that the controller does not use."""
    instruments, count = lane.instruments, len(lane.rows)
    bias = 0.03 * rng.standard_normal(3)
    speed = None
    if instruments.measures_rotors and rng.random() < 0.7:
        speed = flight.motors[:, 4:] + instruments.rotor_speed * rng.standard_normal((count, 4))
    return FlightLog(
        time=(lane.rows - lane.rows[0]) * c.TICK,
        position=flight.pose[:, :3],
        velocity=flight.pose[:, 3:6] * lane.drone["velocity_scale"],
        quaternion=flight.pose[:, 6:],
        body_rate=flight.inertial[:, :3],
        specific_force=flight.inertial[:, 3:6] + bias + instruments.accelerometer * rng.standard_normal((count, 3)),
        command=flight.motors[:, :4],
        rotor_speed=speed,
        battery_voltage=flight.inertial[:, 6] + instruments.battery * rng.standard_normal(count),
        metadata={
            "name": name,
            "source": "plant",
            "format": "made",
            "observation_delay": c.POSE_TICKS * c.TICK,
        },
    )
