"""Pose and velocity from motion capture that was logged together with the drone's own estimate.

The estimate differs from the true motion. A Crazyflie's estimate rotates some per cent further than its gyro and moves
some per cent faster than its own position, whereas motion capture in the same files rotates as the gyro does
(docs/logs.md has the numbers). For fitting and evaluating models, motion capture is therefore the better reference.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import rotation
from cfb_mjx.logs.flight_log import FlightLog, longest_step
from cfb_mjx.logs.resample import interpolate

POSITION, ATTITUDE = (0.045, 3), (0.025, 2)
"""Half width of the smoothing window, s, and degree of the local polynomial. A Crazyflie's velocity changes within a
tenth of a second, its attitude twice as fast."""
JUMP = 0.1
"""Difference of the rotations by motion capture and gyro, rad, that means confused markers: ten times the noise."""
LATEST, SPAN = 0.03, 0.1
"""Largest lag of motion capture behind the gyro, s, and the span over which the two are compared, s."""
SLOWEST, FEWEST = 0.02, 100
"""Largest interval of the samples, s, and least number of samples."""
UNLIKE = 0.2
"""Unexplained share (as in `consistency.CONTRADICTS`) from which an attitude does not belong to the gyro's body."""
TURNING = 0.03
"""Least rms rotation in `SPAN`, rad, for estimating the markers' axes."""
SLOW = 0.3
"""Least rms horizontal velocity, m/s, for judging an estimate's velocity."""


@dataclasses.dataclass(frozen=True)
class Capture:
    """Samples of motion capture, on the clock of a log.

    Attributes:
        time: (m,) s, increasing.
        position: (m, 3) m, world.
        quaternion: (m, 4) ``[w, x, y, z]``, body to world.
    """

    time: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray

    def only(self, keep: np.ndarray) -> Capture:
        """The samples selected by a mask."""
        return Capture(self.time[keep], self.position[keep], self.quaternion[keep])


def with_pose_of(log: FlightLog, capture: Capture) -> FlightLog:
    """The log with pose and velocity replaced by smoothed motion capture.

    Samples that disagree with the gyro's rotation (confused markers) are left out, and rows without enough samples
    around them are dropped. The attitude is rotated to the gyro's axes, with which the markers are rarely aligned.
    ``observation_delay`` becomes the lag of the samples behind the gyro.

    Args:
        log: the flight, with the drone's own estimate of the pose.
        capture: samples at 50 Hz or more, so that a smoothing window holds enough of them.

    Raises:
        CfbError: too few samples with an attitude, an attitude that does not rotate as the gyro does, or no row left.
    """
    known = np.isfinite(capture.position).all(axis=1) & np.isfinite(capture.quaternion).all(axis=1)
    known &= np.abs(np.linalg.norm(capture.quaternion, axis=1) - 1) < 0.05
    good = capture.only(known)
    if len(good.time) < FEWEST or np.median(np.diff(good.time)) > SLOWEST:
        raise CfbError(
            f"{log.name}: motion capture has {len(good.time)} samples with an attitude, and {FEWEST} at 50 Hz are "
            "needed; leave out --motion-capture to take the estimate."
        )
    good = dataclasses.replace(good, quaternion=rotation.tidy(good.quaternion))
    turned = turned_by_gyro(log)
    late = delay_behind(log, turned, good)
    keep = _believed(log, _offsets(log, turned, good, late), good.time)
    good = good.only(keep)
    axes = marker_axes(log, turned, good, late)
    good = dataclasses.replace(good, quaternion=rotation.multiply(good.quaternion, axes))
    gyro, seen = turns(log, turned, good, late, SPAN)
    if np.sum((seen - gyro) ** 2) > UNLIKE * np.sum(gyro**2 + seen**2) / 2 and _rms(gyro) > TURNING:
        raise CfbError(
            f"{log.name}: the attitude by motion capture does not turn as the gyro does, so it is not the attitude of "
            "the drone; leave out --motion-capture to take the estimate."
        )
    (position, velocity), placed = _smoothed(good.time, good.position, log.time, *POSITION)
    (quaternion, _), faced = _smoothed(good.time, good.quaternion, log.time, *ATTITUDE)
    rows = placed & faced
    if not rows.any():
        raise CfbError(
            f"{log.name}: motion capture covers no row of the log; leave out --motion-capture to take the estimate."
        )
    quaternion[~rows] = [1.0, 0.0, 0.0, 0.0]
    found = log.replace(position=position, velocity=velocity, quaternion=rotation.tidy(quaternion)).rows(rows)
    lost = f", {int((~rows).sum())} rows of the log have none" if not rows.all() else ""
    blind = f", {int((~known).sum())} without an attitude" if not known.all() else ""
    wrong = f", {int((~keep).sum())} that turn differently from the gyro left out" if not keep.all() else ""
    sits = ", ".join(f"{x + 0.0:.1f}" for x in np.rad2deg(rotation.rotation_vector(axes)).round(1))
    said = (
        f"pose and velocity by motion capture: {len(capture.time)} samples{blind}{wrong}{lost}; smoothed over "
        f"{2e3 * POSITION[0]:.0f} ms (attitude {2e3 * ATTITUDE[0]:.0f} ms), {1e3 * late:.1f} ms behind the gyro, "
        f"its axes turned by {sits} deg against the gyro's."
    )
    notes = [*(log.metadata.get("notes") or ()), said]
    return found.replace(metadata={"observation_delay": late, "notes": notes})


