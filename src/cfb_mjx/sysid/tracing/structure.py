"""Structure of residuals: how much of their variance depends on a signal, and the noise floor of the sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.rotation import to_body
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.evaluation import Evaluation, LogEvaluation
from cfb_mjx.sysid.identification.flight_data import white_noise
from cfb_mjx.sysid.metrics import QUANTITIES
from cfb_mjx.sysid.tracing.innovations import Levels
from cfb_mjx.sysid.tracing.residuals import Residuals

BLOCK = 2.0
"""Length of a cross-validation block, s; neighbouring rows are not independent."""
BINS, FOLDS = 8, 5
PREDICTION_BINS = 4
"""Number of bins of a signal if there is only one value per window."""
OFFSET = "offset"
"""Stands for the residual's mean in place of a signal."""


@dataclass(frozen=True)
class Pooled:
    """Concatenated rows of several flights.

    Attributes:
        axes: residual axes (N,) by name; NaN where not measured.
        units: of the axes.
        drivers: candidate signals (N,) by name; NaN where not measured.
        block: (N,) number of the block of `BLOCK` seconds to which a row belongs.
    """

    axes: dict[str, np.ndarray]
    units: dict[str, str]
    drivers: dict[str, np.ndarray]
    block: np.ndarray


def pool(rows: list[Residuals]) -> Pooled:
    """Concatenate the valid rows of all flights."""
    parts, first = [], 0
    for flight in rows:
        own = np.floor((flight.time - flight.time[0]) / BLOCK).astype(int)
        parts.append(first + own[flight.valid])
        first += own[-1] + 1
    named = [flight.axes() for flight in rows]
    units = {key: unit for key, (_, unit) in named[0].items()}
    axes = {key: np.concatenate([n[key][0][f.valid] for n, f in zip(named, rows, strict=True)]) for key in units}
    drivers = {key: np.concatenate([f.drivers[key][f.valid] for f in rows]) for key in rows[0].drivers}
    return Pooled(axes, units, drivers, np.concatenate(parts))


@dataclass(frozen=True)
class Binned:
    """Means of a residual in bins of a signal; arrays (bins,).

    Attributes:
        center: mean of the signal in the bin.
        mean: mean of the residual in the bin.
        error: standard error of that mean, from the scatter between blocks.
    """

    center: np.ndarray
    mean: np.ndarray
    error: np.ndarray


def edges_of(signal: np.ndarray, bins: int = BINS) -> np.ndarray:
    """Edges of bins with equal numbers of rows, (bins + 1,), or fewer if values repeat."""
    return np.unique(np.nanquantile(signal, np.linspace(0, 1, bins + 1)))


def binned(residual: np.ndarray, signal: np.ndarray, block: np.ndarray, edges: np.ndarray) -> Binned:
    """Means of a residual (n,) in bins of a signal (n,); bins with data from fewer than three blocks are left out."""
    good = np.isfinite(residual) & np.isfinite(signal)
    residual, signal, block = residual[good], signal[good], block[good]
    which = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, len(edges) - 2)
    out = []
    for index in range(len(edges) - 1):
        here = which == index
        _, where = np.unique(block[here], return_inverse=True)
        count, total = np.bincount(where), np.bincount(where, residual[here])
        if len(count) < 3:
            continue
        mean = total.sum() / count.sum()
        # Standard error of a ratio of sums over blocks of different size.
        error = np.sqrt(np.sum((total - mean * count) ** 2) * len(count) / (len(count) - 1)) / count.sum()
        out.append((signal[here].mean(), mean, error))
    return Binned(*np.array(out).reshape(-1, 3).T)


