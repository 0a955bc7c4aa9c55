"""Evaluate how well a model predicts flights in open loop (protocol in ``docs/evaluation.md``)."""

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
"""Default prediction horizons, s."""
VARIANTS = ("commands_in", "rotor_speed_in", "hold")
"""Kinds of prediction: from commands, from measured rotor speeds, and the baseline `hold`."""
OBSERVED = ("commands_in_observer", "rotor_speed_in_observer")
"""Additional kinds of prediction if there is an observer."""


@dataclass(frozen=True)
class LogEvaluation:
    """Predictions of the W windows of one log.

    Attributes:
        log: the flight.
        delay: age of pose and velocity in its rows, s.
        gyro_delay: age of the gyro reading in its rows, s.
        windows: as recorded.
        measured: (W,) whether rotor speed was measured throughout the window.
        predictions: predicted states (W, H, ...) by variant; None if the variant is not available.
        errors: errors (W, H) by variant and quantity, as of `metrics.errors`; None if the variant is not available.
    """

    log: FlightLog
    delay: float
    gyro_delay: float
    windows: Windows
    measured: np.ndarray
    predictions: dict[str, State | None]
    errors: dict[str, dict[str, np.ndarray] | None]


@dataclass(frozen=True)
class Evaluation:
    """Prediction errors of one model on several logs.

    Attributes:
        logs: results of each log.
        horizons: prediction horizons, s.
        variants: kinds of prediction that were made.
    """

    logs: tuple[LogEvaluation, ...]
    horizons: tuple[float, ...]
    variants: tuple[str, ...] = VARIANTS

    def metrics(self, variant: str) -> dict[str, float] | None:
        """Metrics of a variant over all windows of all logs; None if the variant is available for no log."""
        parts = self._errors(variant)
        if not parts:
            return None
        pooled = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        return metrics.metrics(pooled, self.horizons)

    def intervals(self, variant: str) -> dict[str, list[float]] | None:
        """95 % bootstrap intervals of `metrics`; None if the variant is available for no log."""
        parts = self._errors(variant)
        return metrics.intervals(parts, self.horizons) if parts else None

    def _errors(self, variant: str) -> list[dict[str, np.ndarray]]:
        """Errors of each log for which the variant is available."""
        return [errors for log in self.logs if (errors := log.errors[variant]) is not None]

    @property
    def each(self) -> tuple[Evaluation, ...]:
        """Evaluations of the single logs."""
        return tuple(replace(self, logs=(log,)) for log in self.logs)

    def to_json(self) -> dict:
        """The content of ``cfb evaluate --json``."""

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
    """Predict every window of every log in open loop, and compare the predictions with the measurements.

    The rotor speed at a window's start is estimated by the motor model, driven with the commands since the start of the
    log. The integrator is RK4 with steps that end at every row, regardless of the model's own integrator; its error is
    far below the sensors' noise. Run with x64 enabled for full precision.

    Args:
        model: the drone.
        logs: flights with different names.
        horizons: prediction horizons, s, ascending.
        progress: called with (done, total) after each log.
        observer: if given, the variants `OBSERVED` are added: the same predictions with disturbances that the observer
            estimated from data before each window's start.
        faults: of the sensors. They are removed from the inputs of a prediction and applied to its result, which is
            compared with the log as recorded.
        over: devices over which the windows are divided. The replay of a log up to the windows is not divided.
        keep_diverged: return non-finite errors where the model diverges, instead of raising an error.

    Raises:
        CfbError: two logs have the same name, no log allows a window, or the model diverges.
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
    """Metrics of two models and of `hold` on the same flights, as a JSON-compatible dictionary."""
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
                f"{result.log.name}: the model diverges: {np.sum(lost)} of {len(lost)} predictions ({variant}) are not "
                f"finite, the first from {of[lost][0]:.2f} s on; check its parameters and effects."
            )


@dataclass(frozen=True)
class _Recording:
    """A log and its windows, as recorded and with the sensor faults removed."""

    as_logged: FlightLog
    log: FlightLog
    delay: float
    gyro_delay: float
    recorded: Windows
    windows: Windows
    faults: SensorFaults

    @property
    def flight(self) -> Flight | None:
        """The prepared rows; None if there are no windows."""
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
    """Predictions from measured rotor speeds, for the windows in which these were measured."""
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
    """The variants `OBSERVED`: predictions with the observer's estimates at the windows' starts."""
    known = at_starts(observe(model, log, delay, observer), log, windows)
    windows, model = replace(windows, body_rate=known.body_rate), observed_model(model, observer)
    return {
        "commands_in_observer": predict(model, windows, known.rotor_speed, (*memory, known.memory(rotors=True)), over),
        "rotor_speed_in_observer": _measured_in(model, windows, measured, (*memory, known.memory(rotors=False)), over),
    }
