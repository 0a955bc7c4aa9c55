"""Open-loop prediction of every window of a log at once."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.model.quadrotor import Quadrotor, integrate_commanded, integrate_measured, prepare
from cfb_mjx.model.rotors import rotor_speed_history
from cfb_mjx.model.state import State, stack, unstack
from cfb_mjx.model.vector import Vec
from cfb_mjx.sysid.windows import Windows

WINDOWS_PER_BLOCK, STEPS_PER_BLOCK = 128, 160
_STATE = ("position", "velocity", "quaternion", "body_rate")


def predict(model: Quadrotor, windows: Windows, rotor_speed: np.ndarray | None = None) -> State:
    """Predict the measured states at the horizons.

    Args:
        model: the drone; its ``dt`` and ``substeps`` are not used, steps come from the log.
        windows: W windows.
        rotor_speed: (W, 4) rotor speeds at the window starts, rad/s, with the logged commands in; None feeds the
            measured rotor speeds instead.

    Returns:
        `State` of numpy arrays (W, H, ...); W must not be 0.
    """
    measured = rotor_speed is None
    start = windows.rotor_speed[:, 0] if measured else rotor_speed
    inputs = windows.rotor_speed[:, 1:] if measured else windows.command
    state = State(*(getattr(windows, name) for name in _STATE), rotor_speed=start)
    count, width = windows.step.shape
    # Blocks of one shape, whatever the logs: the program is compiled once and then comes from the cache.
    steps = STEPS_PER_BLOCK * -(-max(width, 1) // STEPS_PER_BLOCK)
    step = np.pad(windows.step, ((0, 0), (0, steps - width)))
    inputs = np.pad(inputs, ((0, 0), (0, steps - width), (0, 0)), mode="edge")
    found = []
    for first in range(0, count, WINDOWS_PER_BLOCK):
        chosen = slice(first, min(first + WINDOWS_PER_BLOCK, count))
        padded = [jax.tree.map(lambda x, c=chosen: _pad(x[c], WINDOWS_PER_BLOCK), x) for x in (state, step, inputs)]
        trajectory = _predict_batch(model, *padded, measured)
        index = np.arange(chosen.stop - first)[:, None], windows.at[chosen]
        found.append(jax.tree.map(lambda x, i=index: np.asarray(x)[i], trajectory))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


@eqx.filter_jit
def _predict_batch(model: Quadrotor, state: State, step, inputs, measured: bool) -> State:
    return jax.vmap(lambda *x: predict_one(model, *x, measured))(state, step, inputs)


def predict_one(model: Quadrotor, state: State, step, inputs, measured: bool) -> State:
    """Trajectory (S + 1) of one window, the initial state first; differentiable.

    Args:
        model: the drone.
        state: at the window's start.
        step: (S,) integration steps, s; 0 where the window has ended.
        inputs: (S, 4) commands held in each step, or rotor speeds at its end if ``measured``.
        measured: what ``inputs`` are.
    """
    center = Vec.unstack(model.parameters.center_of_gravity)

    def advance(components, row):
        dt, value = row
        prepared = prepare(model, dt)
        move = integrate_measured if measured else integrate_commanded
        components = move(prepared, components, value)
        return components, components

    first = unstack(state, center)
    _, rest = jax.lax.scan(advance, first, (step, Vec.unstack(inputs)))
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)
    return stack(whole, center)


def rotor_speed_at_start(model: Quadrotor, time: np.ndarray, command: np.ndarray, windows: Windows) -> np.ndarray:
    """Rotor speeds at the window starts from the motor model driven by the commands since the log began, (W, 4)."""
    rows = 8192 * -(-len(time) // 8192)
    # Padding repeats the last row with zero time between: it changes nothing before it.
    history = _history(model, _pad(time, rows), _pad(command, rows))
    speed = np.asarray(history)[windows.row]
    since = (windows.start - time[windows.row])[:, None]
    parameters = model.parameters
    gain, offset = np.asarray(parameters.motor_gain), np.asarray(parameters.motor_speed_offset)
    target = gain * np.clip(command[windows.row], 0, 1) + offset
    return target + (speed - target) * np.exp(-since / np.asarray(parameters.motor_time_constant))


@eqx.filter_jit
def _history(model: Quadrotor, time, command):
    return rotor_speed_history(model.parameters, time, command)


def hold(windows: Windows, horizons: tuple[float, ...]) -> State:
    """The baseline that knows no physics: constant velocity and constant body rate, (W, H, ...)."""
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
    """The windows where ``chosen`` (W,) is true."""
    return Windows(**{f.name: getattr(windows, f.name)[chosen] for f in dataclasses.fields(windows)})


def _pad(x: np.ndarray, rows: int) -> np.ndarray:
    x = np.asarray(x)
    fill = x[-1:] if len(x) else np.ones((1, *x.shape[1:]))
    return np.concatenate([x, np.repeat(fill, rows - len(x), axis=0)])
