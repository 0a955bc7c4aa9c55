"""Test flights of policies on one drone: hover and a figure eight, evaluated with the drone's own tracking.

All policies fly with the same sensor noise, battery and gyro bias, which differ from those of the campaign.

Trained policies (JAX) fly the reference simulator (NumPy) through an adapter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.control.controllers import require_motor_commands
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.envs.observation import StateEstimate
from cfb_mjx.errors import CfbError
from cfb_mjx.reference_simulator import Case
from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator.airframe import P
from cfb_mjx.reference_simulator.campaigns import draw_drone
from cfb_mjx.reference_simulator.constants import TICK
from cfb_mjx.reference_simulator.controller import POSITION, SETPOINT_COLUMNS, VELOCITY, OtherController, Seen
from cfb_mjx.reference_simulator.simulation import Flight, Lane, simulate


def controller_of(controllers: Sequence[NeuralController]) -> OtherController:
    """Combine policies into one controller of the simulator, with one lane per policy.

    Args:
        controllers: one policy per lane.

    Raises:
        CfbError: the policies differ in more than their weights, or their control step is not a multiple of a tick.
    """
    first = controllers[0]
    require_motor_commands(first, "the reference simulator")
    if any(jax.tree.structure(one) != jax.tree.structure(first) for one in controllers):
        raise CfbError("policies that fly side by side must have the same observation and layers.")
    every = first.control_dt_s / TICK
    if abs(every - round(every)) > 1e-6 or every < 1:
        raise CfbError(f"a policy's control step of {first.control_dt_s} s is not a multiple of the plants' {TICK} s.")
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *controllers)

    def fly(memory, seen: Seen):
        shown = [np.ascontiguousarray(x.T) for x in (seen.position, seen.velocity, seen.quaternion, seen.body_rate)]
        if memory is None:
            memory = _start(stacked, *shown)
        memory, command = _command(stacked, memory, *shown)
        return memory, np.asarray(command, float).T

    return OtherController(round(every), fly)


@eqx.filter_jit
def _start(controllers, *shown):
    return jax.vmap(lambda controller, *of: controller.start(StateEstimate(*of)))(controllers, *shown)


@eqx.filter_jit
def _command(controllers, memories, *shown):
    return jax.vmap(lambda controller, memory, *of: controller.command(memory, StateEstimate(*of)))(
        controllers, memories, *shown
    )


HEIGHT = 1.2
"""Height of the targets, m."""
HOVERS, HOVER_S, SETTLING_S = 6, 6.0, 1.0
"""Hover test as in the paper: number of flights, their duration, and the initial time that is not counted, s."""
TRACKS, TRACK_S, ENTRY_S = 4, 15.0, 3.0
"""Tracking test: number of flights, their duration, and the initial time that is not counted, s."""
PERIOD_S, WIDTH_M, DEPTH_M, RAMP_S = 12.0, 1.0, 0.5, 2.0
"""Figure eight: period, half its width and depth, and the time in which the point accelerates."""
_OWN = 9
"""Part of the random seed that distinguishes these flights from the campaign's."""


@dataclass(frozen=True)
class Trial:
    """Results of one policy on one drone: one number per flight, NaN if it crashed.

    Attributes:
        hover_mm: mean distance from the target over the last five of six seconds, mm.
        command_std: standard deviation of the commands over that time, mean of the four motors.
        track_m: RMS distance from the moving point of the figure eight, m.
    """

    hover_mm: tuple[float, ...]
    command_std: tuple[float, ...]
    track_m: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        """The results as JSON-compatible values, with the number of crashes. NaN becomes null."""
        lost = sum(not np.isfinite(x) for x in (*self.hover_mm, *self.track_m))
        return {"hover_mm": self.hover_mm, "command_std": self.command_std, "track_m": self.track_m, "crashed": lost}


def figure_eight(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (n, 3), m, and velocity (n, 3), m/s, of the point on the figure eight; it rests before time 0."""
    t = np.maximum(time, 0.0)
    pace = 2 * np.pi / PERIOD_S
    built = np.minimum(t, RAMP_S)
    phase = pace * (0.5 * built**2 / RAMP_S + t - built)
    rate = pace * built / RAMP_S
    place = np.stack([WIDTH_M * np.sin(phase), DEPTH_M * np.sin(2 * phase), np.full_like(t, HEIGHT)], axis=-1)
    speed = np.stack([WIDTH_M * np.cos(phase), 2 * DEPTH_M * np.cos(2 * phase), np.zeros_like(t)], axis=-1)
    return place, rate[:, None] * speed


def fly_trials(case: Case, policies: Mapping[str, NeuralController], twin: str) -> dict[str, Trial]:
    """Fly the drone of a case with every policy, in one batch.

    Args:
        case: the drone.
        policies: policies by name, which differ only in their weights.
        twin: name of the policy that also flies the drone without its effects, as ``without_effect``.

    Returns:
        Results by policy name.
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
    """Mean distance, mm, and command std; NaN for a flight that crashed."""
    if flight.crashed:
        return float("nan"), float("nan")
    counted = round(SETTLING_S / (c.ROW_TICKS * c.TICK))
    off = flight.pose[counted:, P] - [0.0, 0.0, HEIGHT]
    return float(1e3 * np.linalg.norm(off, axis=1).mean()), float(flight.motors[counted:, :4].std(axis=0).mean())


def _track(flight: Flight) -> float:
    """RMS distance, m; NaN for a flight that crashed."""
    if flight.crashed:
        return float("nan")
    time = np.arange(len(flight.pose)) * c.ROW_TICKS * c.TICK
    # The pose is late by POSE_TICKS, so it is compared with the point at that earlier time.
    off = flight.pose[:, P] - figure_eight(time - c.POSE_TICKS * c.TICK)[0]
    return float(np.sqrt((off[time >= ENTRY_S] ** 2).sum(axis=1).mean()))