def compared(estimate: FlightLog, captured: FlightLog) -> str | None:
    """One sentence with the ratios of the estimate's tilt and velocity to motion capture's; None if they agree."""
    rows = np.searchsorted(estimate.time, captured.time)
    speed, true_speed = estimate.velocity[rows, :2], captured.velocity[:, :2]
    if _rms(true_speed) < SLOW:
        return None
    pairs = (lean(estimate.quaternion[rows]), lean(captured.quaternion)), (speed, true_speed)
    further, faster = (float(np.sum(a * b) / np.sum(b * b)) for a, b in pairs)
    if abs(further - 1) < 0.02 and abs(faster - 1) < 0.02:
        return None
    return (
        f"the file also holds motion capture; compared with it, the estimate leans {further:.2f} times as far and "
        f"moves {faster:.2f} times as fast over ground: --motion-capture takes pose and velocity from motion capture."
    )


def lean(quaternion: np.ndarray) -> np.ndarray:
    """Tilt (n, 2), rad: components along body x and y of the angle between body z and the vertical."""
    up = rotation.to_body(rotation.tidy(quaternion), np.array([0.0, 0.0, 1.0]))
    across = np.linalg.norm(up[:, :2], axis=1)
    return up[:, :2] * (np.arctan2(across, up[:, 2]) / np.maximum(across, 1e-9))[:, None]


def turned_by_gyro(log: FlightLog) -> np.ndarray:
    """Integrated gyro: quaternions (n, 4) of the rotation since the first row."""
    steps = np.diff(log.time)[:, None]
    middle = 0.5 * (log.body_rate[1:] + log.body_rate[:-1])
    steps = rotation.exponential(middle * np.where(steps > log.gap_threshold, 0.0, steps))
    whole, span = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], steps]), 1
    while span < len(whole):  # Cumulative product by doubling the span.
        whole[span:] = rotation.multiply(whole[:-span], whole[span:])
        span *= 2
    return rotation.tidy(whole)


def _offsets(log: FlightLog, turned: np.ndarray, capture: Capture, late: float) -> np.ndarray:
    """Attitude by motion capture relative to the integrated gyro, (m, 4). It drifts, but does not jump."""
    own = rotation.tidy(interpolate(log.time, turned, capture.time - late))
    return rotation.multiply(capture.quaternion, rotation.conjugate(own))


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1)))) if len(vectors) else 0.0


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between attitudes, rad."""
    return np.linalg.norm(rotation.rotation_vector(rotation.multiply(rotation.conjugate(a), b)), axis=-1)


def delay_behind(log: FlightLog, turned: np.ndarray, capture: Capture) -> float:
    """Lag of the samples, s: the one at which their rotation agrees best with the gyro, to half a millisecond."""

    span = max(1, round(SPAN / float(np.median(np.diff(capture.time)))))

    def unlike(late: float) -> float:
        apart = _offsets(log, turned, capture, late)
        size = np.sort(_between(apart[:-span], apart[span:]))
        # Ignore the largest differences, which may come from confused markers.
        return float(np.sum(size[: int(0.8 * len(size))] ** 2))

    lags = np.arange(0.0, LATEST + 1e-9, 0.0005)
    return float(lags[np.argmin([unlike(lag) for lag in lags])])


def turns(
    log: FlightLog, turned: np.ndarray, capture: Capture, late: float, span: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors (k, 3), rad, over spans: by the gyro and by motion capture, each in its own body axes."""
    first = np.arange(len(capture.time))
    last = np.searchsorted(capture.time, capture.time + span)
    first, last = first[last < len(first)], last[last < len(first)]
    # Leave out spans with a gap of the log or of the capture.
    away = np.concatenate([[0], np.cumsum(np.diff(log.time) > log.gap_threshold)])
    there = np.searchsorted(log.time, capture.time - late).clip(0, len(log.time) - 1)
    whole = (away[there[first]] == away[there[last]]) & (capture.time[last] - capture.time[first] < 1.2 * span)
    first, last = first[whole], last[whole]
    own = rotation.tidy(interpolate(log.time, turned, capture.time - late))

    def between(q: np.ndarray) -> np.ndarray:
        return rotation.rotation_vector(rotation.multiply(rotation.conjugate(q[first]), q[last]))

    return between(own), between(capture.quaternion)


