"""Multiple shooting: parameters that predict best over a horizon, from the measured state of every window.

The classical estimator, right for flights without feedback or without unmodelled disturbances. Under feedback it is
biased (`innovation` says why and is the default); ``cfb fit --compare`` shows its answer beside the
default one.

A window starts at a measured state, which carries noise, and at rotor speeds nobody may have measured. With free
initial states these errors are unknowns too, as likely as the sensors' noise says; being many and each seen by its own
window only, they are eliminated: with r the prediction errors at the measured start, whitened by the sensors' noise,
and G their derivative by the start's errors in standard deviations, the covariance of r is I + G G^T, and r is whitened
by the inverse of its Cholesky factor (generalised least squares; the same estimate as fitting every start).

The windows of several logs are computed in batches of a few fixed shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from cfb_mjx.devices import Devices, mapped
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.bodies import Body, RigidBody
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State
from cfb_mjx.model.vector import Vec, multiply
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification.flight_data import white_noise
from cfb_mjx.sysid.identification.result import Fit, summarise
from cfb_mjx.sysid.identification.solver import least_squares, tempered
from cfb_mjx.sysid.identification.uncertainty import Scores, assess
from cfb_mjx.sysid.identification.unknowns import Unknowns, choose
from cfb_mjx.sysid.prediction import predict_one
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


ROUNDS = 6
SETTLED = 5e-4


def shoot(
    logs: list[FlightLog],
    nominal: Parameters,
    parameters: str | tuple[str, ...],
    use_measured: bool = True,
    free_start: bool = True,
    robust: bool = False,
    body: Body | None = None,
    progress: Callable[[int, int], None] | None = None,
    over: Devices | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
) -> Fit:
    """Least squares on the prediction errors every 20 ms up to 200 ms, weighted by the sensors' noise.

    Args:
        logs: flights; run with x64 enabled.
        nominal: where to start, and the values of all that is not fitted.
        parameters: names or groups (`unknowns.choose`). The observation delay, if asked for, is one for
            all logs and replaces what they say of it.
        use_measured: feed measured rotor speeds where a log has them, else commands.
        free_start: allow for errors of every window's initial state and rotor speeds; otherwise they are taken as
            measured.
        robust: let outliers count linearly instead of squared.
        body: the body to predict with, `RigidBody()` or `MjxBody(floor=False)`.
        progress: called with (done, total).
        over: devices to divide the windows over.
        solver: least-squares solver of optimistix; None takes `GaussNewton`.

    Raises:
        CfbError: unknown parameters, or no window in any log.
    """
    unknowns = choose(parameters, nominal)
    delayed = "pose_delay" in unknowns.names
    data = batches(logs, None, float(nominal.pose_delay), use_measured, over)
    if not data:
        raise CfbError(f"{', '.join(log.name for log in logs)}: no prediction window fits; fly at least 1.2 s.")
    body = RigidBody() if body is None else body
    # Placed as the rounds return it, or the second would compile anew.
    vector = unknowns.start if over is None else over.whole(unknowns.start)
    whiten: list[Array] = []
    for done in range(ROUNDS):
        before = vector
        if delayed and done:
            data = batches(logs, float(unknowns.apply(vector).pose_delay), 0.0, use_measured, over)
        whiten = _whitening(unknowns, vector, data, body, free_start)
        whiten = whiten if over is None else over.along(whiten)
        vector = _solve(unknowns, vector, data, body, whiten, robust, solver)
        if progress is not None:
            progress(done + 1, ROUNDS)
        # With measured starts and a known delay there is nothing to repeat.
        settled = done and float(jnp.max(jnp.abs(vector - before))) < SETTLED
        if settled or not (free_start or delayed):
            break
    if progress is not None:
        progress(ROUNDS, ROUNDS)
    residual, jacobian = _linearise(unknowns, vector, data, body, whiten, robust)
    residual, jacobian = (np.concatenate([np.asarray(x) for x in parts]) for parts in (residual, jacobian))
    live = np.concatenate([np.asarray(batch.live) for batch in data]) > 0
    slope = np.linalg.inv(unknowns.slope(vector))
    uncertainty = assess(Scores.of(residual[live], jacobian[live] @ slope), unknowns.names)
    return summarise(unknowns, vector, uncertainty, "shooting", int(live.sum()))


def _errors(
    unknowns: Unknowns, vector: Array, start: Float[Array, "w 16"], batch: Batch, body: Body
) -> Float[Array, "w m"]:
    """Prediction errors in standard deviations, with the starts moved by ``start`` standard deviations."""
    parameters, delayed = unknowns.apply(vector), "pose_delay" in unknowns.names
    model = Quadrotor(parameters, body=body, integrator="rk4", rotor_loads="instant")
    # What a row calls the pose at t is the pose at t + late; the windows were cut with the logs' own delays.
    late = batch.delay - parameters.pose_delay if delayed else 0.0

    def one(lead_step, lead_command, state, step, inputs, at, truth, noise, rotor_noise, move):
        speed = state.rotor_speed if batch.measured else _speed_after(parameters, lead_step, lead_command)
        turn = move[6:9] * noise[6:9] - late * state.body_rate
        start = State(
            state.position + move[0:3] * noise[0:3] - late * state.velocity,
            state.velocity + move[3:6] * noise[3:6],
            multiply(Vec.unstack(state.quaternion), _small(turn)).stack(),
            state.body_rate + move[9:12] * noise[9:12],
            speed + move[12:16] * rotor_noise,
        )
        path = predict_one(model, start, step, inputs, batch.measured)
        found = jax.tree.map(lambda x: x[at], path)
        earlier = path.velocity[at - 1]
        acceleration = (found.velocity - earlier) / jnp.maximum(step[at - 1], 1e-6)[:, None]
        angle = _rotation(truth.quaternion, found.quaternion) + late * found.body_rate
        error = [
            found.position + late * found.velocity - truth.position,
            found.velocity + late * acceleration - truth.velocity,
            angle,
            found.body_rate - truth.body_rate,
        ]
        return (jnp.concatenate(error, axis=1) / noise).ravel()

    return batch.live[:, None] * mapped(one, batch.over)(
        batch.lead_step,
        batch.lead_command,
        batch.state,
        batch.step,
        batch.inputs,
        batch.at,
        batch.truth,
        batch.noise,
        batch.rotor_noise,
        start,
    )


def _speed_after(parameters: Parameters, step: Float[Array, " p"], command: Float[Array, "p 4"]) -> Float[Array, "4"]:
    target = parameters.motor_gain * command + parameters.motor_speed_offset

    def advance(speed, row):
        dt, goal = row
        return goal + (speed - goal) * jnp.exp(-dt / parameters.motor_time_constant), None

    return jax.lax.scan(advance, target[0], (step, target))[0]


def _small(turn: Float[Array, "3"]) -> Vec:
    """Quaternion of a small rotation vector."""
    half = 0.5 * turn
    return Vec(jnp.sqrt(1 - jnp.minimum(half @ half, 0.5)), half[0], half[1], half[2])


def _rotation(truth: Float[Array, "h 4"], found: Float[Array, "h 4"]) -> Float[Array, "h 3"]:
    """Rotation vector from ``truth`` to ``found``, to first order: twice the vector part, whichever sign."""
    sign = jnp.array([1.0, -1.0, -1.0, -1.0])
    turn = jax.vmap(lambda a, b: multiply(Vec.unstack(a * sign), Vec.unstack(b)).stack())(truth, found)
    return 2 * turn[:, 1:] * jnp.sign(turn[:, :1])


@eqx.filter_jit
def _start_slopes(unknowns: Unknowns, vector, data: list[Batch], body: Body) -> list[Float[Array, "w m 16"]]:
    """Derivative of every window's errors by its own start."""

    def slopes(batch):
        count = batch.step.shape[0]
        # Every window's errors depend on its own start only: 16 directions serve all windows at once.
        directions = jnp.broadcast_to(jnp.eye(16)[:, None, :], (16, count, 16))
        zero = jnp.zeros((count, 16))
        along = jax.vmap(lambda d: jax.jvp(lambda x: _errors(unknowns, vector, x, batch, body), (zero,), (d,))[1])
        return jnp.moveaxis(along(directions), 0, -1)

    return [slopes(batch) for batch in data]


