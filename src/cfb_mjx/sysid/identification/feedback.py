"""Test for feedback: do the commands respond to the unpredictable part of the gyro's readings?"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cfb_mjx.model.rotors import TORQUE_SIGNS
from cfb_mjx.sysid.identification.flight_data import Segments

LAGS = 5
"""Number of rows within which a controller responds."""
SIGNIFICANT = 1e-6
"""Largest p-value at which feedback is considered present."""


@dataclass(frozen=True)
class Feedback:
    """Largest correlation between an innovation of a body rate and a later change of command, and its p-value."""

    correlation: float
    p_value: float

    @property
    def present(self) -> bool:
        """Whether the flight was flown under feedback."""
        return self.p_value < SIGNIFICANT


def detect(segments: Segments, residual: np.ndarray) -> Feedback:
    """Correlate innovations with the command changes that follow.

    An innovation cannot be predicted from past rows and commands. A predetermined command sequence cannot correlate
    with it, whereas a controller's commands must.

    Args:
        segments: flight data.
        residual: (s, n - 1, 8) whitened innovations, zero where a row does not count.
    """
    mix = np.asarray(TORQUE_SIGNS)
    counts = np.asarray(segments.valid * (1 - segments.warm_up))[:, 1:]
    change = np.diff(np.asarray(segments.command) @ mix.T, axis=1)  # into each row, from the one before
    length, best = change.shape[1], 0.0
    for lag in range(LAGS):
        use = (counts[:, : length - lag] * counts[:, lag:])[..., None]
        error, answer = residual[:, : length - lag, :3] * use, change[:, lag:] * use
        size = np.sqrt(np.sum(error**2, axis=(0, 1)) * np.sum(answer**2, axis=(0, 1)))
        found = np.abs(np.sum(error * answer, axis=(0, 1))) / np.maximum(size, 1e-300)
        best = max(best, float(found.max()))
    # Fisher's z is normal with variance 1 / (n - 3); Bonferroni over axes and lags.
    z = np.arctanh(min(best, 1 - 1e-12)) * np.sqrt(max(counts.sum() - 3, 1))
    return Feedback(float(best), min(1.0, 3 * LAGS * math.erfc(z / math.sqrt(2))))
