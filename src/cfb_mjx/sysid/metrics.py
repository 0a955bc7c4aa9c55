"""Prediction errors and their statistics, with the keys of the JSON results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cfb_mjx.model.state import AnyArray, State
from cfb_mjx.sysid.windows import Windows

QUANTITIES = {"position": "m", "velocity": "mps", "attitude": "deg", "rate": "radps"}
STATISTICS = {
    "rmse": lambda e, axis: np.sqrt(np.mean(e**2, axis=axis)),
    "mean": np.mean,
    "median": np.median,
}
BLOCK = 4
"""Number of consecutive windows per bootstrap block: windows overlap by 0.3 s, so neighbours are not independent."""


def errors(windows: Windows, predicted: State) -> dict[str, np.ndarray]:
    """Errors (W, H) of each window at each horizon: vector norms, and for attitude the geodesic angle in degrees.

    They are not finite where the prediction diverged.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return _errors(windows, predicted)


def _errors(windows: Windows, predicted: State) -> dict[str, np.ndarray]:
    return {
        "position": np.linalg.norm(predicted.position - windows.true_position, axis=-1),
        "velocity": np.linalg.norm(predicted.velocity - windows.true_velocity, axis=-1),
        "attitude": geodesic_deg(predicted.quaternion, windows.true_quaternion),
        "rate": np.linalg.norm(predicted.body_rate - windows.true_body_rate, axis=-1),
    }


def geodesic_deg(p: AnyArray, q: AnyArray) -> np.ndarray:
    """Angle of the rotation between two unit quaternions, degrees; accurate for small angles too."""
    # |p - q| and |p + q| are 2 sin and 2 cos of a quarter of the angle; arccos would lose half the digits near zero.
    near = np.linalg.norm(p - q, axis=-1)
    far = np.linalg.norm(p + q, axis=-1)
    return np.degrees(4 * np.arctan2(np.minimum(near, far), np.maximum(near, far)))


def metrics(error: Mapping[str, np.ndarray], horizons: tuple[float, ...]) -> dict[str, float]:
    """``<quantity>_<statistic>_<unit>@<horizon>s`` over all windows."""
    return {
        f"{quantity}_{name}_{unit}@{horizon:g}s": float(statistic(error[quantity][:, i], axis=0))
        for i, horizon in enumerate(horizons)
        for quantity, unit in QUANTITIES.items()
        for name, statistic in STATISTICS.items()
    }


def intervals(
    per_log: Sequence[Mapping[str, np.ndarray]], horizons: tuple[float, ...], resamples: int = 500, seed: int = 0
) -> dict[str, list[float]]:
    """95 % confidence intervals of `metrics` by bootstrap over blocks of `BLOCK` consecutive windows of one log."""
    counts = [len(e["position"]) for e in per_log]
    total = sum(counts)
    offsets = np.concatenate([[0], np.cumsum(counts)[:-1]])
    # Blocks wrap around within their log, so all windows are equally likely to be drawn.
    firsts = np.repeat(offsets, counts)
    lengths = np.repeat(counts, counts)
    within = np.arange(total) - firsts
    members = firsts[:, None] + (within[:, None] + np.arange(BLOCK)) % lengths[:, None]
    rng = np.random.default_rng(seed)
    blocks = -(-total // BLOCK)
    draws = members[rng.integers(0, total, (resamples, blocks))].reshape(resamples, -1)[:, :total]
    found = {}
    for quantity, unit in QUANTITIES.items():
        error = np.concatenate([e[quantity] for e in per_log])
        sample = error[draws]
        for name, statistic in STATISTICS.items():
            low, high = np.quantile(statistic(sample, axis=1), [0.025, 0.975], axis=0)
            for i, horizon in enumerate(horizons):
                found[f"{quantity}_{name}_{unit}@{horizon:g}s"] = [float(low[i]), float(high[i])]
    return found
