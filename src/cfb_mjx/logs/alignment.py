"""Estimate and remove a constant time shift between the motor columns and the gyro.

The angular acceleration caused by the rotor speeds is compared with the derivative of the gyro, in a band above the
bandwidth of the flight controller. Below that bandwidth, feedback makes the motors react to the motion as well as cause
it, which biases the lag and can flip the sign of the correlation. Above it, the motors are mostly the cause.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from cfb_mjx.logs.flight_log import FlightLog, stretches
from cfb_mjx.optional import not_none

BAND_HZ = (5.0, 17.0)
MAX_SHIFT = 0.06  # s; below one period of the band's centre, to exclude the neighbouring correlation peak
_BLOCK = 2.0  # s
_RESAMPLES = 200
# Nominal rotor model of the Crazyflie 2.1 Brushless; only its phase in the band matters. An error of 10 ms in the motor
# time constant shifts the lag by 1 ms.
_TIME_CONSTANT, GAIN = 0.050, 2900.0
_THRUST = (-0.23, 0.562, -0.043, 0.0)
ROLL_PITCH = np.array([[-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, -1.0]])
"""Signs of the torque about x and y of the thrust of M1 to M4."""
_ROLL_PITCH = ROLL_PITCH * (0.0707 / 2) / np.array([[3.3e-5], [3.6e-5]])


@dataclasses.dataclass(frozen=True)
class AlignmentEstimate:
    """Lag of the measured motion behind the motor columns.

    Attributes:
        shift_s: delay, s, that the motor columns (command and rotor speed) need; negative: they must be advanced.
        std_s: standard deviation of ``shift_s`` from a bootstrap over blocks of the flight, s; infinite without data.
        correlation: correlation of predicted and measured angular acceleration in the band at that shift, 0 to 1.
        gain: ratio of measured to predicted angular acceleration in the band (1 for nominal inertia and thrust).
        method: which column predicted the torque, ``rotor_speed`` or ``command``.
        band_hz: the band used, Hz.
        blocks: number of half-overlapping blocks used.
    """

    shift_s: float
    std_s: float
    correlation: float
    gain: float
    method: str
    band_hz: tuple[float, float]
    blocks: int

    @property
    def reliable(self) -> bool:
        """Whether the flight excites the band enough for the estimate to be used."""
        return self.correlation > 0.4 and self.std_s < 0.004

    def report(self) -> dict:
        """The estimate as JSON-compatible values, in milliseconds."""
        return {
            "shift_ms": self.shift_s * 1e3,
            "shift_std_ms": self.std_s * 1e3 if np.isfinite(self.std_s) else None,  # JSON has no infinity
            "correlation": self.correlation,
            "method": self.method,
            "band_hz": list(self.band_hz),
            "blocks": self.blocks,
            "reliable": self.reliable,
        }


def estimate_command_shift(
    log: FlightLog, method: str | None = None, band_hz: tuple[float, float] = BAND_HZ, seed: int = 0
) -> AlignmentEstimate:
    """Estimate the delay that aligns the motor columns with the gyro.

    Args:
        log: the flight. Sampling may be irregular; nothing is computed across gaps.
        method: ``rotor_speed``, or ``command`` (through a first-order motor of 50 ms). None uses rotor speeds if most
            of them were measured, else commands.
        band_hz: band of the comparison, Hz. Its lower edge should be above the bandwidth of the flight controller.
        seed: seed of the bootstrap.

    Returns:
        The estimate. With too little data its shift is 0 and its standard deviation infinite.

    Raises:
        ValueError: ``method`` is neither of the two.
    """
    if method is None:
        measured = log.rotor_speed is not None and np.isfinite(log.rotor_speed).all(axis=1).mean() > 0.5
        method = "rotor_speed" if measured else "command"
    if method == "rotor_speed":
        measured_speed = not_none(log.rotor_speed)
        valid = ~np.isnan(measured_speed).any(axis=1)
        times, speeds, gyro = log.time[valid], measured_speed[valid], log.body_rate[valid]
    elif method == "command":
        times, speeds, gyro = log.time, nominal_speeds(log), log.body_rate
    else:
        raise ValueError(f"method must be 'rotor_speed' or 'command', not {method!r}")
    s = speeds / GAIN
    predicted = np.polyval(_THRUST, s) @ _ROLL_PITCH.T
    blocks = _spectra(times, predicted, gyro[:, :2], log, band_hz)
    if blocks is None:
        return AlignmentEstimate(0.0, float("inf"), 0.0, 0.0, method, band_hz, 0)
    low, high = band_hz
    frequency, cross, power_x, power_y = blocks
    lags = np.arange(-MAX_SHIFT, MAX_SHIFT + 5e-4, 1e-3)
    steer = np.exp(2j * np.pi * np.outer(frequency, lags))
    total = cross.sum(axis=0)
    shift, peak = _peak(lags, np.real(total @ steer)[None])
    # Neighbouring blocks overlap by half. Drawing them in pairs avoids an underestimated standard deviation.
    pairs = np.add.reduceat(cross, np.arange(0, len(cross), 2))
    draws = np.random.default_rng(seed).multinomial(len(pairs), np.full(len(pairs), 1 / len(pairs)), size=_RESAMPLES)
    resampled, _ = _peak(lags, np.real((draws @ pairs) @ steer))
    std = float(np.std(resampled)) if len(pairs) >= 4 else float("inf")
    correlation = float(peak[0] / np.sqrt(power_x * power_y)) if power_x * power_y > 0 else 0.0
    gain = float(peak[0] / power_x) if power_x > 0 else 0.0
    return AlignmentEstimate(float(shift[0]), std, correlation, gain, method, (low, high), len(cross))


def apply_shift(log: FlightLog, shift: float) -> FlightLog:
    """Delay the motor columns (command and rotor speed) by ``shift`` s.

    Commands are held: a row gets the command that was active ``shift`` earlier. Rotor speeds are interpolated linearly.
    A row whose motor data would come from a gap or from outside the log is dropped.
    """
    if shift == 0.0:
        return log
    t, source = log.time, log.time - shift
    slack = 0.01 * log.nominal_interval  # keeps rounding from moving a shift of whole samples to the sample before
    before = np.searchsorted(t, source + slack, side="right") - 1
    inside = (before >= 0) & (source <= t[-1] + slack)
    before = np.clip(before, 0, len(t) - 1)
    after = np.minimum(before + 1, len(t) - 1)
    in_gap = (t[after] - t[before] > log.gap_threshold) & (source - t[before] > log.nominal_interval + slack)
    weight = np.clip((source - t[before]) / np.where(after > before, t[after] - t[before], 1.0), 0.0, 1.0)[:, None]
    speed = log.rotor_speed
    if speed is not None:
        mixed = (1 - weight) * speed[before] + weight * speed[after]
        speed = np.where(weight * (t[after] - t[before])[:, None] <= slack, speed[before], mixed)
    return log.replace(command=log.command[before], rotor_speed=speed).rows(inside & ~in_gap)


def delay_by_samples(log: FlightLog, samples: int) -> FlightLog:
    """Delay the motor columns by a whole number of rows, without interpolation; the end rows are repeated."""
    source = np.clip(np.arange(len(log)) - samples, 0, len(log) - 1)
    speed = log.rotor_speed
    return log.replace(command=log.command[source], rotor_speed=None if speed is None else speed[source])


def nominal_speeds(log: FlightLog) -> np.ndarray:
    """Rotor speeds (n, 4), rad/s, of the nominal first-order motor driven by the commands (held between rows)."""
    decay = np.exp(-np.diff(log.time) / _TIME_CONSTANT)
    target = GAIN * log.command
    speed = target.copy()
    for k, keep in enumerate(decay):
        speed[k + 1] = target[k] + (speed[k] - target[k]) * keep
    return speed


def nominal_command(time: np.ndarray, rotor_speed: np.ndarray) -> np.ndarray:
    """Commands (n, 4) for which the nominal first-order motor (50 ms) gives these rotor speeds (n, 4), rad/s.

    Because of noise in the speeds, they may lie outside [0, 1].
    """
    slope = np.gradient(rotor_speed, time, axis=0) if len(time) > 1 else np.zeros_like(rotor_speed)
    return (rotor_speed + _TIME_CONSTANT * slope) / GAIN


def nominal_thrust(rotor_speed: np.ndarray) -> np.ndarray:
    """Thrust, N, of each rotor at a speed, rad/s, by the nominal thrust curve."""
    return np.polyval(_THRUST, rotor_speed / GAIN)


def _spectra(t, predicted, gyro, log, band_hz):
    """Cross spectra of predicted and measured angular acceleration per block, summed over roll and pitch.

    Returns:
        Frequency (f,) Hz, cross spectra (blocks, f), and the total power of both signals in the band. None without
        data.
    """
    interval = log.nominal_interval
    if interval <= 0.0 or 0.4 / interval < band_hz[1]:
        return None
    size = round(_BLOCK / interval)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(t) > log.gap_threshold) + 1, [len(t)]])
    window = np.hanning(size)[:, None]
    frequency = np.fft.rfftfreq(size, interval)
    band = (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    frequency = frequency[band]
    cross, power_x, power_y = [], 0.0, 0.0
    for a, b in itertools.pairwise(edges):
        if b - a < 2 or t[b - 1] - t[a] < (size - 1) * interval * 0.999:
            continue
        grid = t[a] + interval * np.arange(int((t[b - 1] - t[a]) / interval + 1e-3) + 1)
        x, y = ([np.interp(grid, t[a:b], v[a:b, i]) for i in range(2)] for v in (predicted, gyro))
        x, y = np.stack(x, axis=1), np.stack(y, axis=1)
        for start in range(0, len(grid) - size + 1, size // 2):
            pieces = (v[start : start + size] for v in (x, y))
            fx, fy = (np.fft.rfft((p - p.mean(axis=0)) * window, axis=0)[band] for p in pieces)
            fy = fy * (2j * np.pi * frequency)[:, None]
            cross.append(np.sum(np.conj(fx) * fy, axis=1))
            power_x += float(np.sum(np.abs(fx) ** 2))
            power_y += float(np.sum(np.abs(fy) ** 2))
    return (frequency, np.array(cross), power_x, power_y) if cross else None


def _peak(lags: np.ndarray, correlation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lag and value of the maximum of each row, refined by a parabola through three points."""
    k = np.clip(np.argmax(correlation, axis=1), 1, len(lags) - 2)
    rows = np.arange(len(k))
    left, middle, right = (correlation[rows, k + i] for i in (-1, 0, 1))
    bend = left - 2 * middle + right
    offset = np.clip(np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1.0), 0.0), -1.0, 1.0)
    return lags[k] + offset * (lags[1] - lags[0]), middle - 0.25 * (left - right) * offset


