"""How well a model predicts flights: the default evaluation (protocol in DESIGN 5, ``docs/evaluation.md``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from cfb_mjx.devices import Devices
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog, require_own_names
from cfb_mjx.model import Quadrotor, State
from cfb_mjx.sysid import metrics
from cfb_mjx.sysid.disturbance import observed_model
from cfb_mjx.sysid.flight import Flight, delay_of, prepare_flight
from cfb_mjx.sysid.observer import Observer, at_starts, observe
from cfb_mjx.sysid.prediction import hold, predict, select, starts_of_windows
from cfb_mjx.sysid.sensor_faults import HEALTHY, SensorFaults
from cfb_mjx.sysid.windows import Windows, find_windows

HORIZONS = (0.05, 0.1, 0.2, 0.5)
VARIANTS = ("commands_in", "rotor_speed_in", "hold")
OBSERVED = ("commands_in_observer", "rotor_speed_in_observer")
"""Two more where an observer helped."""


@dataclass(frozen=True)
class LogEvaluation:
    """Windows of one log, what each variant predicted there and its errors; None where it cannot be had."""

    log: FlightLog
    delay: float
    gyro_delay: float
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
    variants: tuple[str, ...] = VARIANTS
    """The kinds of prediction that were made."""

    def metrics(self, variant: str) -> dict[str, float] | None:
        """Metrics of a variant over all windows of all logs; None where no log allows it."""
        parts = self._errors(variant)
        if not parts:
            return None
        pooled = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        return metrics.metrics(pooled, self.horizons)

    def intervals(self, variant: str) -> dict[str, list[float]] | None:
        """95 % bootstrap intervals of `metrics`."""
        parts = self._errors(variant)
        return metrics.intervals(parts, self.horizons) if parts else None

    def _errors(self, variant: str) -> list[dict[str, np.ndarray]]:
        """Of each log that allows the variant."""
        return [errors for log in self.logs if (errors := log.errors[variant]) is not None]

    @property
    def each(self) -> tuple[Evaluation, ...]:
        """The same of every log alone."""
        return tuple(replace(self, logs=(log,)) for log in self.logs)

    def to_json(self) -> dict:
        """The structure of ``cfb evaluate --json`` (DESIGN 6), plus ``intervals``."""

        def block(evaluation: Evaluation) -> dict:
            return {"windows": sum(len(log.windows) for log in evaluation.logs)} | {
                variant: evaluation.metrics(variant) for variant in self.variants
            }

        return block(self) | {
            "rotor_speed_in_windows": int(sum(log.measured.sum() for log in self.logs)),
            "intervals": {variant: self.intervals(variant) for variant in self.variants},
            "logs": {one.logs[0].log.name: block(one) for one in self.each},
        }


def evaluate(
    model: Quadrotor,
    logs: Sequence[FlightLog],
    horizons: tuple[float, ...] = HORIZONS,
    progress: Callable[[int, int], None] | None = None,
    observer: Observer | None = None,
    faults: SensorFaults = HEALTHY,
    over: Devices | None = None,
    keep_diverged: bool = False,
) -> Evaluation:
    """Predict every window of every log, open loop, and compare with what was measured.

    Rotor speed at a window's start is estimated by the motor model driven with the commands since the log began.
    Integration is by RK4 on steps that end at every row, whatever the model's own integrator: its error is far
    below the sensors' noise. Run it with x64 enabled for full precision.

    With an ``observer`` the variants `OBSERVED` are added: the same predictions with the disturbances it estimated
    from data before each window's start. With sensor ``faults`` the model flies what a healthy chain would have
    recorded, and its predictions are compared with what this one records. The windows of every log are divided ``over``
    devices; the replay of the log before them is not, which is one walk along its rows.

    With ``keep_diverged`` errors are NaN where the model diverged, for a search that passes such a model over.

    Raises:
        CfbError: two logs of one name, no log allows a window, or a prediction that is no number.
    """
    require_own_names(logs)
    precise = Quadrotor(model.parameters, model.effects, body=model.body, integrator="rk4", rotor_loads="instant")
    results = []
    recordings = [_Recording.of(precise, log, horizons, faults) for log in logs]
    began = starts_of_windows(precise, *([getattr(r, key) for r in recordings] for key in ("log", "windows", "flight")))
    for index, recording in enumerate(recordings):
        results.append(_evaluate_log(precise, recording, began[index], horizons, observer, over))
        if not keep_diverged:
            _refuse_diverged(results[-1])
        if progress is not None:
            progress(index + 1, len(logs))
    if not any(len(result.windows) for result in results):
        names = ", ".join(log.name for log in logs)
        raise CfbError(f"{names}: no prediction window fits; a log must fly at least 1.2 s without a gap in its data.")
    variants = VARIANTS if observer is None else VARIANTS + OBSERVED
    return Evaluation(tuple(results), tuple(horizons), variants)


def before_and_after(before: Evaluation, after: Evaluation) -> dict:
    """Metrics of two models on the same flights, in JSON terms: what each predicts, and `hold`."""
    return {
        "hold": before.metrics("hold"),
        "before": before.metrics("commands_in"),
        "after": after.metrics("commands_in"),
        "before_rotor_speed_in": before.metrics("rotor_speed_in"),
        "after_rotor_speed_in": after.metrics("rotor_speed_in"),
    }


def _refuse_diverged(result: LogEvaluation) -> None:
    for variant, errors in result.errors.items():
        if errors is None:
            continue
        lost = np.asarray(~np.isfinite(list(errors.values())).all(axis=(0, 2)))
        if np.any(lost):
            of = result.windows.start[result.measured] if variant.startswith("rotor") else result.windows.start
            raise CfbError(
                f"{result.log.name}: the model diverges: {np.sum(lost)} of {len(lost)} predictions ({variant}) are no "
                f"numbers, the first from {of[lost][0]:.2f} s on; check its parameters and effects."
            )


@dataclass(frozen=True)
class _Recording:
    """A log before anything is predicted: its windows as recorded, and as a healthy chain would have recorded them."""

    as_logged: FlightLog
    log: FlightLog
    delay: float
    gyro_delay: float
    recorded: Windows
    windows: Windows
    faults: SensorFaults

    @property
    def flight(self) -> Flight | None:
        """The rows prepared, where there is something to predict."""
        return prepare_flight(self.log, self.delay, self.gyro_delay) if len(self.windows) else None

    @classmethod
    def of(cls, model: Quadrotor, log: FlightLog, horizons: tuple[float, ...], faults: SensorFaults) -> _Recording:
        delay, gyro_delay = delay_of(log, model.parameters), float(model.parameters.gyro_delay)
        recorded = find_windows(log, horizons, delay, gyro_delay)
        repaired, reached = faults.repaired(log), faults.reached(horizons)
        windows = recorded if faults.healthy else find_windows(repaired, reached, delay, gyro_delay, recorded.start)
        return cls(log, repaired, delay, gyro_delay, recorded, windows, faults)


def _evaluate_log(
    model: Quadrotor,
    recording: _Recording,
    at_start: tuple[np.ndarray, tuple],
    horizons: tuple[float, ...],
    observer: Observer | None,
    over: Devices | None,
) -> LogEvaluation:
    log, delay, faults = recording.log, recording.delay, recording.faults
    recorded, windows = recording.recorded, recording.windows
    began = faults.began(recording.as_logged, windows, delay)
    measured = np.asarray(np.isfinite(windows.rotor_speed).all(axis=(1, 2)))
    predictions: dict[str, State | None] = dict.fromkeys(VARIANTS + OBSERVED)
    if len(windows):
        start, memory = at_start
        predictions["commands_in"] = predict(model, windows, start, memory, over)
        predictions["rotor_speed_in"] = _measured_in(model, windows, measured, memory, over)
        predictions["hold"] = hold(recorded, horizons)
        if observer is not None:
            predictions |= _observed(model, log, delay, windows, measured, memory, observer, over)
    for variant, predicted in predictions.items():
        if predicted is not None and variant != "hold":
            own = jax.tree.map(lambda x: x[measured], began) if variant.startswith("rotor") else began
            predictions[variant] = faults.as_recorded(predicted, horizons, own)
    errors = {
        variant: None
        if predicted is None
        else metrics.errors(select(recorded, measured) if variant.startswith("rotor") else recorded, predicted)
        for variant, predicted in predictions.items()
    }
    return LogEvaluation(log, delay, recording.gyro_delay, recorded, measured, predictions, errors)


def _measured_in(
    model: Quadrotor, windows: Windows, measured: np.ndarray, memory: tuple, over: Devices | None
) -> State | None:
    """Predictions with measured rotor speeds in, of the windows where they were measured."""
    if not measured.any():
        return None
    return predict(model, select(windows, measured), memory=jax.tree.map(lambda x: x[measured], memory), over=over)


def _observed(
    model: Quadrotor,
    log: FlightLog,
    delay: float,
    windows: Windows,
    measured: np.ndarray,
    memory: tuple,
    observer: Observer,
    over: Devices | None,
) -> dict[str, State | None]:
    """The two variants with what ``observer`` knows at the windows' starts."""
    known = at_starts(observe(model, log, delay, observer), log, windows)
    windows, model = replace(windows, body_rate=known.body_rate), observed_model(model, observer)
    return {
        "commands_in_observer": predict(model, windows, known.rotor_speed, (*memory, known.memory(rotors=True)), over),
        "rotor_speed_in_observer": _measured_in(model, windows, measured, (*memory, known.memory(rotors=False)), over),
    }
