"""Comparisons of signals of a log that measure the same motion.

Compared are displacement and velocity, attitude and gyro, velocity and accelerometer, accelerometer and gravity, drag
and velocity, and roll and pitch with the motors.

Each comparison is made per axis, over short windows, with a lag of its own. It yields a slope, a correlation, and the
share of both signals that stays unexplained. An axis that hardly moves is not judged.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from cfb_mjx.logs import rotation
from cfb_mjx.logs.alignment import ROLL_PITCH, motor_spectra
from cfb_mjx.logs.flight_log import FlightLog

GRAVITY = 9.81
CONTRADICTS = 0.2
"""Unexplained share from which two signals contradict each other. In 334 good flights it is at most 0.14; it is larger
in one other flight, whose estimated yaw is wrong for some seconds."""
_LAGS = (0.0, 0.01, 0.02, 0.04, 0.08, 0.12)  # s, candidate lags of pose and velocity
_MOST_WINDOWS = 4000
_TRIMMED = 0.1  # share of the worst windows that is ignored, because a glitch is not a wrong unit
_RARE = 0.03  # share of the windows with the most motion that is ignored when deciding whether an axis moves
_FEWEST = 10  # windows
_BLOCK, _TURNED = 0.2, 1.0  # s and rad: drag is averaged over blocks in which the body rotates less than this
_PUSHES, _CROSSED = 0.4, 0.65  # correlations of force and velocity: wrong sign above; other axis below the negative
_FAST = 5.0  # rad/s; above this, rotations are compared over windows half as long
ORDER = (0, 1, 2, 3)


@dataclasses.dataclass(frozen=True)
class Relation:
    """Comparison of two signals that should be equal, along one axis.

    Attributes:
        name: ``displacement``, ``attitude``, ``velocity``, ``gravity``, ``upright`` or ``drag``.
        axis: ``x``, ``y``, ``z``; empty for gravity and upright.
        slope: regression slope of the measured signal on the integrated one.
        lag: lag of the measured signal, s.
        correlation: of the two signals.
        unexplained: mean square of their difference over the mean of their mean squares: 0 for equal, 2 for unrelated,
            4 for opposite signals. For drag, of which only the sign is checked: twice the correlation if the sign is
            wrong, else 0.
        moves: whether the axis moves enough to be judged.
    """

    name: str
    axis: str
    slope: float
    lag: float
    correlation: float
    unexplained: float
    moves: bool

    @property
    def contradicts(self) -> bool:
        """Whether the two signals contradict each other."""
        return self.moves and self.unexplained > CONTRADICTS


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Changes of a measured signal over windows, and integrals over the same windows of the signal's derivative.

    Attributes:
        time: (n,) s, start of each window.
        width: length of the windows, s.
        lag: lag of the measured signal, s.
        integrated: (n, 3) integral of the derivative.
        measured: (n, 3) change of the measured signal.
    """

    time: np.ndarray
    width: float
    lag: float
    integrated: np.ndarray
    measured: np.ndarray


_LEAST = {"displacement": 0.013, "attitude": 0.018, "velocity": 0.065}
"""rms of either signal over a window (m, rad, m/s) from which an axis counts as moving."""


def comparisons(log: FlightLog) -> dict[str, Comparison]:
    """The comparisons ``displacement`` (m), ``attitude`` (rad) and ``velocity`` (m/s), over windows.

    A comparison for which the log is too short is left out.
    """
    q = rotation.tidy(log.quaternion)
    turns = 0.05 if np.sqrt(np.mean(np.sum(log.body_rate**2, axis=1))) > _FAST else 0.1

    def turned(a, b):
        return rotation.rotation_vector(rotation.multiply(rotation.conjugate(q[a]), q[b]))

    found = {
        "displacement": _compared(log, 0.2, log.velocity, lambda a, b: log.position[b] - log.position[a]),
        "attitude": _compared(log, turns, log.body_rate, turned),
        "velocity": _compared(log, 0.2, _acceleration(log, q), lambda a, b: log.velocity[b] - log.velocity[a], True),
    }
    return {name: c for name, c in found.items() if c is not None}