WIDE_BAND_HZ = (2.0, 17.0)
_LAGS = np.arange(-0.03, 0.0601, 0.002)


def motor_spectra(log: FlightLog, source: str) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Correlations of each motor's thrust with roll and pitch acceleration, in a band of 2 to 17 Hz.

    Args:
        log: the flight.
        source: ``rotor_speed``, or ``command`` through a first-order motor of 50 ms.

    Returns:
        Cross-correlation of each motor's nominal thrust with the roll and pitch acceleration for lags of -30 to 60 ms,
        (lags, 4, 2); correlation of the motors with each other, (4, 4); power of the two accelerations, (2,). None
        without data.
    """
    step = log.nominal_interval
    low, high = WIDE_BAND_HZ[0], min(WIDE_BAND_HZ[1], 0.4 / step) if step > 0 else 0.0
    if high < 2 * low:
        return None
    if source == "rotor_speed":
        if log.rotor_speed is None:
            return None
        known = np.isfinite(log.rotor_speed).all(axis=1)
        time, speed, gyro = log.time[known], log.rotor_speed[known], log.body_rate[known, :2]
    else:
        time, speed, gyro = log.time, nominal_speeds(log), log.body_rate[:, :2]
    thrust = np.polyval(_THRUST, speed / GAIN)
    size = max(8, round(_BLOCK / 2 / step))
    window = np.hanning(size)[:, None]
    frequency = np.fft.rfftfreq(size, step)
    band = (frequency >= low) & (frequency <= high)
    pieces = []
    for part in stretches(time, log.gap_threshold):
        if part.stop - part.start < size or time[part][-1] - time[part][0] < size * step:
            continue
        grid = np.arange(time[part][0], time[part][-1], step)
        both = [np.stack([np.interp(grid, time[part], v) for v in values[part].T], 1) for values in (thrust, gyro)]
        for start in range(0, len(grid) - size + 1, size // 2):
            cut = [values[start : start + size] for values in both]
            x, y = (np.fft.rfft((c - c.mean(axis=0)) * window, axis=0)[band] for c in cut)
            pieces.append((x, y * (2j * np.pi * frequency[band])[:, None]))
    if not pieces:
        return None
    x, y = (np.stack(values) for values in zip(*pieces, strict=True))
    steer = np.exp(2j * np.pi * np.outer(_LAGS, frequency[band]))
    cross = np.einsum("lf,fij->lij", steer, np.einsum("bfi,bfj->fij", np.conj(x), y)).real
    power = np.einsum("bfi,bfk->ik", np.conj(x), x).real
    return cross, power, np.sum(np.abs(y) ** 2, axis=(0, 1))


def describe_alignment(alignment: dict | None) -> str:
    """One line about the shift between motor columns and gyro, from the log's ``alignment`` metadata."""
    if not alignment:
        return "motor columns against gyro: not estimated"
    if "shift_ms" not in alignment:
        return f"motor columns delayed by {alignment.get('applied_ms', 0.0):.1f} ms as asked"
    if not alignment.get("reliable", True):
        return "motor columns against gyro: too little excitation to estimate their shift"
    text = f"motor columns lead the gyro by {alignment['shift_ms']:.1f} +- {alignment['shift_std_ms']:.1f} ms"
    if alignment.get("applied"):
        return f"{text}; delayed by {alignment['applied_ms']:.1f} ms"
    return text
