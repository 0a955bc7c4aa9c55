"""Paths for a position controller; each kind of path excites some effects and not others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

SECONDS = 15.0
"""Duration of every path, s."""
HEIGHT = 1.2
"""Height of level paths, m. All paths stay within 1 m of the origin horizontally and do not exceed 2.2 m."""
Path = Float[np.ndarray, "n 4"]
"""Set-points x, y, z, m, and yaw, rad."""


def _steps(time: np.ndarray, values: list[float], duration: float) -> np.ndarray:
    return np.asarray(values)[np.minimum((time // duration).astype(int), len(values) - 1)]


def _there_and_back(time: np.ndarray, reach: float, speeds: tuple[float, ...]) -> np.ndarray:
    """Motion from -reach to reach and back at each of the speeds in turn, then standing still."""
    corners, ends = [0.0], [-reach]
    for speed in speeds:
        for end in (reach, -reach):
            corners.append(corners[-1] + 2 * reach / speed)
            ends.append(end)
    return np.interp(time, corners, ends)


def _level(
    time: np.ndarray,
    x: float | np.ndarray = 0.0,
    y: float | np.ndarray = 0.0,
    z: float | np.ndarray = HEIGHT,
    yaw: float | np.ndarray = 0.0,
) -> Path:
    return np.stack([np.broadcast_to(np.asarray(a, float), time.shape) for a in (x, y, z, yaw)], axis=1)


PATHS: dict[str, tuple[str, Callable[[np.ndarray], Path]]] = {
    "passes along x": (
        "straight passes along x at 0.5, 1 and 2.5 m/s, nose forwards",
        lambda t: _level(t, x=_there_and_back(t, 0.9, (0.5, 1.0, 2.5))),
    ),
    "passes along y": (
        "straight passes along y at 0.5, 1 and 2.5 m/s, flying sideways",
        lambda t: _level(t, y=_there_and_back(t, 0.9, (0.5, 1.0, 2.5))),
    ),
    "climbs": (
        "climbs and dives between 0.6 and 2.2 m at 0.5, 1 and 2 m/s",
        lambda t: _level(t, z=1.4 + _there_and_back(t, 0.8, (0.5, 1.0, 2.0))),
    ),
    "heights": (
        "hover for three seconds each at 0.1, 0.15, 0.25, 0.5 and 1 m",
        lambda t: _level(t, z=_steps(t, [0.1, 0.15, 0.25, 0.5, 1.0], 3.0)),
    ),
    "headings": (
        "hover with the heading turned by 90 degrees every three seconds",
        lambda t: _level(t, yaw=0.5 * np.pi * _steps(t, [0.0, 1.0, 2.0, -1.0, 0.0], 3.0)),
    ),
    "yaw turns": (
        "hover with yaw steps of 120 degrees back and forth",
        lambda t: _level(t, yaw=_steps(t, [0.0, 2.1, 0.0, -2.1] * 4, 1.0)),
    ),
    "stops": (
        "steps of one metre, forwards and sideways in turn, each followed by a hover",
        lambda t: _level(t, x=_steps(t, [0.0, 1.0, 1.0, 0.0, 0.0], 3.0), y=_steps(t, [0.0, 0.0, 1.0, 1.0, 0.0], 3.0)),
    ),
}
"""Paths by name: a description for the pilot, and a function from times (n,), s, to set-points (n, 4)."""


def path(name: str, tick: float) -> Path:
    """Set-points (n, 4) of a path, one per ``tick`` seconds."""
    return PATHS[name][1](np.arange(round(SECONDS / tick)) * tick)


def setpoints_csv(name: str, tick: float = 0.02) -> str:
    """A path as a CSV table of time, s, position, m, and yaw, rad, with a row every ``tick`` seconds."""
    rows = enumerate(path(name, tick))
    lines = ["t,x,y,z,yaw", *(f"{tick * i:.2f}," + ",".join(f"{v:.4f}" for v in row) for i, row in rows)]
    return "\n".join(lines) + "\n"