def kinematics(log: FlightLog) -> list[Relation]:
    """All thirteen relations of pose, velocity, gyro and accelerometer; fewer if the log is too short."""
    q = rotation.tidy(log.quaternion)
    found = [r for name, c in comparisons(log).items() for r in _relations(name, c)]
    return [*found, *_gravity(log, _acceleration(log, q)), *_drag(log, q)]


def when(log: FlightLog, relation: Relation) -> str:
    """Where a relation does not hold, as `` between A and B s``. Empty for gravity, upright and drag."""
    compared = comparisons(log).get(relation.name)
    if compared is None:
        return ""
    axis = "xyz".index(relation.axis)
    off = np.abs(compared.integrated - compared.measured)[:, axis] > _LEAST[relation.name]
    times = compared.time[off]
    return f" between {times[0]:.1f} and {times[-1] + compared.width:.1f} s" if len(times) else ""


def _acceleration(log: FlightLog, q: np.ndarray) -> np.ndarray:
    return rotation.to_world(q, log.specific_force) - [0.0, 0.0, GRAVITY]


def _compared(log, width, integrand, change, centred=False) -> Comparison | None:
    """Compare ``change(a, b)`` between rows with the integral of ``integrand``, at the lag with the best agreement."""
    time, step = log.time, log.nominal_interval
    gap = np.concatenate([[0], np.cumsum(np.diff(time) > log.gap_threshold)])
    steps = np.diff(time)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum((integrand[1:] + integrand[:-1]) / 2 * steps, axis=0)])
    width = max(width, 3 * step)
    stride = max(1, round(width / 2 / step), len(time) // _MOST_WINDOWS)
    first = np.arange(0, len(time), stride)
    last = np.searchsorted(time, time[first] + width - step / 2)
    best: tuple[float, Comparison] | None = None
    for late in dict.fromkeys(round(lag / step) for lag in _LAGS):
        inside = last + late < len(time)
        a, b = first[inside], last[inside]
        whole = gap[a] == gap[b + late]
        a, b = a[whole], b[whole]
        if len(a) < _FEWEST:
            continue
        x, y = integral[b] - integral[a], change(a + late, b + late)
        if centred:
            # Remove the offset that a tilted attitude or an accelerometer bias adds to every window.
            x, y = x - np.median(x, axis=0), y - np.median(y, axis=0)
        cost = float(np.sum(_trimmed(np.sum((x - y) ** 2, axis=1))))
        if best is None or cost < best[0]:
            best = cost, Comparison(time[a], width, late * step, x, y)
    return None if best is None else best[1]


def _relations(name: str, compared: Comparison) -> list[Relation]:
    found = []
    for axis, (u, v) in enumerate(zip(compared.integrated.T, compared.measured.T, strict=True)):
        keep = _kept((u - v) ** 2)
        uu, vv, uv = (float(np.mean(p[keep])) for p in (u * u, v * v, u * v))
        # From all windows, because contradicting signals have most of their motion in the windows trimmed above.
        both = u * u + v * v
        usual = both <= np.quantile(both, 1 - _RARE)
        size = float(np.sqrt(max(np.mean(p[usual] ** 2) for p in (u, v))))
        found.append(
            Relation(
                name,
                "xyz"[axis],
                uv / uu if uu > 0 else 0.0,
                compared.lag,
                uv / np.sqrt(uu * vv) if uu * vv > 0 else 0.0,
                2 * float(np.mean((u - v)[keep] ** 2)) / max(uu + vv, 1e-300),
                size > _LEAST[name],
            )
        )
    return found


def _kept(values: np.ndarray) -> np.ndarray:
    return values <= np.quantile(values, 1 - _TRIMMED)


def _trimmed(values: np.ndarray) -> np.ndarray:
    return values[_kept(values)]


def _gravity(log: FlightLog, force: np.ndarray) -> list[Relation]:
    """Relations of the accelerometer with gravity.

    ``gravity``: over a whole flight, the mean specific force minus the mean change of the velocity is gravity.
    ``upright``: the median specific force along body z is positive.
    """
    if log.duration < 1.0:
        return []
    steps = np.diff(log.time)
    whole = steps <= log.gap_threshold
    mean = np.sum(((force[1:] + force[:-1]) / 2 * steps[:, None])[whole], axis=0) / np.sum(steps[whole])
    changes = np.sum(np.diff(log.velocity, axis=0)[whole], axis=0) / np.sum(steps[whole])
    off = mean - changes
    read = float(mean[2] + GRAVITY)
    up = float(np.median(log.specific_force[:, 2])) / GRAVITY
    return [
        Relation("gravity", "", read / GRAVITY, 0.0, 1.0, float(off @ off) / GRAVITY**2, True),
        Relation("upright", "", up, 0.0, 1.0, 2.0 * (up < 0), abs(up) > 0.5),
    ]


def _drag(log: FlightLog, q: np.ndarray) -> list[Relation]:
    """Check the sign of drag: along body x and y only the air exerts a force, and it opposes the velocity."""
    width = max(1, round(_BLOCK / log.nominal_interval))
    count = len(log) // width
    if count < _FEWEST:
        return []

    def means(values):
        return values[: count * width].reshape(count, width, -1).mean(axis=1)

    # In a flip, the body axes change their direction within a block.
    calm = _BLOCK * means(np.linalg.norm(log.body_rate, axis=1))[:, 0] < _TURNED
    if calm.sum() < _FEWEST:
        return []

    def blocks(values):
        kept = means(values[:, :2])[calm]
        return kept - np.median(kept, axis=0)

    speed, force = blocks(rotation.to_body(q, log.velocity)), blocks(log.specific_force)
    sizes = np.sqrt(np.mean(speed**2, axis=0)), np.sqrt(np.mean(force**2, axis=0))
    matrix = speed.T @ force / len(speed) / np.maximum(np.outer(*sizes), 1e-12)
    found = []
    swapped = max(matrix[0, 1], matrix[1, 0]) < -_CROSSED and np.abs(np.diag(matrix)).max() < 0.5 * _CROSSED
    for axis in range(2):
        own = float(matrix[axis, axis])
        wrong = 1.0 if swapped else 2 * own if own > _PUSHES else 0.0
        slope = own * float(sizes[1][axis] / max(sizes[0][axis], 1e-12))
        moves = bool(sizes[0][axis] > 0.2 and sizes[1][axis] > 0.12)
        found.append(Relation("drag", "xy"[axis], slope, 0.0, own, wrong, moves))
    return found


def agreement(log: FlightLog, source: str) -> dict[tuple[tuple[int, ...], int], float]:
    """Correlation of roll and pitch with the torque of the motors, for every order of the motor columns.

    Args:
        log: the flight.
        source: ``rotor_speed`` or ``command``.

    Returns:
        Mean correlation of both axes, -1 to 1, for each key: the columns of M1 to M4, counted from 0, and the sign of
        the command. Empty without data.
    """
    spectra = motor_spectra(log, source)
    if spectra is None:
        return {}
    cross, power, turning = spectra  # (lags, 4, 2), (4, 4), (2,)
    scores = {}
    for order in itertools.permutations(range(4)):
        parts = []
        for axis in range(2):
            pattern = np.zeros(4)
            pattern[list(order)] = ROLL_PITCH[axis]
            own = float(pattern @ power @ pattern)
            # Motors with equal thrust produce no torque.
            told = own > 1e-6 * float(np.trace(power)) and turning[axis] > 0
            parts.append(cross[:, :, axis] @ pattern / np.sqrt(own * turning[axis]) if told else 0.0 * cross[:, 0, 0])
        both = np.mean(parts, axis=0)
        scores[order, 1], scores[order, -1] = float(both.max()), float(-both.min())
    return scores
