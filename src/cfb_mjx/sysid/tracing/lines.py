"""Something that turns or swings at its own pace: the same spectral line in what most flights leave unexplained."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import lombscargle

from cfb_mjx.sysid.tracing.residuals import Residuals

LOWEST, HIGHEST, SPACING = 0.4, 12.0, 0.03  # Hz
NEIGHBOURS = 41
"""Frequencies whose median power is the background of a line."""
RATE = 40.0
"""Rows a second that are kept: residuals are smooth beyond."""
ALPHA = 1e-4


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


def find_lines(rows: list[Residuals]) -> list[Line]:
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
        if p_value < ALPHA:
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
