"""How well policies fly one drone: hover and a figure eight, judged by what the drone's own tracking reports.

Every policy meets the same flights: the same sensor noise, battery and gyro bias, drawn apart from the campaign's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.loop.controllers import controller_of
from cfb_mjx.reference_simulator import Case
from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator.airframe import P
from cfb_mjx.reference_simulator.campaigns import draw_drone
from cfb_mjx.reference_simulator.controller import POSITION, SETPOINT_COLUMNS, VELOCITY
from cfb_mjx.reference_simulator.simulation import Flight, Lane, simulate

HEIGHT = 1.2
"""m"""
HOVERS, HOVER_S, SETTLING_S = 6, 6.0, 1.0
"""Flights, how long each, and how much of it is not counted, as in the paper's hover test."""
TRACKS, TRACK_S, ENTRY_S = 4, 15.0, 3.0
PERIOD_S, WIDTH_M, DEPTH_M, RAMP_S = 12.0, 1.0, 0.5, 2.0
"""A figure eight: one round, half its width and depth, and how long its pace takes to build up."""
_OWN = 9


@dataclass(frozen=True)
class Trial:
    """What one policy did on one drone; one number per flight, NaN where it crashed.

    Attributes:
        hover_mm: mean distance from the target over the last five of six seconds.
        command_std: standard deviation of the commands over that time, mean of the four motors.
        track_m: RMS distance from the figure eight's moving point.
    """

    hover_mm: tuple[float, ...]
    command_std: tuple[float, ...]
    track_m: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        """With how many crashed; NaN becomes null."""
        lost = sum(not np.isfinite(x) for x in (*self.hover_mm, *self.track_m))
        return {"hover_mm": self.hover_mm, "command_std": self.command_std, "track_m": self.track_m, "crashed": lost}


def figure_eight(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (n, 3) [m] and velocity (n, 3) [m/s] of the moving point; it rests before time 0."""
    t = np.maximum(time, 0.0)
    pace = 2 * np.pi / PERIOD_S
    built = np.minimum(t, RAMP_S)
    phase = pace * (0.5 * built**2 / RAMP_S + t - built)
    rate = pace * built / RAMP_S
    place = np.stack([WIDTH_M * np.sin(phase), DEPTH_M * np.sin(2 * phase), np.full_like(t, HEIGHT)], axis=-1)
    speed = np.stack([WIDTH_M * np.cos(phase), 2 * DEPTH_M * np.cos(2 * phase), np.zeros_like(t)], axis=-1)
    return place, rate[:, None] * speed


def fly_trials(case: Case, policies: Mapping[str, NeuralController], twin: str) -> dict[str, Trial]:
    """Every policy on the drone of a case, side by side.

    Args:
        case: the drone.
        policies: by name, alike but for their weights.
        twin: the policy that also flies the drone without its effects, as ``without_effect``.
    """
    drone, instruments, _ = draw_drone(case)
    healthy, _, _ = draw_drone(Case(case.name, case.seed))
    crews = {name: (controller, drone) for name, controller in policies.items()}
    crews["without_effect"] = (policies[twin], healthy)
    lanes, controllers = [], []
    for controller, body in crews.values():
        lanes += [_lane(case, i, body, instruments) for i in range(HOVERS + TRACKS)]
        controllers += [controller] * (HOVERS + TRACKS)
    flights = simulate(lanes, controller_of(controllers))
    each = [flights[i : i + HOVERS + TRACKS] for i in range(0, len(flights), HOVERS + TRACKS)]
    return {name: _judged(own) for name, own in zip(crews, each, strict=True)}


def _lane(case: Case, index: int, drone: dict, instruments) -> Lane:
    rng, noise = np.random.default_rng([case.seed, index, _OWN]).spawn(2)
    seconds = HOVER_S if index < HOVERS else TRACK_S
    time = np.arange(round(seconds / (c.SETPOINT_TICKS * c.TICK))) * c.SETPOINT_TICKS * c.TICK
    setpoints = np.zeros((len(time), SETPOINT_COLUMNS))
    if index < HOVERS:
        setpoints[:, POSITION] = [0.0, 0.0, HEIGHT]
    else:
        setpoints[:, POSITION], setpoints[:, VELOCITY] = figure_eight(time)
    rows = np.arange(0, len(setpoints) * c.SETPOINT_TICKS, c.ROW_TICKS)
    voltage, bias = rng.uniform(3.4, 3.95), 0.003 * rng.standard_normal(3)
    return Lane(drone, instruments, setpoints, rows, voltage, bias, noise)


def _judged(flights: list[Flight]) -> Trial:
    hovers = [_hover(flight) for flight in flights[:HOVERS]]
    distances, spreads = zip(*hovers, strict=True)
    return Trial(distances, spreads, tuple(_track(flight) for flight in flights[HOVERS:]))


def _hover(flight: Flight) -> tuple[float, float]:
    """Mean distance [mm] and command std; NaN of a flight that crashed."""
    if flight.crashed:
        return float("nan"), float("nan")
    counted = round(SETTLING_S / (c.ROW_TICKS * c.TICK))
    off = flight.pose[counted:, P] - [0.0, 0.0, HEIGHT]
    return float(1e3 * np.linalg.norm(off, axis=1).mean()), float(flight.motors[counted:, :4].std(axis=0).mean())


def _track(flight: Flight) -> float:
    """RMS distance, m; NaN of a flight that crashed."""
    if flight.crashed:
        return float("nan")
    time = np.arange(len(flight.pose)) * c.ROW_TICKS * c.TICK
    # A pose is of a moment ago, and so is the point it is compared with.
    off = flight.pose[:, P] - figure_eight(time - c.POSE_TICKS * c.TICK)[0]
    return float(np.sqrt((off[time >= ENTRY_S] ** 2).sum(axis=1).mean()))
