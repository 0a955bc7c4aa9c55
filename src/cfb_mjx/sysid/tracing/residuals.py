"""Residuals of a model along flights in physical units, for plots, with the signals that could explain them.

The search itself uses whitened residuals (`innovations`). Here measurement, model and the candidate signals are
smoothed with the same zero-phase Gaussian filter, so that none lags the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb
from typing import Any, cast

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import lombscargle

from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.logs.rotation import to_body
from cfb_mjx.model import Quadrotor
from cfb_mjx.sysid.flight import Flight, delay_of, prepare_flight
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis
from cfb_mjx.sysid.tracing.rules import RULES
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.signals import Blocks, driven_by, residual_blocks

WIDTH = 0.02
"""Standard deviation of the Gaussian filter, s; about half of the power at 6 Hz passes."""
PATTERNS = {"mean": (1, 1, 1, 1), "roll": (-1, -1, 1, 1), "pitch": (-1, 1, 1, -1), "yaw": (-1, 1, -1, 1)}
"""Combinations of the four rotors (M1 to M4), each divided by four, that produce thrust and the three torques."""
UNITS = {
    **{f"velocity {axis}": "m/s" for axis in "xyz"},
    **{f"rate {axis}": "rad/s" for axis in "xyz"},
    **{f"rotor {name}": "rad/s" for name in PATTERNS},
    **{f"rotor {name} slope": "rad/s^2" for name in PATTERNS},
    "command slope": "1/s",
    "position x": "m",
    "position y": "m",
    "height": "m",
    "heading": "rad",
    "voltage": "V",
    "time": "s",
}
"""Candidate signals and their units, in body axes; rotor speeds as fed to the model; slopes are time derivatives."""


@dataclass(frozen=True)
class Residuals:
    """Residuals (measured minus modelled) of one flight of n rows.

    Attributes:
        name: of the log.
        time: (n,) s.
        angular_acceleration: (n, 3) body axes, rad/s^2; times the inertia, the torque that the model misses.
        specific_force: (n, 3) body axes, m/s^2; times the mass, the force that the model misses.
        world_force: (n, 3) the same in world axes, which shows forces that depend on the position.
        rotor_speed: (n, 4) measured minus modelled from commands alone, rad/s; None if not measured.
        valid: (n,) rows with a meaningful residual.
        drivers: candidate signals (n,) that could explain it, with the names and units of `UNITS`; NaN where not
            measured.
    """

    name: str
    time: np.ndarray
    angular_acceleration: np.ndarray
    specific_force: np.ndarray
    world_force: np.ndarray
    rotor_speed: np.ndarray | None
    valid: np.ndarray
    drivers: dict[str, np.ndarray]

    def axes(self) -> dict[str, tuple[np.ndarray, str]]:
        """Residual axes by name: values (n,) and unit."""
        found = {f"torque {a}": (self.angular_acceleration[:, i], "rad/s^2") for i, a in enumerate("xyz")}
        found |= {f"force {a}": (self.specific_force[:, i], "m/s^2") for i, a in enumerate("xyz")}
        found |= {f"world force {a}": (self.world_force[:, i], "m/s^2") for i, a in enumerate("xy")}
        speed = np.full((len(self.time), 4), np.nan) if self.rotor_speed is None else self.rotor_speed
        return found | {f"rotor M{i + 1}": (speed[:, i], "rad/s") for i in range(4)}

    def rows(self, index: np.ndarray, valid: np.ndarray) -> Residuals:
        """The rows at ``index``; ``valid`` marks those with a meaningful residual."""
        fields = ("time", "angular_acceleration", "specific_force", "world_force")
        return replace(
            self,
            **{field: getattr(self, field)[index] for field in fields},
            rotor_speed=None if self.rotor_speed is None else self.rotor_speed[index],
            valid=valid,
            drivers={key: values[index] for key, values in self.drivers.items()},
        )


def residual_rows(search: Search, hypothesis: Hypothesis) -> list[Residuals]:
    """Residuals of a hypothesis along every flight of a search."""
    flights = search.flights(hypothesis)
    found = search.residuals(hypothesis)
    return [
        _rows(blocks, driven, flight, log.name)
        for log, flight, (blocks, driven) in zip(search.logs, flights, found, strict=True)
    ]


def model_residuals(model: Quadrotor, log: FlightLog, delay: float | None = None) -> tuple[Residuals, np.ndarray]:
    """Residuals of a model along one flight, and the rotor speeds (n, 4), rad/s, that drove the model.

    Args:
        model: the drone.
        log: the flight.
        delay: age of pose and velocity in its rows, s; by default the value in the log or, failing that, the model's.
    """
    delay = delay_of(log, model.parameters) if delay is None else delay
    flight = prepare_flight(log, delay, float(model.parameters.gyro_delay))
    (driven,) = driven_by(model, [flight], 0.0)
    (blocks,) = residual_blocks(model, [flight], [driven], 0.0)
    return _rows(blocks, driven, flight, log.name), driven[: len(log)]


def _rows(blocks: Blocks, driven: np.ndarray, flight: Flight, name: str) -> Residuals:
    # Undo the division into blocks and the padding.
    n = int(np.sum(np.asarray(flight.interval) > 0)) + 1
    quantity = np.asarray(blocks.signals.quantity).reshape(-1, 10)[:n]
    world = np.asarray(blocks.signals.acceleration).reshape(-1, 3)[:n]
    at = {key: np.asarray(getattr(flight, key))[:n] for key in ("time", "velocity", "quaternion", "body_rate")}
    smooth = Smoother(at["time"], np.asarray(flight.valid)[:n] > 0)
    speed = np.asarray(driven)[:n]
    body = to_body(at["quaternion"], at["velocity"])
    drivers = {f"velocity {axis}": smooth(body[:, i]) for i, axis in enumerate("xyz")}
    drivers |= {f"rate {axis}": smooth(at["body_rate"][:, i]) for i, axis in enumerate("xyz")}
    patterns = {key: speed @ np.array(signs) / 4 for key, signs in PATTERNS.items()}
    drivers |= {f"rotor {key}": smooth(value) for key, value in patterns.items()}
    drivers |= {f"rotor {key} slope": smooth(value, 1) for key, value in patterns.items()}
    drivers["command slope"] = smooth(np.asarray(flight.command)[:n].mean(axis=1), 1)
    position = smooth(np.asarray(flight.position)[:n])
    drivers |= {key: position[:, i] for i, key in enumerate(("position x", "position y", "height"))}
    drivers["heading"] = _heading(at["quaternion"])
    drivers["voltage"] = np.asarray(flight.voltage)[:n]
    drivers["time"] = at["time"]
    return Residuals(
        name,
        at["time"],
        smooth(quantity[:, :3], 1),
        smooth(to_body(at["quaternion"], world)),
        smooth(world),
        smooth(quantity[:, 6:]) if float(flight.measured) else None,
        smooth.inside,
        drivers,
    )


def _heading(quaternion: np.ndarray) -> np.ndarray:
    """Yaw angle (n,), rad, from -pi to pi."""
    w, x, y, z = quaternion.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


class Smoother:
    """Gaussian filter along one flight that never reaches across a gap.

    Attributes:
        inside: (n,) rows far enough from both ends of their gap-free stretch for the filter to be valid.
    """

    def __init__(self, time: np.ndarray, valid: np.ndarray, width: float = WIDTH):
        self.time, self.width = time, width
        edges = np.flatnonzero(np.diff(np.concatenate([[0], valid.astype(int), [0]])))
        # In shorter stretches no row is far enough from the ends.
        self.stretches = [slice(a, b) for a, b in edges.reshape(-1, 2) if time[b - 1] - time[a] > 6 * width]
        self.inside = np.zeros(len(time), dtype=bool)
        for stretch in self.stretches:
            t = time[stretch]
            self.inside[stretch] = (t >= t[0] + 2 * width) & (t <= t[-1] - 2 * width)

    def __call__(self, values: np.ndarray, order: int = 0) -> np.ndarray:
        """Smoothed values (n, ...), or their time derivative (``order`` 1, per second); NaN outside the stretches."""
        from scipy.ndimage import gaussian_filter1d

        out = np.full(values.shape, np.nan)
        for stretch in self.stretches:
            t = self.time[stretch]
            step = float(np.median(np.diff(t)))
            grid = np.arange(t[0], t[-1] + 0.5 * step, step)
            columns = values[stretch].reshape(len(t), -1)
            even = interpolate(t, columns, grid)
            found = gaussian_filter1d(even, self.width / step, axis=0, order=order, mode="nearest") / step**order
            back = interpolate(grid, found, t)
            out[stretch] = back.reshape(values[stretch].shape)
        return out


def aligned(a: list[Residuals], b: list[Residuals]) -> tuple[list[Residuals], list[Residuals]]:
    """Cut two sets of residuals of the same flights to their common rows.

    Removing a fault from a recording removes rows at its ends.
    """
    pairs = []
    for one, two in zip(a, b, strict=True):
        _, i, j = np.intersect1d(one.time, two.time, assume_unique=True, return_indices=True)
        both = one.valid[i] & two.valid[j]
        pairs.append((one.rows(i, both), two.rows(j, both)))
    return [p[0] for p in pairs], [p[1] for p in pairs]


SPAN = 4.0
"""Length of the data of one spectrum, s; the spectra of all flights are averaged."""
HIGHEST = 12.0
"""Highest frequency, Hz; above it the Gaussian filter leaves almost nothing."""


def spectra(rows: list[Residuals]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Average power spectral density of every residual axis of the body; the four rotors are averaged.

    Stretches shorter than `SPAN` are left out, and so are axes without a stretch that is long enough.

    Returns:
        By axis: frequency (f,), Hz, and density (f,), unit^2/Hz.
    """
    from scipy.signal import welch

    found: dict[str, list] = {}
    # A common grid, because the flights' sampling rates differ slightly.
    common = np.arange(1, HIGHEST * SPAN + 1) / SPAN
    for flight in rows:
        step = float(np.median(np.diff(flight.time)))
        edges = np.flatnonzero(np.diff(np.concatenate([[0], flight.valid.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2):
            time = flight.time[begin:end]
            grid = np.arange(time[0], time[-1], step)
            if len(grid) * step < SPAN:
                continue
            for name, (values, _) in flight.axes().items():
                # World axes would repeat those of the body.
                if name.startswith("world") or not np.isfinite(values[begin:end]).all():
                    continue
                even = np.interp(grid, time, values[begin:end])
                frequency, density = welch(even, 1 / step, nperseg=int(SPAN / step), detrend=cast(Any, False))
                key = "rotor" if name.startswith("rotor") else name
                found.setdefault(key, []).append((np.interp(common, frequency, density), len(grid)))
    return {
        key: (common, np.average([d for d, _ in parts], axis=0, weights=[w for _, w in parts]))
        for key, parts in found.items()
    }


def sensor_spectra(frequency: np.ndarray, noise: dict[str, np.ndarray], interval: float) -> dict[str, np.ndarray]:
    """Power spectral density (f,) of the smoothed white noise of the sensors, by residual axis.

    Args:
        frequency: (f,) Hz.
        noise: white noise per row, from `sensor_noise`.
        interval: between rows, s.
    """
    turn = 2 * np.pi * frequency
    passed = 2 * interval * np.exp(-((turn * WIDTH) ** 2))
    found = {f"torque {a}": passed * turn**2 * float(noise["gyro"][i]) ** 2 for i, a in enumerate("xyz")}
    found |= {f"force {a}": passed * float(noise["accelerometer"]) ** 2 for a in "xyz"}
    return found | {"rotor": passed * float(noise["rotor"]) ** 2}


LOWEST, SPACING = 0.4, 0.03
"""Lowest frequency and spacing of the grid on which lines are searched, Hz; it ends at `HIGHEST`."""
NEIGHBOURS = 41
"""Number of neighbouring frequencies whose median power is the background of a line."""
RATE = 40.0
"""Rate to which the smooth residuals are decimated, Hz."""


@dataclass(frozen=True)
class SpectralLine:
    """A spectral line of one residual axis.

    Attributes:
        axis: for instance ``torque x``.
        frequency: Hz.
        amplitude: rms amplitude, the median over the flights, in ``unit``.
        unit: of the residual.
        p_value: probability that so many flights show it by chance, multiplied by the number of axes and frequencies
            examined (Bonferroni).
    """

    axis: str
    frequency: float
    amplitude: float
    unit: str
    p_value: float

    def __str__(self) -> str:
        return (
            f"{self.axis} oscillates at {self.frequency:.2f} Hz, {self.amplitude:.2g} {self.unit} rms, in most flights"
        )


def find_spectral_lines(rows: list[Residuals], alpha: float = RULES.line_alpha) -> list[SpectralLine]:
    """Find spectral lines that at least two thirds of the flights share, the most significant first.

    A manoeuvre has its own frequencies, which also appear in the residual of an imperfect model. Therefore a line must
    appear in most flights. Flights with at most 1000 valid rows are ignored, and at least three others are required.

    Args:
        rows: residuals of each flight.
        alpha: largest p-value of a line.
    """
    rows = [r for r in rows if r.valid.sum() > 1000]
    if len(rows) < 3:
        return []
    frequencies = np.arange(LOWEST, HIGHEST, SPACING)
    enough = int(np.ceil(2 * len(rows) / 3))
    found = []
    names = [name for name in rows[0].axes() if not name.startswith("rotor")]
    for name in names:
        powers, sizes = zip(*(_spectrum(r, name, frequencies) for r in rows), strict=True)
        # The power of noise over its mean is exponentially distributed. Use the weakest of the flights that must agree.
        weakest = np.sort(np.array(powers), axis=0)[len(rows) - enough]
        best = int(np.argmax(weakest))
        chance = comb(len(rows), enough) * np.exp(-enough * weakest[best])
        p_value = float(min(1.0, chance * len(frequencies) * len(names)))
        if p_value < alpha:
            amplitude = float(np.sqrt(np.median([s[best] for s in sizes]) / 2))
            found.append(SpectralLine(name, float(frequencies[best]), amplitude, rows[0].axes()[name][1], p_value))
    return sorted(found, key=lambda line: line.p_value)


def _spectrum(row: Residuals, name: str, frequencies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ratio of power to background, and squared amplitude, at each frequency."""
    step = max(1, round(1 / RATE / np.median(np.diff(row.time))))
    keep = np.flatnonzero(row.valid > 0)[::step]
    values = row.axes()[name][0][keep]
    values = values - values.mean()
    power = lombscargle(row.time[keep], values, 2 * np.pi * frequencies)
    background = median_filter(power, NEIGHBOURS, mode="nearest") / np.log(2)
    return power / np.maximum(background, 1e-12), 4 * power / len(keep)