def explained(
    residual: np.ndarray, signal: np.ndarray | None, block: np.ndarray, bins: int = BINS
) -> tuple[float, float]:
    """Cross-validated share of a residual's mean square that a binned signal explains beyond the residual's mean.

    Args:
        residual: (n,).
        signal: (n,); None: the share that the mean alone explains.
        block: (n,) number of the block of each row.
        bins: number of bins of the signal.

    Returns:
        The share (zero or negative if the signal explains nothing), and the share divided by its standard error, which
        comes from the scatter between blocks.
    """
    good = np.isfinite(residual) & (True if signal is None else np.isfinite(signal))
    y, block = residual[good], block[good]
    numbers, block = np.unique(block, return_inverse=True)
    if len(numbers) < 2 * FOLDS or not np.any(y):
        return 0.0, 0.0
    which, count = np.zeros(len(y), dtype=int), 1
    if signal is not None:
        edges = edges_of(signal[good], bins)
        count = len(edges) - 1
        if count < 2:
            return 0.0, 0.0
        which = np.clip(np.searchsorted(edges, signal[good], side="right") - 1, 0, count - 1)
    fold = block % FOLDS
    cell = fold * count + which
    size = np.bincount(cell, minlength=FOLDS * count).reshape(FOLDS, count)
    total = np.bincount(cell, y, FOLDS * count).reshape(FOLDS, count)
    size, total = size.sum(0) - size, total.sum(0) - total
    mean = (total.sum(1) / np.maximum(size.sum(1), 1))[:, None]
    said = np.where(size > 0, total / np.maximum(size, 1), mean)[fold, which]
    plain = mean[fold, 0] if signal is not None else 0.0
    gain = np.bincount(block, (y - plain) ** 2 - (y - said) ** 2)
    error = np.sqrt(np.sum((gain - gain.mean()) ** 2) * len(gain) / (len(gain) - 1))
    return float(gain.sum() / np.sum(y**2)), float(gain.sum() / max(error, 1e-300))


@dataclass(frozen=True)
class Structure:
    """Table of which residual depends on which signal.

    Attributes:
        axes: names of the residual axes (a).
        signals: names of the signals (s), `OFFSET` first.
        share: (a, s) explained share of each axis's mean square (`explained`); NaN where a column was not measured.
        sigma: (a, s) shares divided by their standard errors.
        rms: (a,) rms of each axis in its unit.
    """

    axes: list[str]
    signals: list[str]
    share: np.ndarray
    sigma: np.ndarray
    rms: np.ndarray

    def __add__(self, other: Structure) -> Structure:
        """Combine the axes of two tables with the same signals."""
        rows = {key: np.concatenate([getattr(self, key), getattr(other, key)]) for key in ("share", "sigma", "rms")}
        return Structure(self.axes + other.axes, self.signals, **rows)

    def strongest(self, count: int, least_share: float = 0.05, least_sigma: float = 3.0) -> list[tuple[int, int]]:
        """Indices (axis, signal) of the largest shares, at most one signal per axis, the largest share first.

        Args:
            count: maximum number of pairs.
            least_share: smallest share to consider.
            least_sigma: smallest ratio of a share to its standard error to consider.
        """
        sure = np.where((self.sigma > least_sigma) & (self.share > least_share), self.share, 0.0)
        best = np.nanargmax(np.nan_to_num(sure), axis=1)
        pairs = [(axis, int(signal)) for axis, signal in enumerate(best) if sure[axis, signal] > 0]
        return sorted(pairs, key=lambda pair: -sure[pair])[:count]


def structure(pooled: Pooled, bins: int = BINS) -> Structure:
    """Explained share of every residual axis by every signal."""
    axes, signals = list(pooled.axes), [OFFSET, *pooled.drivers]
    share, sigma = np.full((2, len(axes), len(signals)), np.nan)
    for i, axis in enumerate(axes):
        y = pooled.axes[axis]
        if not np.isfinite(y).any():
            continue
        for j, name in enumerate(signals):
            signal = pooled.drivers.get(name)
            if signal is None or np.isfinite(signal).any():
                share[i, j], sigma[i, j] = explained(y, signal, pooled.block, bins)
    rms = [np.sqrt(np.nanmean(y**2)) if np.isfinite(y).any() else np.nan for y in pooled.axes.values()]
    return Structure(axes, signals, share, sigma, np.array(rms))


