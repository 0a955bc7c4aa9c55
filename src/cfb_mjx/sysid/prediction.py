"""Open-loop prediction of all windows of a log in batches."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.devices import Devices, last_repeated
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.quadrotor import Quadrotor, begin, commanded_path, integrate_commanded, integrate_measured, prepare
from cfb_mjx.model.state import AnyArray, State, stack, unstack
from cfb_mjx.model.vector import Vec
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.flight import Flight, prepare_flight
from cfb_mjx.sysid.replay import remembered_along, rotors_alone
from cfb_mjx.sysid.windows import Windows

WINDOWS_PER_BLOCK, STEPS_PER_BLOCK = 128, 160
_STATE = ("position", "velocity", "quaternion", "body_rate")


def predict(
    model: Quadrotor,
    windows: Windows,
    rotor_speed: AnyArray | None = None,
    memory: tuple = (),
    over: Devices | None = None,
) -> State:
    """Predict the states at the horizons.

    Args:
        model: the drone; its ``dt`` and ``substeps`` are ignored, because the steps come from the log.
        windows: W windows; W must not be 0.
        rotor_speed: (W, 4) rotor speeds at the window starts, rad/s, for a prediction from the logged commands; None:
            predict from the measured rotor speeds instead.
        memory: memories of the effects at the window starts (`start_of_windows`).
        over: devices over which to divide the windows.

    Returns:
        Predicted states as NumPy arrays (W, H, ...).
    """
    measured = rotor_speed is None
    start = windows.rotor_speed[:, 0] if measured else rotor_speed
    inputs = windows.rotor_speed[:, 1:] if measured else windows.command
    state = State(*(getattr(windows, name) for name in _STATE), rotor_speed=start, memory=memory)
    count, width = windows.step.shape
    # Blocks of a fixed shape: the program is compiled once and then comes from the cache.
    steps = STEPS_PER_BLOCK * -(-max(width, 1) // STEPS_PER_BLOCK)
    step = np.pad(windows.step, ((0, 0), (0, steps - width)))
    inputs = np.pad(inputs, ((0, 0), (0, steps - width), (0, 0)), mode="edge")
    found, over = [], over or Devices.take()
    rows = -(-WINDOWS_PER_BLOCK // over.count) * over.count
    for first in range(0, count, rows):
        chosen = slice(first, min(first + rows, count))
        padded = [jax.tree.map(lambda x, c=chosen: last_repeated(x[c], rows), x) for x in (state, step, inputs)]
        here, steps_here, inputs_here = over.along(padded)
        trajectory = over.here(_predict_batch(model, here, steps_here, inputs_here, measured, over))
        index = np.arange(chosen.stop - first)[:, None], windows.at[chosen]
        found.append(jax.tree.map(lambda x, i=index: np.asarray(x)[i], trajectory))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


@eqx.filter_jit
def _predict_batch(model: Quadrotor, state: State, step, inputs, measured: bool, over: Devices) -> State:
    flown = over.mapped(lambda *x: predict_one(model, *x, measured=measured))(state, step, inputs)
    return eqx.tree_at(lambda s: s.memory, flown, (), is_leaf=lambda x: isinstance(x, tuple))


def predict_one(model: Quadrotor, state: State, step, inputs, measured: bool) -> State:
    """Trajectory of S + 1 states of one window, starting with the initial state; differentiable.

    Args:
        model: the drone.
        state: at the window's start.
        step: (S,) integration steps, s; 0 after the end of the window.
        inputs: (S, 4) commands held during each step, or rotor speeds at its end, rad/s.
        measured: whether ``inputs`` are rotor speeds.
    """
    center = Vec.unstack(model.changed_parameters().center_of_gravity)

    def advance(components, row):
        dt, value = row
        prepared = prepare(model, dt)
        move = integrate_measured if measured else integrate_commanded
        components = move(prepared, components, value)
        return components, components

    first = unstack(begin(model, state), center)
    _, rest = jax.lax.scan(advance, first, (step, Vec.unstack(inputs)))
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)
    return stack(whole, center)


def start_of_windows(model: Quadrotor, log: FlightLog, windows: Windows, delay: float) -> tuple[np.ndarray, tuple]:
    """Rotor speeds (W, 4), rad/s, and memories of the effects (leading axis W) at the window starts.

    Both are computed from the commands since the start of the log and from measurements before each window's start.

    Args:
        model: the drone.
        log: the flight.
        windows: W windows of the log.
        delay: age of pose and velocity in a row, s.
    """
    flight = prepare_flight(log, delay, float(model.parameters.gyro_delay))
    return starts_of_windows(model, [log], [windows], [flight])[0]


def starts_of_windows(
    model: Quadrotor, logs: Sequence[FlightLog], windows: Sequence[Windows], flights: Sequence[Flight | None]
) -> list[tuple[np.ndarray, tuple]]:
    """`start_of_windows` of several logs in parallel.

    ``flights`` are the prepared logs; for a log without windows it may be None, and the result is empty.
    """
    there = [i for i, own in enumerate(windows) if len(own)]
    nothing: tuple[np.ndarray, tuple] = np.zeros((0, 4)), ()
    if not there:
        return [nothing] * len(windows)
    rows = [windows[i].row for i in there]
    known = remembered_along(model, [not_none(flights[i]) for i in there], rows=rows)
    found = []
    for i, (speed, memory) in zip(there, known, strict=True):
        log, own = logs[i], windows[i]
        # A start at a row's own time may lie before it by a rounding error.
        since = np.maximum(own.start - log.time[own.row], 0.0)
        found.append((speed, memory, log.command[own.row], since))
    ends = np.cumsum([len(own) for own in windows])
    count = int(ends[-1])
    speed, memory, command, since = jax.tree.map(lambda *x: np.concatenate(x), *found)
    inputs = speed, memory, np.clip(command, 0, 1), since
    parts = []
    for first in range(0, count, WINDOWS_PER_BLOCK):
        # Padded to a fixed shape, so that one program serves any number of windows.
        block = jax.tree.map(lambda x, f=first: last_repeated(x[f : f + WINDOWS_PER_BLOCK], WINDOWS_PER_BLOCK), inputs)
        parts.append(jax.tree.map(np.asarray, _advance_rotors(rotors_alone(model), *block)))
    every = jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)
    pieces = zip(ends - [len(own) for own in windows], ends, strict=True)
    return [jax.tree.map(lambda x, a=a, b=b: x[a:b], every) if b > a else nothing for a, b in pieces]


@eqx.filter_jit
def _advance_rotors(model: Quadrotor, speed, memory, command, since):
    def one(speed, memory, command, since):
        prepared = prepare(model, since)
        parts = (Vec.unstack(x) for x in (speed, command))
        speed, command = parts
        path, memory = commanded_path(prepared, speed, jax.tree.map(Vec.unstack, memory), command)
        return path.end.stack(), jax.tree.map(lambda v: v.stack(), memory, is_leaf=lambda x: isinstance(x, Vec))

    return jax.vmap(one)(speed, memory, command, since)


def hold(windows: Windows, horizons: tuple[float, ...]) -> State:
    """Baseline without physics: states (W, H, ...) at constant velocity and constant body rate."""
    time = np.asarray(horizons)[None, :, None]
    half = 0.5 * windows.body_rate[:, None] * time
    angle = np.linalg.norm(half, axis=-1, keepdims=True)
    turn = np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], axis=-1)
    q = np.broadcast_to(windows.quaternion[:, None], turn.shape)
    w, v, tw, tv = q[..., :1], q[..., 1:], turn[..., :1], turn[..., 1:]
    scalar = w * tw - np.sum(v * tv, axis=-1, keepdims=True)
    quaternion = np.concatenate([scalar, w * tv + tw * v + np.cross(v, tv)], axis=-1)
    velocity = np.broadcast_to(windows.velocity[:, None], half.shape)
    return State(
        position=windows.position[:, None] + velocity * time,
        velocity=velocity,
        quaternion=quaternion,
        body_rate=np.broadcast_to(windows.body_rate[:, None], half.shape),
        rotor_speed=np.zeros((*half.shape[:-1], 4)),
    )


def select(windows: Windows, chosen: np.ndarray) -> Windows:
    """The windows for which ``chosen`` (W,) is true."""
    return Windows(**{f.name: getattr(windows, f.name)[chosen] for f in dataclasses.fields(windows)})
