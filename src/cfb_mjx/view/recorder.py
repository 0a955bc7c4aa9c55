"""Write recordings for rerun. This is the only module that imports rerun."""

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
"""Time after which a viewer that has not ended counts as open, s."""
ARM_M = 0.05
"""Distance from the centre of a drawn drone to a motor, along x and along y, m."""
METRES_PER_NEWTON = 1.0
"""Scale of the thrust arrows."""
LIGHT = "#d8dce0"
"""Colour of measurements; light, because rerun's views are dark."""
AXES = {"x": "#E69F00", "y": "#56B4E9", "z": "#009E73"}
"""Colours of the axes (Okabe and Ito), for lines that differ only in the axis."""


@dataclass(frozen=True)
class Plot:
    """A time series view: its title, and the entities shown in it."""

    name: str
    contents: tuple[str, ...]


@dataclass(frozen=True)
class Tab:
    """A 3D view next to plots.

    Attributes:
        name: title of the tab.
        world: entity at the root of the 3D view.
        plots: the plots, from top to bottom.
        seen: corners (2, 3) of the region that the 3D view shows at first, m; None: rerun decides.
    """

    name: str
    world: str
    plots: tuple[Plot, ...]
    seen: np.ndarray | None = None


def part(name: str) -> str:
    """A name, with any characters, escaped as one part of an entity's path."""
    return _rerun("recordings").escape_entity_path_part(name)


@contextlib.contextmanager
def recording(application: str, tabs: Sequence[Tab], path: str | Path) -> Iterator[Recorder]:
    """Context manager that writes a recording.

    Args:
        application: name under which rerun stores the settings of its views.
        tabs: layout of the views.
        path: file to write, ``.rrd``. An existing file is replaced only when the new one is complete.

    Raises:
        CfbError: rerun is not installed, the path does not end in ``.rrd``, or the file cannot be written.
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
    """Open a recording in rerun's viewer, which stays open.

    Raises:
        CfbError: there is no such file, rerun is not installed, or its viewer ends at once (for example without a
            display).
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
            raise CfbError(
                f"{path}: rerun's viewer does not open here ({words}); copy the file to a machine with a display."
            )


class Recorder:
    """Writes flights into a recording. Times in s, positions in m (world), quaternions ``[w, x, y, z]``."""

    def __init__(self, rr: Any, stream: Any):
        self._rr, self._stream = rr, stream

    def world(self, entity: str) -> None:
        """Declare an entity as the root of a 3D view with z up."""
        self._stream.log(entity, self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def line(self, entity: str, points: np.ndarray, colour: str | None = None) -> None:
        """Record a line (n, 3) that is always visible."""
        strips = self._rr.LineStrips3D([points], radii=0.003, colors=_rgb(colour))
        self._stream.log(entity, strips, static=True)

    def lines(self, entity: str, time: np.ndarray, strips: np.ndarray, colour: str) -> None:
        """Record lines (n, points, 3), each shown from its time on."""
        rr = self._rr
        self._stream.log(entity, rr.LineStrips3D.from_fields(colors=_rgb(colour)), static=True)
        columns = rr.LineStrips3D.columns(strips=list(np.asarray(strips, np.float32)))
        self._stream.send_columns(entity, self._time(time), columns)

    def point(self, entity: str, time: np.ndarray, positions: np.ndarray, colour: str) -> None:
        """Record a moving point (n, 3), for example a set-point."""
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
        """Record a moving drone, with an arrow for the thrust of each rotor.

        Args:
            entity: path of its entity.
            time: (n,) s.
            position: (n, 3) m.
            quaternion: (n, 4), body to world.
            thrust: (n, 4) N, of M1 to M4; None: no arrows.
            colour: colour of its arms.
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
        """Record a number (n,) over time."""
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
    """Camera looking along -x, so that flips about x are seen face on, at a distance that shows the whole region."""
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
