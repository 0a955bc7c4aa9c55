"""What a model misses along flights, in physical units and beside the signals that could drive it.

Made to be looked at: the search itself works with whitened residuals (`whitening`). Measurement and model pass through
the same zero-phase Gaussian, so neither lags the other, and the driving signals pass through it too.
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
from cfb_mjx.sysid.tracing.innovations import Blocks, driven_by, residual_blocks
from cfb_mjx.sysid.tracing.rules import RULES
from cfb_mjx.sysid.tracing.search import Search

WIDTH = 0.02
"""Standard deviation of the Gaussian, s: half of what moves at 6 Hz passes."""
PATTERNS = {"mean": (1, 1, 1, 1), "roll": (-1, -1, 1, 1), "pitch": (-1, 1, 1, -1), "yaw": (-1, 1, -1, 1)}
"""Combinations of the four rotors (M1 to M4), each divided by four: what lifts, rolls, pitches and yaws."""
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
"""The driving signals and their units: body axes; rotor speeds as they drive the model; slopes are time derivatives."""


@dataclass(frozen=True)
class Residuals:
    """Of one flight of n rows: measured minus modelled.

    Attributes:
        name: of the log.
        time: (n,) s.
        angular_acceleration: (n, 3) body axes, rad/s^2: times the inertia, the torque the model misses.
        specific_force: (n, 3) body axes, m/s^2: times the mass, the force it misses.
        world_force: (n, 3) the same in world axes: what hangs on a place shows here.
        rotor_speed: (n, 4) measured minus modelled from commands alone, rad/s; None where not measured.
        valid: (n,) rows where a residual means something.
        drivers: signals (n,) that could drive it, named and in the units of `UNITS`; NaN where not measured.
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
        """Every residual axis (n,) by name, with its unit."""
        found = {f"torque {a}": (self.angular_acceleration[:, i], "rad/s^2") for i, a in enumerate("xyz")}
        found |= {f"force {a}": (self.specific_force[:, i], "m/s^2") for i, a in enumerate("xyz")}
        found |= {f"world force {a}": (self.world_force[:, i], "m/s^2") for i, a in enumerate("xy")}
        speed = np.full((len(self.time), 4), np.nan) if self.rotor_speed is None else self.rotor_speed
        return found | {f"rotor M{i + 1}": (speed[:, i], "rad/s") for i in range(4)}

    def rows(self, index: np.ndarray, valid: np.ndarray) -> Residuals:
        """The rows ``index`` selects, of which ``valid`` count."""
        fields = ("time", "angular_acceleration", "specific_force", "world_force")
        return replace(
            self,
            **{field: getattr(self, field)[index] for field in fields},
            rotor_speed=None if self.rotor_speed is None else self.rotor_speed[index],
            valid=valid,
            drivers={key: values[index] for key, values in self.drivers.items()},
        )


def residual_rows(search: Search, hypothesis: Hypothesis) -> list[Residuals]:
    """What a hypothesis misses along every flight of a search."""
    flights = search.flights(hypothesis)
    found = search.residuals(hypothesis)
    return [
        _rows(blocks, driven, flight, log.name)
        for log, flight, (blocks, driven) in zip(search.logs, flights, found, strict=True)
    ]


def model_residuals(model: Quadrotor, log: FlightLog, delay: float | None = None) -> tuple[Residuals, np.ndarray]:
    """What a model misses along one flight, and the rotor speeds (rows, 4) [rad/s] that drove it.

    Args:
        model: the drone.
        log: the flight.
        delay: age of pose and velocity in its rows, s; as the log or the model says by default.
    """
    delay = delay_of(log, model.parameters) if delay is None else delay
    flight = prepare_flight(log, delay, float(model.parameters.gyro_delay))
    (driven,) = driven_by(model, [flight], 0.0)
    (blocks,) = residual_blocks(model, [flight], [driven], 0.0)
    return _rows(blocks, driven, flight, log.name), driven[: len(log)]


def _rows(blocks: Blocks, driven: np.ndarray, flight: Flight, name: str) -> Residuals:
    # Blocks and padding only serve the compiler: the flight again, in one piece.
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
    """Yaw (n,), rad, -pi to pi."""
    w, x, y, z = quaternion.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


