"""Recordings that rerun opens. The only module that knows rerun: what is recorded is said by those who call it."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes, replacing

TIMELINE = "flight_time"
_VIEWER_S = 4.0
"""A viewer that cannot open has said so by then."""
ARM_M = 0.05
"""From the middle of a drawn drone to a motor, along x and y."""
METRES_PER_NEWTON = 1.0
"""Length of a thrust arrow."""
LIGHT = "#d8dce0"
"""What was measured: rerun's views are dark."""
AXES = {"x": "#E69F00", "y": "#56B4E9", "z": "#009E73"}
"""Okabe and Ito's, one for each axis where lines differ in nothing else."""


@dataclass(frozen=True)
class Plot:
    """A time series view: its title and the entities shown."""

    name: str
    contents: tuple[str, ...]


@dataclass(frozen=True)
class Tab:
    """A 3D view beside plots.

    Attributes:
        name: of the tab.
        world: entity at the root of the 3D view.
        plots: one above the other.
        seen: corners (2, 3) of what the 3D view shows at first, m; None: rerun decides.
    """

    name: str
    world: str
    plots: tuple[Plot, ...]
    seen: np.ndarray | None = None


def part(name: str) -> str:
    """A name as one part of an entity's path, whatever characters it has."""
    return _rerun("recordings").escape_entity_path_part(name)


@contextlib.contextmanager
def recording(application: str, tabs: Sequence[Tab], path: str | Path) -> Iterator[Recorder]:
    """Record into a file.

    Args:
        application: name that rerun keeps settings of views under.
        tabs: how it is shown.
        path: file to write, ``.rrd``; an earlier one stays until the new one is whole.

    Raises:
        CfbError: rerun is not installed, or the file cannot be written.
    """
    rr = _rerun(path)
    if Path(path).suffix != ".rrd":
        raise CfbError(f"{path}: a recording must end in .rrd.")
    with replacing(path) as temporary:
        stream = rr.RecordingStream(application, make_default=False)
        stream.save(temporary, default_blueprint=_blueprint(tabs))
        yield Recorder(rr, stream)
        stream.flush()
        stream.disconnect()


