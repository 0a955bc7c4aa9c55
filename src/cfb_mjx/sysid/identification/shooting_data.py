"""Windows of several logs for multiple shooting, in batches of a few fixed shapes, with the noise of the sensors."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.devices import Devices
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.state import State
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.identification.flight_data import white_noise
from cfb_mjx.sysid.windows import Windows, find_windows

HORIZONS = tuple(float(h) for h in np.round(np.arange(0.02, 0.2001, 0.02), 3))
"""Times after a window's start at which the prediction is compared with the measurement, s."""
LEAD = 0.6
"""Duration of the commands before a window that determine its rotor speeds, s: twelve motor time constants."""
COMMAND_DOUBT = 50.0
"""Standard deviation of rotor speeds estimated from commands, rad/s, because battery and load are unknown."""


class Batch(eqx.Module):
    """A batch of w windows with s integration steps, h instants of comparison and p rows before the window."""

    lead_step: Float[Array, "w p"]
    lead_command: Float[Array, "w p 4"]
    state: State
    """Measured state at the start of each window; rotor speeds are zero if not measured."""
    step: Float[Array, "w s"]
    inputs: Float[Array, "w s 4"]
    at: jax.Array
    truth: State
    noise: Float[Array, "w 12"]
    """Measurement noise per row: position, velocity, attitude (rotation vector), body rate."""
    rotor_noise: Float[Array, " w"]
    """Standard deviation of the rotor speeds, rad/s."""
    live: Float[Array, " w"]
    """0 for windows that only pad the batch."""
    delay: Float[Array, ""]
    """Age of the pose in a row that was assumed when the windows were cut, s."""
    measured: bool = eqx.field(static=True)
    """Whether the inputs are measured rotor speeds instead of commands."""
    over: Devices | None = eqx.field(static=True, default=None)
    """Devices over which the windows are divided."""


def batches(
    logs: list[FlightLog], delay: float | None, fallback: float, use_measured: bool, over: Devices | None = None
) -> list[Batch]:
    """Cut logs into windows, batched separately by input (commands or measured rotor speeds) and by delay.

    Args:
        logs: flights with the gyro's delay removed (`with_gyro_in_time`).
        delay: age of the pose in all logs, s; None: each log's own.
        fallback: age of the pose for logs that do not state it, s.
        use_measured: use measured rotor speeds as input where available.
        over: devices over which to divide the windows.
    """
    pieces: dict[tuple[bool, float], list[dict]] = {}
    for log in logs:
        own = log.metadata.get("observation_delay")
        age = delay if delay is not None else (fallback if own is None else float(own))
        windows = find_windows(log, HORIZONS, age, gyro_delay=0.0)
        if len(windows):
            good = np.isfinite(windows.rotor_speed).all(axis=(1, 2)) & use_measured
            for measured in (True, False):
                chosen = np.flatnonzero(good == measured)
                if len(chosen):
                    pieces.setdefault((measured, age), []).append(_arrays(log, windows, chosen, measured))
    found = [_stack(parts, measured, age) for (measured, age), parts in pieces.items()]
    return found if over is None else [_divided(batch, over) for batch in found]


def _divided(batch: Batch, over: Devices) -> Batch:
    if not over.several:
        return batch
    # Windows added as padding have no weight; the delay is common to all windows.
    more = -len(batch.live) % over.count
    live = np.concatenate([np.asarray(batch.live), np.zeros(more)])
    alike = replace(batch, delay=np.broadcast_to(batch.delay, batch.live.shape))
    return replace(over.shared(alike), live=over.along(live), delay=over.whole(batch.delay))


def _arrays(log: FlightLog, windows: Windows, chosen: np.ndarray, measured: bool) -> dict:
    lead = [_lead(log, float(windows.start[i]), int(windows.row[i])) for i in chosen]
    width = max(len(step) for step, _ in lead)
    speed = windows.rotor_speed[chosen]
    names = ("position", "velocity", "quaternion", "body_rate")
    return {
        # Shorter leads are padded in front with steps of zero length.
        "lead_step": np.stack([np.pad(step, (width - len(step), 0)) for step, _ in lead]),
        "lead_command": np.stack([np.pad(u, ((width - len(u), 0), (0, 0)), mode="edge") for _, u in lead]),
        "state": [getattr(windows, name)[chosen] for name in names]
        + [speed[:, 0] if measured else np.zeros((len(chosen), 4))],
        "step": windows.step[chosen],
        "inputs": speed[:, 1:] if measured else windows.command[chosen],
        "at": windows.at[chosen],
        "truth": [getattr(windows, "true_" + name)[chosen] for name in names],
        "noise": np.tile(_noise(log), (len(chosen), 1)),
        "rotor_noise": np.full(len(chosen), _rotor_noise(log) if measured else COMMAND_DOUBT),
    }


def _lead(log: FlightLog, start: float, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Durations and commands from `LEAD` before a window to its start."""
    first = max(int(np.searchsorted(log.time, start - LEAD)), 0)
    edges = np.concatenate([log.time[first : row + 1], [start]])
    return np.maximum(np.diff(edges), 0.0), np.clip(log.command[first : row + 1], 0, 1)


def _stack(parts: list[dict], measured: bool, delay: float) -> Batch:
    count = sum(len(part["step"]) for part in parts)
    rows = _ladder(count)

    def join(key, axis_pad=None, front=False):
        arrays = [part[key] for part in parts]
        if axis_pad is not None:
            width = axis_pad * -(-max(a.shape[1] for a in arrays) // axis_pad)
            arrays = [_pad_steps(a, width, front, edge=a.ndim == 3) for a in arrays]
        joined = np.concatenate(arrays)
        return jnp.asarray(np.concatenate([joined, np.repeat(joined[:1], rows - count, axis=0)]))

    def state(key, speed):
        fields = [np.concatenate([part[key][i] for part in parts]) for i in range(len(parts[0][key]))]
        fields = [jnp.asarray(np.concatenate([f, np.repeat(f[:1], rows - count, axis=0)])) for f in fields]
        return State(*fields, *([] if speed else [jnp.zeros((*fields[0].shape[:-1], 4))]))

    return Batch(
        lead_step=join("lead_step", 32, front=True),
        lead_command=join("lead_command", 32, front=True),
        state=state("state", True),
        step=join("step", 32),
        inputs=join("inputs", 32),
        at=join("at"),
        truth=state("truth", False),
        noise=join("noise"),
        rotor_noise=join("rotor_noise"),
        live=jnp.asarray((np.arange(rows) < count).astype(float)),
        delay=jnp.asarray(delay, float),
        measured=measured,
    )


def _ladder(count: int) -> int:
    """Round a number of windows up to 32, 64, 96, 128 or a multiple of 64: few compiled programs, little padding."""
    return 32 * -(-count // 32) if count <= 128 else 64 * -(-count // 64)


def _pad_steps(values: np.ndarray, width: int, front: bool, edge: bool) -> np.ndarray:
    more = width - values.shape[1]
    pads = [(0, 0), (more, 0) if front else (0, more), *[(0, 0)] * (values.ndim - 2)]
    return np.pad(values, pads, mode="edge") if edge else np.pad(values, pads)


def _noise(log: FlightLog) -> np.ndarray:
    """Measurement noise per row (12,), from third differences."""

    def level(values):
        return np.maximum(white_noise(values), 1e-6)

    return np.concatenate(
        [level(log.position), level(log.velocity), 2 * level(log.quaternion[:, 1:]), level(log.body_rate)]
    )


def _rotor_noise(log: FlightLog) -> float:
    return max(float(np.nanmean(white_noise(not_none(log.rotor_speed)))), 1e-3)
