"""The closed loop as a rerun recording: held-out flights with their residuals and predictions, before and after."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import replacing
from cfb_mjx.sysid.evaluation import Evaluation, LogEvaluation
from cfb_mjx.sysid.tracing.residuals import UNITS, Residuals
from cfb_mjx.view.closing_figures import AFTER, BEFORE
from cfb_mjx.view.style import MEASURED

RATE, ROWS = 40.0, 1500
"""Rows per second kept, and rows of all flights together at most: residuals are smoothed, and the file stays small."""
FLIGHTS = 6
"""Flights recorded at most."""
_ARM = 0.05


def write_recording(
    path: Path, rows: tuple[list[Residuals], list[Residuals]], before: Evaluation, after: Evaluation
) -> None:
    """Write a recording that `rerun` opens.

    For each flight, under its name: ``residual/<axis>/before|after``, ``signal/<name>``, and in 3D the measured pose
    and path with the predictions of both models from every window's start.

    Args:
        path: file to write, ``.rrd``.
        rows: residuals of the held-out flights before and after, row by row of the same time.
        before: evaluation of the declared model on the same flights, in the same order.
        after: of the corrected model.

    Raises:
        CfbError: rerun is not installed or the file cannot be written.
    """
    try:
        import rerun as rr
    except ImportError:
        raise CfbError(f"{path}: recordings need rerun; run 'pip install rerun-sdk'.") from None
    with replacing(path) as temporary:
        stream = rr.RecordingStream("cfb_close_loop", make_default=False)
        stream.save(temporary, default_blueprint=_blueprint([row.name for row in rows[0][:FLIGHTS]]))
        seconds = sum(log.log.duration for log in before.logs[:FLIGHTS])
        rate = min(RATE, ROWS / max(seconds, 1e-3))
        for index, (old, new) in enumerate(list(zip(*rows, strict=True))[:FLIGHTS]):
            _residuals(rr, stream, old, new, rate)
            _flight(rr, stream, before.logs[index], after.logs[index], rate)
        stream.flush()
        stream.disconnect()


def _plain(name: str) -> str:
    """A name as part of an entity's path."""
    return name.replace(" ", "_")


def _colour(text: str) -> list[int]:
    return [int(text[i : i + 2], 16) for i in (1, 3, 5)]


def _blueprint(names: list[str]):
    import rerun as rr
    import rerun.blueprint as rrb

    def plots(root: str, what: str):
        return rrb.TimeSeriesView(name=what, contents=[f"+ /{root}/residual/{what}_{a}/**" for a in "xyz"])

    roots = {name: rr.escape_entity_path_part(name) for name in names}
    tabs = [
        rrb.Horizontal(
            rrb.Spatial3DView(name="flight", origin=f"/{root}/world"),
            rrb.Vertical(
                plots(root, "torque"),
                plots(root, "force"),
                rrb.TimeSeriesView(name="signals", contents=[f"+ /{root}/signal/velocity_{a}" for a in "xyz"]),
            ),
            name=name,
        )
        for name, root in roots.items()
    ]
    return rrb.Blueprint(rrb.Tabs(*tabs), collapse_panels=True)


def _residuals(rr, stream, before: Residuals, after: Residuals, rate: float) -> None:
    root = rr.escape_entity_path_part(before.name)
    step = max(1, round(1 / (rate * float(np.median(np.diff(before.time))))))
    keep = np.flatnonzero(before.valid)[::step]
    time = [rr.TimeColumn("flight_time", duration=before.time[keep])]
    for label, flight, colour in (("before", before, BEFORE), ("after", after, AFTER)):
        for axis, (values, unit) in flight.axes().items():
            if not np.isfinite(values[keep]).any():
                continue
            path = f"{root}/residual/{_plain(axis)}/{label}"
            line = rr.SeriesLines(colors=_colour(colour), names=f"{axis} {label}, {unit}")
            stream.log(path, line, static=True)
            stream.send_columns(path, time, rr.Scalars.columns(scalars=values[keep]))
    for name, values in before.drivers.items():
        if np.isfinite(values[keep]).any():
            path = f"{root}/signal/{_plain(name)}"
            stream.log(path, rr.SeriesLines(names=f"{name}, {UNITS[name]}"), static=True)
            stream.send_columns(path, time, rr.Scalars.columns(scalars=values[keep]))


def _flight(rr, stream, before: LogEvaluation, after: LogEvaluation, rate: float) -> None:
    log, world = before.log, f"{rr.escape_entity_path_part(before.log.name)}/world"
    step = max(1, round(1 / (rate * max(log.nominal_interval, 1e-4))))
    # Pose rows are late by the delay; the recording shows them when they were true.
    time = [rr.TimeColumn("flight_time", duration=log.time[::step] - before.delay)]
    stream.log(world, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    path = rr.LineStrips3D([log.position[::step]], colors=_colour(MEASURED), radii=0.003)
    stream.log(f"{world}/measured_path", path, static=True)
    quaternion = log.quaternion[::step][:, [1, 2, 3, 0]]
    columns = rr.Transform3D.columns(translation=log.position[::step], quaternion=quaternion)
    stream.send_columns(f"{world}/drone", time, columns)
    arms = [[[_ARM, _ARM, 0], [-_ARM, -_ARM, 0]], [[_ARM, -_ARM, 0], [-_ARM, _ARM, 0]]]
    stream.log(f"{world}/drone/arms", rr.LineStrips3D(arms, radii=0.005, colors=_colour(MEASURED)), static=True)
    for label, evaluated, colour in (("before", before, BEFORE), ("after", after, AFTER)):
        said = evaluated.predictions["commands_in"]
        if said is None:
            continue
        windows = evaluated.windows
        strips = np.concatenate([windows.position[:, None], np.asarray(said.position)], axis=1)
        stream.log(f"{world}/prediction_{label}", rr.LineStrips3D.from_fields(colors=_colour(colour)), static=True)
        stream.send_columns(
            f"{world}/prediction_{label}",
            [rr.TimeColumn("flight_time", duration=windows.start)],
            rr.LineStrips3D.columns(strips=list(strips.astype(np.float32))),
        )
