"""Where the drone was, by motion capture that was logged beside the estimate it flew by.

An estimate is not where the drone was. A Crazyflie's own turns some per cent further than its gyro and moves some per
cent faster than its own position, where motion capture in the same files turns as the gyro does (docs/logs.md has the
numbers). What a model is judged by, or fitted to, is better taken from there.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import rotation
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.gaps import longest_step
from cfb_mjx.logs.resample import interpolate

POSITION, ATTITUDE = (0.045, 3), (0.025, 2)
"""Half a span, s, over which a polynomial of this degree smooths the samples: a tenth of a second is how fast a
Crazyflie's velocity changes, and an attitude changes twice as fast."""
JUMP = 0.1
"""rad by which two samples turn otherwise than the gyro where markers were taken for others: ten times their noise."""
LATEST, SPAN = 0.03, 0.1
"""How late motion capture may be behind the gyro, s, and the span over which the two are compared, s."""
SLOWEST, FEWEST = 0.02, 100
"""Interval of the samples, s, and their number."""
UNLIKE = 0.2
"""Unexplained share (as in `consistency.CONTRADICTS`) from which an attitude is not that of the gyro's body."""
TURNING = 0.03
"""rad in `SPAN`, rms: what turns less does not tell where the markers' axes are."""
SLOW = 0.3
"""m/s: slower motion says little about how much too fast an estimate is."""


@dataclasses.dataclass(frozen=True)
class Capture:
    """Samples of motion capture, on a log's clock.

    Attributes:
        time: (m,) s, increasing.
        position: (m, 3) m.
        quaternion: (m, 4) scalar first.
    """

    time: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray

    def only(self, keep: np.ndarray) -> Capture:
        """Some of the samples."""
        return Capture(self.time[keep], self.position[keep], self.quaternion[keep])


def with_pose_of(log: FlightLog, capture: Capture) -> FlightLog:
    """The log with pose and velocity by motion capture, smoothed; rows without enough samples about them go.

    Samples that turn otherwise than the gyro (markers taken for others) are left out. The attitude is made that of
    the gyro's axes, which markers seldom share. ``observation_delay`` becomes how late the samples are behind the gyro.

    Args:
        log: with the drone's own pose.
        capture: at least 50 Hz, so that a span of smoothing holds enough.

    Raises:
        CfbError: too few samples with an attitude, an attitude that does not turn as the gyro, or no row left.
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
            f"{log.name}: the attitude by motion capture does not turn as the gyro does, so it is no attitude of the "
            "drone; leave out --motion-capture to take the estimate."
        )
    (position, velocity), placed = _smoothed(good.time, good.position, log.time, *POSITION)
    (quaternion, _), faced = _smoothed(good.time, good.quaternion, log.time, *ATTITUDE)
    rows = placed & faced
    if not rows.any():
        raise CfbError(f"{log.name}: motion capture covers no row of the log; take the estimate.")
    quaternion[~rows] = [1.0, 0.0, 0.0, 0.0]
    found = log.replace(position=position, velocity=velocity, quaternion=rotation.tidy(quaternion)).rows(rows)
    lost = f", {int((~rows).sum())} rows of the log have none" if not rows.all() else ""
    blind = f", {int((~known).sum())} without an attitude" if not known.all() else ""
    wrong = f", {int((~keep).sum())} that turn otherwise than the gyro left out" if not keep.all() else ""
    sits = ", ".join(f"{x + 0.0:.1f}" for x in np.rad2deg(rotation.rotation_vector(axes)).round(1))
    said = (
        f"pose and velocity by motion capture: {len(capture.time)} samples{blind}{wrong}{lost}; smoothed over "
        f"{2e3 * POSITION[0]:.0f} ms (attitude {2e3 * ATTITUDE[0]:.0f} ms), {1e3 * late:.1f} ms behind the gyro, "
        f"its axes turned by {sits} deg against the gyro's."
    )
    notes = [*(log.metadata.get("notes") or ()), said]
    return found.replace(metadata={"observation_delay": late, "notes": notes})


def compared(estimate: FlightLog, captured: FlightLog) -> str | None:
    """In a sentence how far an estimate leans and how fast it moves beside motion capture; None where they agree."""
    rows = np.searchsorted(estimate.time, captured.time)
    speed, true_speed = estimate.velocity[rows, :2], captured.velocity[:, :2]
    if _rms(true_speed) < SLOW:
        return None
    pairs = (lean(estimate.quaternion[rows]), lean(captured.quaternion)), (speed, true_speed)
    further, faster = (float(np.sum(a * b) / np.sum(b * b)) for a, b in pairs)
    if abs(further - 1) < 0.02 and abs(faster - 1) < 0.02:
        return None
    return (
        f"the file holds motion capture too, and beside it the estimate leans {further:.2f} times as far and moves "
        f"{faster:.2f} times as fast over ground: --motion-capture takes pose and velocity from there."
    )


def lean(quaternion: np.ndarray) -> np.ndarray:
    """(n, 2) angle between body z and up, rad, towards body x and y."""
    up = rotation.to_body(rotation.tidy(quaternion), np.array([0.0, 0.0, 1.0]))
    across = np.linalg.norm(up[:, :2], axis=1)
    return up[:, :2] * (np.arctan2(across, up[:, 2]) / np.maximum(across, 1e-9))[:, None]


def turned_by_gyro(log: FlightLog) -> np.ndarray:
    """(n, 4) how the gyro says the drone turned since the first row."""
    steps = np.diff(log.time)[:, None]
    middle = 0.5 * (log.body_rate[1:] + log.body_rate[:-1])
    steps = rotation.exponential(middle * np.where(steps > log.gap_threshold, 0.0, steps))
    whole, span = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], steps]), 1
    while span < len(whole):  # Products of all before each row, by twice as many at a time.
        whole[span:] = rotation.multiply(whole[:-span], whole[span:])
        span *= 2
    return rotation.tidy(whole)


def _offsets(log: FlightLog, turned: np.ndarray, capture: Capture, late: float) -> np.ndarray:
    """(m, 4) attitude by motion capture over that by the gyro, which drifts but never jumps."""
    own = rotation.tidy(interpolate(log.time, turned, capture.time - late))
    return rotation.multiply(capture.quaternion, rotation.conjugate(own))


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1)))) if len(vectors) else 0.0


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between attitudes, rad."""
    return np.linalg.norm(rotation.rotation_vector(rotation.multiply(rotation.conjugate(a), b)), axis=-1)


