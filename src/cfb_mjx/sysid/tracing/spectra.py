"""Spectra of residuals, and what white noise of the sensors would leave of them."""

from __future__ import annotations

import numpy as np

from cfb_mjx.sysid.tracing.residuals import WIDTH, Residuals

LENGTH = 4.0
"""Seconds of one spectrum; those of all flights are averaged."""
HIGHEST = 12.0
"""Hz: above, the Gaussian leaves nothing to see."""


def spectra(rows: list[Residuals]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Frequency (f,) Hz and power spectral density (f,), unit^2/Hz, by residual axis of the body; rotors together.

    Stretches shorter than `LENGTH` are left out, and so are axes of which nothing is long enough.
    """
    from scipy.signal import welch

    found: dict[str, list] = {}
    for flight in rows:
        step = float(np.median(np.diff(flight.time)))
        edges = np.flatnonzero(np.diff(np.concatenate([[0], flight.valid.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2):
            time = flight.time[begin:end]
            grid = np.arange(time[0], time[-1], step)
            if len(grid) * step < LENGTH:
                continue
            for name, (values, _) in flight.axes().items():
                # World axes would only repeat the body's.
                if name.startswith("world") or not np.isfinite(values[begin:end]).all():
                    continue
                even = np.interp(grid, time, values[begin:end])
                frequency, density = welch(even, 1 / step, nperseg=int(LENGTH / step), detrend=False)
                # Flights are sampled at about the same rate; one grid lets them be averaged.
                common = np.arange(1, HIGHEST * LENGTH + 1) / LENGTH
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
