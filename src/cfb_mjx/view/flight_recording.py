"""Flights of a controller as a rerun recording: drones in 3D, their ways, commands and rates."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import replacing
from cfb_mjx.view.style import MEASURED

DRONES = 40
"""Drones recorded at most."""
_ARM = 0.05
_MOTORS = ("M1", "M2", "M3", "M4")


def write_flight_recording(path: str | Path, flown, dt: float) -> None:
    """Write a recording that `rerun` opens.

    Every drone has its pose and way under ``world/<number>``; commands, body rates and velocities of the first are
    under ``signal``.

    Args:
        path: file to write, ``.rrd``.
        flown: a `cfb_mjx.train.flying.Flight` with axes (drones, steps).
        dt: time between two commands, s.

    Raises:
        CfbError: rerun is not installed or the file cannot be written.
    """
    try:
        import rerun as rr
        import rerun.blueprint as rrb
    except ImportError:
        raise CfbError(f"{path}: recordings need rerun; run 'pip install rerun-sdk'.") from None
    position, quaternion = np.asarray(flown.position), np.asarray(flown.quaternion)[..., [1, 2, 3, 0]]
    time = [rr.TimeColumn("flight_time", duration=dt * (1 + np.arange(position.shape[1])))]
    signals = {
        "command": (np.asarray(flown.command)[0], _MOTORS),
        "body_rate": (np.degrees(np.asarray(flown.body_rate)[0]), ("x, deg/s", "y, deg/s", "z, deg/s")),
        "velocity": (np.asarray(flown.velocity)[0], ("x, m/s", "y, m/s", "z, m/s")),
    }
    plots = [rrb.TimeSeriesView(name=name, contents=[f"+ /signal/{name}/**"]) for name in signals]
    blueprint = rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(name="flight", origin="/world"), rrb.Vertical(*plots)), collapse_panels=True
    )
    arms = [[[_ARM, _ARM, 0], [-_ARM, -_ARM, 0]], [[_ARM, -_ARM, 0], [-_ARM, _ARM, 0]], [[0, 0, 0], [0, 0, _ARM]]]
    colour = [int(MEASURED[i : i + 2], 16) for i in (1, 3, 5)]
    with replacing(path) as temporary:
        stream = rr.RecordingStream("cfb_fly", make_default=False)
        stream.save(temporary, default_blueprint=blueprint)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for i in range(min(DRONES, len(position))):
            # What has failed may be anywhere, or nowhere.
            there = np.isfinite(position[i]).all(axis=1)
            stream.log(f"world/{i}/way", rr.LineStrips3D([position[i][there]], radii=0.003), static=True)
            poses = rr.Transform3D.columns(translation=position[i], quaternion=quaternion[i])
            stream.send_columns(f"world/{i}/drone", time, poses)
            stream.log(f"world/{i}/drone/arms", rr.LineStrips3D(arms, radii=0.004, colors=colour), static=True)
        for name, (values, labels) in signals.items():
            for column, label in zip(values.T, labels, strict=True):
                stream.log(f"signal/{name}/{label[:2].strip(',')}", rr.SeriesLines(names=label), static=True)
                columns = rr.Scalars.columns(scalars=column)
                stream.send_columns(f"signal/{name}/{label[:2].strip(',')}", time, columns)
        stream.flush()
        stream.disconnect()
