"""How well a model predicts flights: the default evaluation (protocol in DESIGN 5, ``docs/evaluation.md``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor, State
from cfb_mjx.sysid import metrics
from cfb_mjx.sysid.prediction import hold, predict, select, start_of_windows
from cfb_mjx.sysid.windows import Windows, find_windows

HORIZONS = (0.05, 0.1, 0.2, 0.5)
VARIANTS = ("commands_in", "rotor_speed_in", "hold")


@dataclass(frozen=True)
class LogEvaluation:
    """Windows of one log, what each variant predicted there and its errors; None where it cannot be had."""

    log: FlightLog
    delay: float
    windows: Windows
    measured: np.ndarray
    """(W,) whether rotor speed was measured throughout the window."""
    predictions: dict[str, State | None]
    errors: dict[str, dict[str, np.ndarray] | None]


@dataclass(frozen=True)
class Evaluation:
    """Prediction errors of one model on several logs."""

    logs: tuple[LogEvaluation, ...]
    horizons: tuple[float, ...]

    def metrics(self, variant: str) -> dict[str, float] | None:
        """Metrics of a variant over all windows of all logs; None where no log allows it."""
        parts = [log.errors[variant] for log in self.logs if log.errors[variant] is not None]
        if not parts:
            return None
        pooled = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        return metrics.metrics(pooled, self.horizons)

    def intervals(self, variant: str) -> dict[str, list[float]] | None:
        """95 % bootstrap intervals of `metrics`."""
        parts = [log.errors[variant] for log in self.logs if log.errors[variant] is not None]
        return metrics.intervals(parts, self.horizons) if parts else None

    def to_json(self) -> dict:
        """The structure of ``cfb evaluate --json`` (DESIGN 6), plus ``intervals``."""

        def block(evaluation: Evaluation) -> dict:
            return {"windows": sum(len(log.windows) for log in evaluation.logs)} | {
                variant: evaluation.metrics(variant) for variant in VARIANTS
            }

        return block(self) | {
            "rotor_speed_in_windows": int(sum(log.measured.sum() for log in self.logs)),
            "intervals": {variant: self.intervals(variant) for variant in VARIANTS},
            "logs": {log.log.name: block(Evaluation((log,), self.horizons)) for log in self.logs},
        }


def evaluate(
    model: Quadrotor,
    logs: Sequence[FlightLog],
    horizons: tuple[float, ...] = HORIZONS,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Predict every window of every log, open loop, and compare with what was measured.

    Rotor speed at a window's start is estimated by the motor model driven with the commands since the log began.
    Integration is by RK4 on steps that end at every row, whatever the model's own integrator: its error is far
    below the sensors' noise. Run it with x64 enabled for full precision.

    Raises:
        CfbError: two logs of one name, or no log allows a window.
    """
    names = [log.name for log in logs]
    for name in names:
        if names.count(name) > 1:
            raise CfbError(f"{name}: two logs have this name; rename one file, results are listed by name.")
    precise = Quadrotor(model.parameters, model.effects, body=model.body, integrator="rk4", rotor_loads="instant")
    results = []
    for index, log in enumerate(logs):
        results.append(_evaluate_log(precise, log, horizons))
        if progress is not None:
            progress(index + 1, len(logs))
    if not any(len(result.windows) for result in results):
        raise CfbError(
            f"{', '.join(names)}: no prediction window fits; a log must fly at least 1.2 s without a gap in its data."
        )
    return Evaluation(tuple(results), tuple(horizons))


def _evaluate_log(model: Quadrotor, log: FlightLog, horizons: tuple[float, ...]) -> LogEvaluation:
    delay = log.metadata.get("observation_delay")
    delay = float(model.parameters.observation_delay) if delay is None else float(delay)
    windows = find_windows(log, horizons, delay)
    measured = np.isfinite(windows.rotor_speed).all(axis=(1, 2))
    predictions: dict[str, State | None] = dict.fromkeys(VARIANTS)
    errors: dict[str, dict[str, np.ndarray] | None] = dict.fromkeys(VARIANTS)
    if len(windows):
        start, memory = start_of_windows(model, log, windows, delay)
        predictions["commands_in"] = predict(model, windows, start, memory)
        predictions["hold"] = hold(windows, horizons)
        for variant in ("commands_in", "hold"):
            errors[variant] = metrics.errors(windows, predictions[variant])
        if measured.any():
            chosen = select(windows, measured)
            kept = jax.tree.map(lambda x: x[measured], memory)
            predictions["rotor_speed_in"] = predict(model, chosen, memory=kept)
            errors["rotor_speed_in"] = metrics.errors(chosen, predictions["rotor_speed_in"])
    return LogEvaluation(log, delay, windows, measured, predictions, errors)