class Smoother:
    """The Gaussian along one flight, which never reaches across a gap.

    Attributes:
        inside: (n,) rows far enough from both ends of their stretch for the Gaussian to be whole.
    """

    def __init__(self, time: np.ndarray, valid: np.ndarray, width: float = WIDTH):
        self.time, self.width = time, width
        edges = np.flatnonzero(np.diff(np.concatenate([[0], valid.astype(int), [0]])))
        # Shorter stretches have nothing in their middle.
        self.stretches = [slice(a, b) for a, b in edges.reshape(-1, 2) if time[b - 1] - time[a] > 6 * width]
        self.inside = np.zeros(len(time), dtype=bool)
        for stretch in self.stretches:
            t = time[stretch]
            self.inside[stretch] = (t >= t[0] + 2 * width) & (t <= t[-1] - 2 * width)

    def __call__(self, values: np.ndarray, order: int = 0) -> np.ndarray:
        """Smoothed (n, ...) values, or with ``order`` 1 their slope per second; NaN outside the stretches."""
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
    """The same flights twice, cut to the rows both have: taking a fault out of a recording costs rows at its ends."""
    pairs = []
    for one, two in zip(a, b, strict=True):
        _, i, j = np.intersect1d(one.time, two.time, assume_unique=True, return_indices=True)
        both = one.valid[i] & two.valid[j]
        pairs.append((one.rows(i, both), two.rows(j, both)))
    return [p[0] for p in pairs], [p[1] for p in pairs]


SPAN = 4.0
"""Seconds of one spectrum; those of all flights are averaged."""
HIGHEST = 12.0
"""Hz: above, the Gaussian leaves nothing to see."""


def spectra(rows: list[Residuals]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Frequency (f,) Hz and power spectral density (f,), unit^2/Hz, by residual axis of the body; rotors together.

    Stretches shorter than `SPAN` are left out, and so are axes of which nothing is long enough.
    """
    from scipy.signal import welch

    found: dict[str, list] = {}
    # Flights are sampled at about the same rate; one grid lets them be averaged.
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
                # World axes would only repeat the body's.
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
    """Densities (f,) that white noise of the sensors leaves behind the Gaussian, by residual axis.

    Args:
        frequency: Hz.
        noise: of a row, as from `sensor_noise`.
        interval: between rows, s.
    """
    turn = 2 * np.pi * frequency
    passed = 2 * interval * np.exp(-((turn * WIDTH) ** 2))
    found = {f"torque {a}": passed * turn**2 * float(noise["gyro"][i]) ** 2 for i, a in enumerate("xyz")}
    found |= {f"force {a}": passed * float(noise["accelerometer"]) ** 2 for a in "xyz"}
    return found | {"rotor": passed * float(noise["rotor"]) ** 2}


LOWEST, SPACING = 0.4, 0.03
"""Hz: where lines are looked for, up to `HIGHEST`."""
NEIGHBOURS = 41
"""Frequencies whose median power is the background of a line."""
RATE = 40.0
"""Rows a second that are kept: residuals are smooth beyond."""


@dataclass(frozen=True)
class Line:
    """A line of one residual axis.

    Attributes:
        axis: for instance ``torque x``.
        frequency: Hz.
        amplitude: rms over the flights, in ``unit``.
        unit: of the residual.
        p_value: that so many flights have it by chance, times the number of places looked at.
    """

    axis: str
    frequency: float
    amplitude: float
    unit: str
    p_value: float

    def __str__(self) -> str:
        return (
            f"{self.axis} swings at {self.frequency:.2f} Hz by {self.amplitude:.2g} {self.unit} rms whatever is flown"
        )


def find_lines(rows: list[Residuals], alpha: float = RULES.line_alpha) -> list[Line]:
    """Lines that two thirds of the flights or more share, the clearest first.

    A manoeuvre has frequencies of its own, which an imperfect model shows too; so a line must stand in most flights.
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
        # Of noise each is exponential; the weakest of the flights that must agree decides.
        weakest = np.sort(np.array(powers), axis=0)[len(rows) - enough]
        best = int(np.argmax(weakest))
        chance = comb(len(rows), enough) * np.exp(-enough * weakest[best])
        p_value = float(min(1.0, chance * len(frequencies) * len(names)))
        if p_value < alpha:
            amplitude = float(np.sqrt(np.median([s[best] for s in sizes]) / 2))
            found.append(Line(name, float(frequencies[best]), amplitude, rows[0].axes()[name][1], p_value))
    return sorted(found, key=lambda line: line.p_value)


def _spectrum(row: Residuals, name: str, frequencies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Power over background, and squared amplitude, at each frequency."""
    step = max(1, round(1 / RATE / np.median(np.diff(row.time))))
    keep = np.flatnonzero(row.valid > 0)[::step]
    values = row.axes()[name][0][keep]
    values = values - values.mean()
    power = lombscargle(row.time[keep], values, 2 * np.pi * frequencies)
    background = median_filter(power, NEIGHBOURS, mode="nearest") / np.log(2)
    return power / np.maximum(background, 1e-12), 4 * power / len(keep)