def where_it_shows(less: Pooled, more: Pooled, bins: int = BINS, count: int = 3) -> list[tuple[str, str]]:
    """Residual axes in which two models differ most, each with the signal that best explains the difference.

    Args:
        less: residuals of one model.
        more: residuals of the other model in the same rows.
        bins: number of bins of a signal.
        count: maximum number of axes.
    """
    sizes = {}
    for axis, after in more.axes.items():
        difference = less.axes[axis] - after
        good = np.isfinite(difference)
        if good.any() and np.any(difference[good]):
            sizes[axis] = float(np.mean(difference[good] ** 2) / np.mean(after[good] ** 2))
    ranked = sorted(sizes, key=lambda axis: -sizes[axis])[:count]
    found = []
    for axis in ranked:
        if sizes[axis] < 0.1 * sizes[ranked[0]]:
            continue
        difference = less.axes[axis] - more.axes[axis]
        shares = {name: explained(difference, signal, less.block, bins)[0] for name, signal in less.drivers.items()}
        best = max(shares, key=shares.__getitem__)
        # If no signal explains the difference (a constant, for instance), show it over time.
        found.append((axis, best if shares[best] > 0.1 else "time"))
    return found


def pool_predictions(evaluation: Evaluation, rows: list[Residuals], horizon: float = 0.2) -> Pooled:
    """Prediction errors as pooled residuals: measured minus predicted, one row per window.

    The axes are the velocity, in body axes at the window's start, and the body rate. The signals are averaged over the
    window.

    Args:
        evaluation: of some flights.
        rows: `residual_rows` of the same flights, in the same order.
        horizon: one of the evaluation's horizons, s.
    """
    index = evaluation.horizons.index(horizon)
    found, drivers, blocks, first = [], [], [], 0
    for log, flight in zip(evaluation.logs, rows, strict=True):
        if not len(log.windows):
            continue
        windows, said = log.windows, not_none(log.predictions["commands_in"])
        velocity = to_body(windows.quaternion, windows.true_velocity[:, index] - np.asarray(said.velocity)[:, index])
        rate = windows.true_body_rate[:, index] - np.asarray(said.body_rate)[:, index]
        found.append(np.concatenate([velocity, rate], axis=1))
        begin, end = (np.searchsorted(flight.time, windows.start + t) for t in (0.0, horizon))
        drivers.append({key: _means(x, begin, end) for key, x in flight.drivers.items()})
        blocks.append(first + np.floor((windows.start - windows.start[0]) / BLOCK).astype(int))
        first = blocks[-1][-1] + 1
    errors = np.concatenate(found)
    names = [f"{horizon:g} s velocity {a}" for a in "xyz"] + [f"{horizon:g} s rate {a}" for a in "xyz"]
    units = dict(zip(names, ["m/s"] * 3 + ["rad/s"] * 3, strict=True))
    signals = {key: np.concatenate([d[key] for d in drivers]) for key in drivers[0]}
    return Pooled(dict(zip(names, errors.T, strict=True)), units, signals, np.concatenate(blocks))