def open_viewer(path: str | Path) -> None:
    """Open rerun's viewer on a recording and leave it open.

    Raises:
        CfbError: there is no such file, rerun is not installed, or its viewer ends at once (no display).
    """
    read_bytes(path, 1)
    _rerun(path)
    with tempfile.TemporaryFile() as said:
        viewer = subprocess.Popen(
            [sys.executable, "-m", "rerun", str(path)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
            start_new_session=True,
        )
        try:
            failed = viewer.wait(_VIEWER_S) != 0
        except subprocess.TimeoutExpired:
            return
        if failed:
            said.seek(0)
            words = " ".join(said.read().decode(errors="replace").split())[-200:]
            raise CfbError(f"{path}: rerun's viewer does not open here ({words}); copy the file to where it does.")


class Recorder:
    """Puts flights into a recording. Times are seconds, positions m in the world, quaternions ``[w, x, y, z]``."""

    def __init__(self, rr: Any, stream: Any):
        self._rr, self._stream = rr, stream

    def world(self, entity: str) -> None:
        """The root of a 3D view: z up."""
        self._stream.log(entity, self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def line(self, entity: str, points: np.ndarray, colour: str | None = None) -> None:
        """A line (n, 3) that is there all the time."""
        strips = self._rr.LineStrips3D([points], radii=0.003, colors=_rgb(colour))
        self._stream.log(entity, strips, static=True)

    def lines(self, entity: str, time: np.ndarray, strips: np.ndarray, colour: str) -> None:
        """Lines (n, points, 3), each shown from its time on."""
        rr = self._rr
        self._stream.log(entity, rr.LineStrips3D.from_fields(colors=_rgb(colour)), static=True)
        columns = rr.LineStrips3D.columns(strips=list(np.asarray(strips, np.float32)))
        self._stream.send_columns(entity, self._time(time), columns)

    def point(self, entity: str, time: np.ndarray, positions: np.ndarray, colour: str) -> None:
        """A point (n, 3) that moves: a set-point."""
        rr = self._rr
        self._stream.log(entity, rr.Points3D.from_fields(colors=_rgb(colour), radii=0.015), static=True)
        self._stream.send_columns(entity, self._time(time), rr.Points3D.columns(positions=positions))

    def drone(
        self,
        entity: str,
        time: np.ndarray,
        position: np.ndarray,
        quaternion: np.ndarray,
        thrust: np.ndarray | None = None,
        colour: str = LIGHT,
    ) -> None:
        """A drone that flies, with an arrow for the thrust of each rotor.

        Args:
            entity: its path.
            time: (n,) s.
            position: (n, 3) m.
            quaternion: (n, 4), body to world.
            thrust: (n, 4) N, of M1 to M4; None: no arrows.
            colour: of its arms.
        """
        rr = self._rr
        poses = rr.Transform3D.columns(translation=position, quaternion=np.asarray(quaternion)[:, [1, 2, 3, 0]])
        self._stream.send_columns(entity, self._time(time), poses)
        corners = ARM_M * np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])
        nose = [[0, 0, 0], [ARM_M, 0, 0]]
        arms = [corners[[0, 2]], corners[[1, 3]], nose]
        self._stream.log(f"{entity}/arms", rr.LineStrips3D(arms, radii=0.004, colors=_rgb(colour)), static=True)
        if thrust is None:
            return
        vectors = np.zeros((len(thrust), 4, 3), np.float32)
        vectors[..., 2] = METRES_PER_NEWTON * np.nan_to_num(thrust)
        origins = np.broadcast_to(corners, vectors.shape)
        arrows = f"{entity}/thrust"
        self._stream.log(arrows, rr.Arrows3D.from_fields(colors=_rgb("#D55E00"), radii=0.003), static=True)
        columns = rr.Arrows3D.columns(vectors=vectors.reshape(-1, 3), origins=origins.reshape(-1, 3).astype(np.float32))
        self._stream.send_columns(arrows, self._time(time), columns.partition([4] * len(thrust)))

    def series(self, entity: str, time: np.ndarray, values: np.ndarray, label: str, colour: str | None = None) -> None:
        """A number (n,) over time."""
        rr = self._rr
        self._stream.log(entity, rr.SeriesLines(names=label, colors=_rgb(colour)), static=True)
        self._stream.send_columns(entity, self._time(time), rr.Scalars.columns(scalars=values))

    def _time(self, time: np.ndarray) -> list:
        return [self._rr.TimeColumn(TIMELINE, duration=np.asarray(time, float))]


def _rerun(where: str | Path):
    try:
        import rerun as rr
    except ImportError:
        raise CfbError(f"{where}: recordings need rerun; run 'pip install rerun-sdk'.") from None
    return rr


def _blueprint(tabs: Sequence[Tab]):
    import rerun.blueprint as rrb

    def shown(tab: Tab):
        plots = [
            rrb.TimeSeriesView(name=p.name, contents=[f"+ /{e}" for e in p.contents], plot_legend=rrb.Corner2D.RightTop)
            for p in tab.plots
        ]
        flight = rrb.Spatial3DView(name="flight", origin=f"/{tab.world}", **_eye(rrb, tab.seen))
        return rrb.Horizontal(flight, rrb.Vertical(*plots), name=tab.name) if plots else flight

    return rrb.Blueprint(rrb.Tabs(*map(shown, tabs)), collapse_panels=True)


def _eye(rrb, seen: np.ndarray | None) -> dict:
    """Looking along -x, as flips about x are seen face on, from so far that all is in the picture."""
    if seen is None or not np.isfinite(seen).all():
        return {}
    low, high = np.asarray(seen, float)
    middle, reach = 0.5 * (low + high), max(0.3, float(np.linalg.norm(high - low)))
    eye = rrb.EyeControls3D(
        position=middle + reach * np.array([1.3, 0.35, 0.35]), look_target=middle, eye_up=(0.0, 0.0, 1.0)
    )
    return {"eye_controls": eye}


def _rgb(colour: str | None) -> list[int] | None:
    return None if colour is None else [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
