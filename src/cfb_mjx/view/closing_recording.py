"""Rerun recording of a model correction: held-out flights with residuals and predictions, before and after."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.sysid.evaluation import Evaluation, LogEvaluation
from cfb_mjx.sysid.tracing.residuals import UNITS, Residuals
from cfb_mjx.view.closing_figures import AFTER, BEFORE
from cfb_mjx.view.recorder import AXES, LIGHT, Plot, Recorder, Tab, part, recording

RATE, ROWS = 40.0, 1500
"""Largest number of rows per second, and of rows in all flights. Residuals are smoothed, so few rows suffice."""
FLIGHTS = 6
"""Largest number of flights in a recording."""


def write_recording(
    path: Path, rows: tuple[list[Residuals], list[Residuals]], before: Evaluation, after: Evaluation
) -> None:
    """Write a recording that `rerun` opens.

    For each flight, under its name: ``residual/<axis>/before|after``, ``signal/<name>``, and in 3D the measured pose
    and path with the predictions of both models from the start of every window.

    Args:
        path: file to write, ``.rrd``.
        rows: residuals of the held-out flights before and after, at the same times.
        before: evaluation of the declared model on the same flights, in the same order.
        after: evaluation of the corrected model.

    Raises:
        CfbError: rerun is not installed or the file cannot be written.
    """
    tabs = [tab(one.log, part(one.log.name)) for one in before.logs[:FLIGHTS]]
    seconds = sum(log.log.duration for log in before.logs[:FLIGHTS])
    rate = min(RATE, ROWS / max(seconds, 1e-3))
    with recording("cfb_close_loop", tabs, path) as recorder:
        for index, (old, new) in enumerate(list(zip(*rows, strict=True))[:FLIGHTS]):
            root = part(old.name)
            record_residuals(recorder, root, {"before": (old, BEFORE), "after": (new, AFTER)}, rate)
            record_flight(recorder, root, before.logs[index], rate)
            for label, evaluated, colour in (("before", before, BEFORE), ("after", after, AFTER)):
                record_predictions(recorder, f"{root}/world/prediction_{label}", evaluated.logs[index], colour)


def tab(log: FlightLog, root: str, more: tuple[Plot, ...] = ()) -> Tab:
    """A tab with the flight in 3D and plots of ``more``, its residuals and its velocity."""
    residuals = tuple(
        Plot(f"residual: {what}", tuple(f"{root}/residual/{key}_{axis}/**" for axis in "xyz"))
        for key, what in (("torque", "torque / inertia"), ("force", "force / mass"))
    )
    velocity = Plot("velocity, body axes", tuple(f"{root}/signal/velocity_{axis}" for axis in "xyz"))
    seen = np.stack([log.position.min(axis=0), log.position.max(axis=0)])
    return Tab(log.name, f"{root}/world", (*more, *residuals, velocity), seen)


def record_residuals(
    recorder: Recorder, root: str, residuals: dict[str, tuple[Residuals, str | None]], rate: float
) -> None:
    """Record the residuals of one flight, and the signals on which they could depend.

    Args:
        recorder: the open recording.
        root: entity of the flight.
        residuals: label to residuals (of the same rows) and colour; None: the colour of the axis.
        rate: rows per second to keep.
    """
    first = next(iter(residuals.values()))[0]
    step = max(1, round(1 / (rate * float(np.median(np.diff(first.time))))))
    keep = np.flatnonzero(first.valid)[::step]
    time = first.time[keep]
    for label, (flight, colour) in residuals.items():
        for axis, (values, unit) in flight.axes().items():
            if np.isfinite(values[keep]).any():
                entity = f"{root}/residual/{_plain(axis)}/{label}"
                own = AXES.get(axis[-1]) if colour is None else colour
                recorder.series(entity, time, values[keep], f"{axis} {label}, {unit}", own)
    for name, values in first.drivers.items():
        if np.isfinite(values[keep]).any():
            recorder.series(
                f"{root}/signal/{_plain(name)}", time, values[keep], f"{name}, {UNITS[name]}", AXES.get(name[-1])
            )


def record_flight(
    recorder: Recorder, root: str, evaluated: LogEvaluation, rate: float, thrust: np.ndarray | None = None
) -> None:
    """Record the measured path and pose, and the thrust (n, 4) [N] of every row of the log, if given."""
    log, world = evaluated.log, f"{root}/world"
    step = max(1, round(1 / (rate * max(log.nominal_interval, 1e-4))))
    recorder.world(world)
    recorder.line(f"{world}/measured_path", log.position[::step], LIGHT)
    # Pose rows lag by the delay; the recording shows them at the time at which they were true.
    time = log.time[::step] - evaluated.delay
    arrows = None if thrust is None else thrust[::step]
    recorder.drone(f"{world}/drone", time, log.position[::step], log.quaternion[::step], arrows)


def record_predictions(recorder: Recorder, entity: str, evaluated: LogEvaluation, colour: str) -> None:
    """Record the predicted path from the start of every window."""
    said, windows = evaluated.predictions["commands_in"], evaluated.windows
    if said is not None:
        strips = np.concatenate([windows.position[:, None], np.asarray(said.position)], axis=1)
        recorder.lines(entity, windows.start, strips, colour)


def _plain(name: str) -> str:
    """A name as one part of an entity's path, without blanks."""
    return name.replace(" ", "_")
