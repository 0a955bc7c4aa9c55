"""Trial of a manoeuvre in simulation before it is flown: expected uncertainty of a fit, and safety.

A trial is safe if its extremes stay within the limits and the stabiliser catches the drone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from cfb_mjx.control import FirmwarePid, PositionHold
from cfb_mjx.model import Quadrotor
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import ModelFile
from cfb_mjx.sysid.excitation.design import Problem, optimise
from cfb_mjx.sysid.excitation.experiment import CATCH, TICK, Conditions, Experiment, fly
from cfb_mjx.sysid.excitation.information import Prediction, log_determinant, predict, typical
from cfb_mjx.sysid.excitation.manoeuvres import STEP, Limits, roll_pitch, scaled, single_motor
from cfb_mjx.sysid.identification.fitting import default_parameters
from cfb_mjx.sysid.identification.unknowns import choose

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


PAPER = {"roll-pitch": roll_pitch, "single-motor": single_motor}
"""Manoeuvres of the paper."""
ITERATIONS = 1000
"""Number of steps in the design of an optimised manoeuvre."""
FLIGHTS = 3
"""Number of simulated flights with different noise and disturbances; the median uncertainty is reported, and the first
flight is kept."""


@dataclass(frozen=True)
class Trial:
    """A manoeuvre flown in simulation.

    Attributes:
        commands: (m, 4) of one repetition.
        calm: flight without noise and disturbances.
        flown: flight with noise and disturbances.
        prediction: expected result of a fit to such a flight.
        log_det: log determinant of the information of one repetition.
        undisturbed: extremes of ``calm``.
        worst: extremes of the flights with disturbances, and how many repetitions kept the limits and were caught.
    """

    commands: Float[np.ndarray, "m 4"]
    calm: Experiment
    flown: Experiment
    prediction: Prediction
    log_det: float
    undisturbed: Attained
    worst: dict[str, Any]

    def expected(self) -> dict[str, dict[str, Any]]:
        """Value, expected standard deviation and unit of every identifiable parameter."""
        return {name: asdict(one) for name, one in self.prediction.parameters.items()}

    def commands_csv(self) -> str:
        """The commands as a CSV table of time, s, and the command of each motor from that time on."""
        lines = (f"{STEP * i:.3f}," + ",".join(f"{u:.6f}" for u in row) for i, row in enumerate(self.commands))
        return "\n".join(["t,u1,u2,u3,u4", *lines]) + "\n"


@dataclass(frozen=True)
class Excitation:
    """Result of `excite`: the chosen manoeuvre and, if it is optimised, those of the paper for comparison.

    Attributes:
        manoeuvre: name of the chosen manoeuvre.
        trials: trials of all manoeuvres, by name.
        repetitions: number of manoeuvres in one flight.
        duration: of the open-loop part, s.
        limits: of the manoeuvres.
        conditions: noise and disturbances.
    """

    manoeuvre: str
    trials: dict[str, Trial]
    repetitions: int
    duration: float
    limits: Limits
    conditions: Conditions

    @property
    def chosen(self) -> Trial:
        """Trial of the chosen manoeuvre."""
        return self.trials[self.manoeuvre]

    def to_json(self) -> dict[str, Any]:
        """All results as a JSON-compatible dictionary."""
        chosen = self.chosen
        return {
            "manoeuvre": self.manoeuvre,
            "repetitions": self.repetitions,
            "duration_s": self.duration,
            "limits": asdict(self.limits),
            "conditions": asdict(self.conditions),
            "parameters": chosen.expected(),
            "unidentifiable": chosen.prediction.unidentifiable,
            "identifiable_together": chosen.prediction.combinations,
            "log_det_one_repetition": chosen.log_det,
            "undisturbed": asdict(chosen.undisturbed) | {"within_limits": chosen.undisturbed.within(self.limits)},
            "with_disturbances": chosen.worst,
            "compared_with": {
                name: {"parameters": trial.expected(), "log_det_one_repetition": trial.log_det} | trial.worst
                for name, trial in self.trials.items()
                if name != self.manoeuvre
            },
        }


def excite(
    manoeuvre: Literal["roll-pitch", "single-motor", "optimised"],
    described: ModelFile,
    parameters: str | None = None,
    repetitions: int = 5,
    duration: float = 0.5,
    limits: Limits = Limits(),
    conditions: Conditions = Conditions(),
    progress: Callable[[int, int], None] = lambda done, total: None,
    designing: Callable[[int, int], None] | None = None,
) -> Excitation:
    """Choose or design a manoeuvre, and fly it in simulation.

    If the manoeuvre is optimised, those of the paper are flown first, for comparison. The design uses the noise levels
    that were fitted to the first of them.

    Args:
        manoeuvre: name of the manoeuvre.
        described: best available model of the drone. Run with x64 enabled.
        parameters: parameters to be fitted, as for `choose`; by default those that a fit would choose.
        repetitions: number of manoeuvres in one flight.
        duration: of the open-loop part, 0.1 to 2 s.
        limits: of the manoeuvre.
        conditions: expected noise and disturbances.
        progress: called with (done, total) simulations and predictions.
        designing: called with (done, total) iterations of the design of an optimised manoeuvre.

    Raises:
        CfbError: a parameter is unknown, the duration is out of range, or the limits leave no room for a manoeuvre.
    """
    nominal = described.parameters()
    model = Quadrotor.from_file(described)
    stabiliser = PositionHold(FirmwarePid.hovering(nominal))
    if parameters is not None:
        choose(parameters, nominal)  # refuse unknown names before any simulation
    names = [manoeuvre] if manoeuvre in PAPER else [*PAPER, manoeuvre]
    problem: Problem | None = None
    trials: dict[str, Trial] = {}
    for index, name in enumerate(names):
        if name in PAPER:
            commands = scaled(model, PAPER[name](duration), limits)
        else:
            # `problem` was created with the paper's manoeuvres, which come first.
            commands = optimise(not_none(problem), duration, ITERATIONS, progress=designing).commands
        calm = fly(model, stabiliser, commands, repetitions, conditions.calm, name=name)
        flown = [fly(model, stabiliser, commands, repetitions, conditions, seed=i, name=name) for i in range(FLIGHTS)]
        progress(2 * index + 1, 2 * len(names))
        unknowns = choose(parameters or default_parameters([flown[0].log]), nominal)
        prediction = typical([predict([flight.log], unknowns, conditions.measured_rotors) for flight in flown])
        problem = problem or Problem.of(model, unknowns, prediction.noise, limits, conditions.measured_rotors)
        progress(2 * index + 2, 2 * len(names))
        trials[name] = Trial(
            commands,
            calm,
            flown[0],
            prediction,
            float(log_determinant(problem.judged(commands))),
            attained(calm)[0],
            worst_of([one for flight in flown for one in attained(flight)], limits),
        )
    return Excitation(manoeuvre, trials, repetitions, duration, limits, conditions)