def _whitening(unknowns: Unknowns, vector, data: list[Batch], body: Body, free_start: bool) -> list[Array]:
    """What every window's errors are multiplied with to be white: (w, m, m), or (w, 1, 1) for a plain factor."""
    if not free_start:
        # Both ends of a window carry a row's noise.
        return [jnp.full((len(batch.live), 1, 1), np.sqrt(0.5)) for batch in data]
    slopes = (np.asarray(slope) for slope in _start_slopes(unknowns, vector, data, body))
    # In NumPy: batched LAPACK calls inside a compiled program can starve XLA's thread pool of two, and hang.
    factors = (np.linalg.cholesky(np.eye(g.shape[1]) + g @ np.swapaxes(g, 1, 2)) for g in slopes)
    return [jnp.asarray(np.linalg.inv(factor)) for factor in factors]


def _residual(vector, unknowns: Unknowns, data: list[Batch], body: Body, whiten: list[Array], robust: bool):
    def one(batch, factor):
        errors = _errors(unknowns, vector, jnp.zeros((batch.step.shape[0], 16)), batch, body)
        if factor.shape[-1] == 1:
            return tempered(errors * factor[:, :, 0], robust)
        return tempered(jnp.einsum("wij,wj->wi", factor, errors), robust)

    return [one(batch, factor) for batch, factor in zip(data, whiten, strict=True)]


@eqx.filter_jit
def _solve(unknowns: Unknowns, vector, data: list[Batch], body: Body, whiten: list[Array], robust: bool, solver=None):
    residual = partial(_residual, unknowns=unknowns, data=data, body=body, whiten=whiten, robust=robust)
    return least_squares(residual, vector, solver=solver)


@eqx.filter_jit
def _linearise(unknowns: Unknowns, vector, data: list[Batch], body: Body, whiten: list[Array], robust: bool):
    residual = partial(_residual, unknowns=unknowns, data=data, body=body, whiten=whiten, robust=robust)
    return residual(vector), jax.jacfwd(residual)(vector)