def delay_behind(log: FlightLog, turned: np.ndarray, capture: Capture) -> float:
    """How late the samples are, s: where they turn most as the gyro does, to half a millisecond."""

    span = max(1, round(SPAN / float(np.median(np.diff(capture.time)))))

    def unlike(late: float) -> float:
        apart = _offsets(log, turned, capture, late)
        size = np.sort(_between(apart[:-span], apart[span:]))
        # A few are of markers taken for others.
        return float(np.sum(size[: int(0.8 * len(size))] ** 2))

    lags = np.arange(0.0, LATEST + 1e-9, 0.0005)
    return float(lags[np.argmin([unlike(lag) for lag in lags])])


def turns(
    log: FlightLog, turned: np.ndarray, capture: Capture, late: float, span: float
) -> tuple[np.ndarray, np.ndarray]:
    """(k, 3) rotation vectors over spans, rad: by the gyro and by the capture, each in its own body axes."""
    first = np.arange(len(capture.time))
    last = np.searchsorted(capture.time, capture.time + span)
    first, last = first[last < len(first)], last[last < len(first)]
    # Neither a gap of the log nor one of the capture.
    away = np.concatenate([[0], np.cumsum(np.diff(log.time) > log.gap_threshold)])
    there = np.searchsorted(log.time, capture.time - late).clip(0, len(log.time) - 1)
    whole = (away[there[first]] == away[there[last]]) & (capture.time[last] - capture.time[first] < 1.2 * span)
    first, last = first[whole], last[whole]
    own = rotation.tidy(interpolate(log.time, turned, capture.time - late))

    def between(q: np.ndarray) -> np.ndarray:
        return rotation.rotation_vector(rotation.multiply(rotation.conjugate(q[first]), q[last]))

    return between(own), between(capture.quaternion)


def marker_axes(log: FlightLog, turned: np.ndarray, capture: Capture, late: float) -> np.ndarray:
    """(4,) attitude of the gyro's axes in those of the markers, from how both turn; none where they hardly do."""
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
    """Which samples are of the drone as most are: pieces without a jump that stand where the longest one stands."""
    gaps = log.time[log.gaps()]
    # Nothing is known of how the drone turned in a gap of the log.
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
    """Value and slope at each row of the polynomial through the samples about it, and where there are enough."""
    first, last = np.searchsorted(time, rows - half), np.searchsorted(time, rows + half)
    most = int(np.max(last - first, initial=1))
    index = first[:, None] + np.arange(most)
    counts = index < last[:, None]
    index = np.minimum(index, len(time) - 1)
    away = np.where(counts, (time[index] - rows[:, None]) / half, 0.0)
    # Samples on both sides, none further than a gap, and one more than it takes.
    reach = longest_step(float(np.median(np.diff(time)))) / half
    before, after = (np.min(np.where(counts & side, np.abs(away), np.inf), axis=1) for side in (away <= 0, away >= 0))
    enough = (counts.sum(axis=1) > degree + 1) & (before + after < reach)
    powers = np.where(counts[..., None], away[..., None] ** np.arange(degree + 1), 0.0)
    normal = np.swapaxes(powers, 1, 2) @ powers + 1e-9 * np.eye(degree + 1)
    found = np.linalg.solve(normal, np.swapaxes(powers, 1, 2) @ values[index])
    return (found[:, 0], found[:, 1] / half), enough