def _means(values: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Means of the finite values in rows [begin, end); NaN if there are none."""
    known = np.isfinite(values)
    total = np.concatenate([[0.0], np.cumsum(np.where(known, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(known)])
    size = count[end] - count[begin]
    return np.where(size > 0, (total[end] - total[begin]) / np.maximum(size, 1), np.nan)


def noise_floor(evaluation: Evaluation, levels: Levels | None = None) -> dict[str, float]:
    """Lower bound of the RMS prediction errors, ``<quantity>_rmse_<unit>@<horizon>s``, over all windows of all logs.

    White noise of each column is propagated to first order: an error of the body rate rotates the attitude, an error of
    the attitude tilts the thrust, an error of the velocity moves the position. Commands between two rows and errors
    that an estimator has smoothed are not included.

    Args:
        evaluation: supplies windows and horizons.
        levels: random forces and torques to propagate in addition to the sensors' noise; None: sensors only.
    """
    weights = np.array([len(log.windows) for log in evaluation.logs], dtype=float)
    squares = np.array([_squares(log, evaluation.horizons, levels) for log in evaluation.logs])
    rms = np.sqrt(np.einsum("l,lqh->qh", weights / weights.sum(), squares))
    return {
        f"{quantity}_rmse_{unit}@{horizon:g}s": float(rms[i, k])
        for i, (quantity, unit) in enumerate(QUANTITIES.items())
        for k, horizon in enumerate(evaluation.horizons)
    }


def sensor_levels(log: FlightLog) -> dict[str, np.ndarray]:
    """White noise per row: position (3,) m, velocity (3,) m/s, attitude angle (), rad, gyro (3,) rad/s."""
    # The noise of the three angles is twice that of the quaternion's vector part; the norm has no noise.
    angle = 2 * np.sqrt(np.sum(white_noise(log.quaternion, log.time) ** 2) / 3)
    columns = {"position": log.position, "velocity": log.velocity, "gyro": log.body_rate}
    return {key: white_noise(values, log.time) for key, values in columns.items()} | {"angle": angle}


def _squares(evaluated: LogEvaluation, horizons: tuple[float, ...], levels: Levels | None) -> np.ndarray:
    """Mean squared errors (4, H) of one log, in the order of `QUANTITIES`."""
    log, starts = evaluated.log, evaluated.windows.start
    if not len(starts):
        return np.zeros((4, len(horizons)))
    noise = sensor_levels(log)
    pose, gyro = (_averaging(log.time, starts + late) for late in (evaluated.delay, evaluated.gyro_delay))
    force = float(np.sqrt(np.mean(np.sum(log.specific_force**2, axis=1))))
    out = np.zeros((4, len(horizons)))
    for axis in range(3):
        # A rotation about x or y tilts the thrust sideways; one about z does not move the drone.
        turn = {0: 1, 1: 0, 2: 2}[axis]
        start = [pose * noise["position"][axis] ** 2, pose * noise["velocity"][axis] ** 2]
        start += [pose * noise["angle"] ** 2, gyro * noise["gyro"][turn] ** 2]
        for k, horizon in enumerate(horizons):
            moved = _carried(np.array(start), horizon, force if axis < 2 else 0.0, levels, axis, turn)
            late = _averaging(log.time, starts + evaluated.delay + horizon)
            seen = late * np.array([noise["position"][axis], noise["velocity"][axis], noise["angle"]]) ** 2
            rate = _averaging(log.time, starts + evaluated.gyro_delay + horizon) * noise["gyro"][turn] ** 2
            out[:, k] += (moved + np.array([*seen, rate])) * [1, 1, np.degrees(1.0) ** 2, 1]
    return out


def _averaging(time: np.ndarray, at: np.ndarray) -> float:
    """Mean factor by which interpolation between two rows changes the variance of their noise."""
    row = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    share = np.clip((at - time[row]) / (time[row + 1] - time[row]), 0.0, 1.0)
    return float(np.mean(share**2 + (1 - share) ** 2))


def _carried(start: np.ndarray, horizon: float, force: float, levels: Levels | None, axis: int, turn: int):
    """Variances (4,) of position, velocity, angle and rate along one axis after ``horizon`` seconds.

    Args:
        start: (4,) variances at the start.
        horizon: s.
        force: acceleration per angle, m/s^2.
        levels: random forces and torques; None: none.
        axis: of position and velocity.
        turn: axis of angle and rate.
    """
    from scipy.linalg import expm

    # States: position, velocity, angle, rate, and correlated random acceleration and angular acceleration.
    slope = np.zeros((6, 6))
    slope[0, 1] = slope[2, 3] = slope[1, 4] = slope[3, 5] = 1.0
    slope[1, 2] = force
    first, drive = np.zeros(6), np.zeros(6)
    first[:4] = start
    if levels is not None:
        for index, channel, quantity in ((4, 3 + axis, 1), (5, turn, 3)):
            rate, size = 1 / float(levels.correlation_time[channel]), float(levels.disturbance[channel])
            slope[index, index] = -rate
            first[index], drive[index] = size**2, 2 * rate * size**2
            drive[quantity] = float(levels.walk[channel]) ** 2
    # Van Loan: transition and accumulated covariance from one matrix exponential.
    block = np.block([[-slope, np.diag(drive)], [np.zeros((6, 6)), slope.T]]) * horizon
    both = expm(block)
    transition = both[6:, 6:].T
    return np.diag(transition @ np.diag(first) @ transition.T + transition @ both[:6, 6:])[:4]