def marker_axes(log: FlightLog, turned: np.ndarray, capture: Capture, late: float) -> np.ndarray:
    """Attitude (4,) of the gyro's axes in the markers' axes, from the rotations of both.

    The identity if they hardly rotate.
    """
    from scipy.spatial.transform import Rotation

    gyro, seen = turns(log, turned, capture, late, SPAN)
    if len(gyro) < 50 or _rms(gyro) < TURNING:
        return np.array([1.0, 0.0, 0.0, 0.0])
    off = np.sum((seen - gyro) ** 2, axis=1)
    usual = off <= np.quantile(off, 0.9)
    u, _, v = np.linalg.svd(seen[usual].T @ gyro[usual])
    matrix = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    x, y, z, w = Rotation.from_matrix(matrix).as_quat()
    return rotation.tidy(np.array([[w, x, y, z]]))[0]


def _believed(log: FlightLog, offsets: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Mask of the samples without confused markers.

    The samples are divided at jumps relative to the gyro. The longest piece is kept, and every piece that continues a
    kept one without a jump.
    """
    gaps = log.time[log.gaps()]
    # The rotation in a gap of the log is unknown, so a difference across it is not a jump.
    across = np.searchsorted(gaps, time[1:]) > np.searchsorted(gaps, time[:-1])
    jumps = (_between(offsets[:-1], offsets[1:]) > JUMP) & ~across
    piece = np.concatenate([[0], np.cumsum(jumps)])
    keep = piece == np.argmax(np.bincount(piece))
    for order in (range(piece[-1] + 1), range(piece[-1], -1, -1)):
        last = None
        for number in order:
            mine = np.flatnonzero(piece == number)
            first, end = (mine[0], mine[-1]) if order.step > 0 else (mine[-1], mine[0])
            if last is not None and _between(offsets[last], offsets[first]) < JUMP:
                keep[mine] = True
            if keep[mine[0]]:
                last = end
    return keep


def _smoothed(time: np.ndarray, values: np.ndarray, rows: np.ndarray, half: float, degree: int):
    """Value and slope at each row of a local least-squares polynomial, and the mask of rows with enough samples."""
    first, last = np.searchsorted(time, rows - half), np.searchsorted(time, rows + half)
    most = int(np.max(last - first, initial=1))
    index = first[:, None] + np.arange(most)
    counts = index < last[:, None]
    index = np.minimum(index, len(time) - 1)
    away = np.where(counts, (time[index] - rows[:, None]) / half, 0.0)
    # Samples on both sides, no gap between them, and at least two more than the degree of the polynomial.
    reach = longest_step(float(np.median(np.diff(time)))) / half
    before, after = (np.min(np.where(counts & side, np.abs(away), np.inf), axis=1) for side in (away <= 0, away >= 0))
    enough = (counts.sum(axis=1) > degree + 1) & (before + after < reach)
    powers = np.where(counts[..., None], away[..., None] ** np.arange(degree + 1), 0.0)
    normal = np.swapaxes(powers, 1, 2) @ powers + 1e-9 * np.eye(degree + 1)
    found = np.linalg.solve(normal, np.swapaxes(powers, 1, 2) @ values[index])
    return (found[:, 0], found[:, 1] / half), enough
