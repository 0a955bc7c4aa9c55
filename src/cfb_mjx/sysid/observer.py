"""Disturbance observer: estimates slowly varying torques and forces from a flight's past, to improve predictions.

Real drones are subject to torques and forces that no model describes and that vary slowly. Kalman filters run along the
log. For each body axis, one filter estimates the body rate and two angular accelerations, a fast and a slow one (trim),
and another one the error of the specific force. For each motor whose rotor speed was measured, a filter estimates the
error of the modelled rotor speed and of its steady value. The filters of the body use the model's replay of the flight
(`replay`). The estimates at a window's start are added to the prediction and decay with their correlation times
(``docs/nanodrone.md``).

The observer is causal: an estimate uses gyro, accelerometer, commands, voltage and rotor speeds up to its row. Attitude
and velocity enter only through the model's effects, with ``pose_delay`` removed as for a window's initial state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from cfb_mjx.devices import last_repeated
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import AnyArray
from cfb_mjx.sysid.flight import MEASURED_SHARE, Flight, delay_of, lengthened, prepare_flight
from cfb_mjx.sysid.replay import Lane, Replay, replays
from cfb_mjx.sysid.windows import Windows

RIDGE = 1e-3
"""Weight, per row of a fit, of the prior on the logarithms of the noise levels. Levels that the data do not determine
keep their initial values."""

AGREES = 0.05
"""Time over which the model's relative error of angular acceleration is correlated, s: the motors' lag."""
TURN = 10.0
"""Angular acceleration to which ``rate_share`` refers, rad/s^2."""


class Observer(eqx.Module):
    """Noise levels of the filters: standard deviations and correlation times.

    The default values give the best half-second predictions on real flights of the Crazyflie Brushless
    (`observer_tuning`, on the flights used for fitting in ``docs/closing-real-flights.md``).
    """

    gyro: float = 0.08
    """White measurement noise of the gyro per row, rad/s."""
    rate_walk: float = 0.2
    """White angular acceleration, rad/s per square root of a second."""
    rate_share: float = 0.4
    """Relative error of the model's angular acceleration, at `TURN`. It is proportional to the angular acceleration,
    because fast manoeuvres reveal less about the disturbance."""
    torque: tuple[float, float, float] = (2.0, 2.0, 0.6)
    """Fast disturbance: angular acceleration, rad/s^2."""
    torque_time: float = 0.25
    """Correlation time of ``torque``, s."""
    trim: tuple[float, float, float] = (2.0, 2.0, 1.0)
    """Slow disturbance: angular acceleration, rad/s^2."""
    trim_time: float = 200.0
    """Correlation time of ``trim``, s."""
    accelerometer: float = 0.6
    """White measurement noise of the accelerometer per row, m/s^2."""
    force_share: float = 0.7
    """Relative error of the model's specific force in excess of hover."""
    force: tuple[float, float, float] = (0.05, 0.1, 0.6)
    """Disturbance of the specific force, m/s^2."""
    force_time: float = 0.4
    """Correlation time of ``force``, s."""
    rotor: float = 10.0
    """White measurement noise of the rotor speed per row, rad/s."""
    rotor_walk: float = 110.0
    """White rotor acceleration, rad/s per square root of a second."""
    rotor_offset: float = 15.0
    """Slowly varying error of the steady rotor speed, rad/s."""
    rotor_offset_time: float = 0.2
    """Correlation time of ``rotor_offset``, s."""


class _Levels(eqx.Module):
    """The levels of an `Observer` as arrays; those of three axes in one array."""

    gyro: Array
    rate_walk: Array
    rate_share: Array
    torque: Array
    torque_time: Array
    trim: Array
    trim_time: Array
    accelerometer: Array
    force_share: Array
    force: Array
    force_time: Array
    rotor: Array
    rotor_walk: Array
    rotor_offset: Array
    rotor_offset_time: Array

    @classmethod
    def of(cls, observer: Observer) -> _Levels:
        numbers = {f.name: getattr(observer, f.name) for f in dataclasses.fields(observer)}
        return cls(**{name: jnp.asarray(number, jnp.result_type(float)) for name, number in numbers.items()})


FORECASTER = Observer(
    gyro=0.04,
    rate_walk=0.4,
    torque_time=0.125,
    trim=(0.5, 0.5, 0.25),
    force_share=0.35,
    force=(0.05, 0.025, 1.2),
)
"""Levels for use with a predictor, tuned with the nano-drone benchmark's sums on the same flights. A predictor has been
fitted to compensate its own errors, so its errors of angular acceleration decay sooner."""


def usual_observer(kind: str) -> Observer:
    """Default levels for a model of this kind (`ModelFile.kind`)."""
    return FORECASTER if kind == "predictor" else Observer()


class Observed(eqx.Module):
    """Estimates of an observer at each row, from that row and earlier ones; or at each window's start."""

    body_rate: Float[AnyArray, "n 3"]
    """Filtered body rate, rad/s."""
    angular_acceleration: Float[AnyArray, "n 3"]
    """Angular acceleration of the model with the disturbances over the last interval, rad/s^2."""
    torque: Float[AnyArray, "n 3"]
    """Unmodelled angular acceleration that decays with ``torque_time``, rad/s^2."""
    trim: Float[AnyArray, "n 3"]
    """Unmodelled angular acceleration that decays with ``trim_time``, rad/s^2."""
    force: Float[AnyArray, "n 3"]
    """Unmodelled specific force, body axes, m/s^2."""
    rotor_speed: Float[AnyArray, "n 4"]
    """Rotor speed from the commands, corrected by measurements, rad/s."""
    rotor_offset: Float[AnyArray, "n 4"]
    """Error of the steady rotor speed, rad/s; zero if rotor speed was not measured."""

    def memory(self, rotors: bool) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Memory of a `disturbance.Disturbance`, with or without the offsets of the ``rotors``."""
        return self.torque, self.trim, self.force, self.rotor_offset * rotors


def observe(model: Quadrotor, log: FlightLog, delay: float, observer: Observer, use_measured: bool = True) -> Observed:
    """Run an observer along a log.

    Args:
        model: the drone.
        log: the flight, n rows.
        delay: age of pose and velocity in a row, s.
        observer: noise levels.
        use_measured: if the log has measured rotor speeds, drive the body with them and correct the motors by them.

    Returns:
        Estimates as NumPy arrays, one row per row of the log.
    """
    inputs = replay_inputs(log, delay, float(model.parameters.gyro_delay), use_measured)
    found = _observe(model, *_replayed(model, *inputs), _Levels.of(observer))
    return jax.tree.map(lambda x: np.asarray(x)[: len(log)], found)


def at_starts(found: Observed, log: FlightLog, windows: Windows) -> Observed:
    """Estimates at the starts of W windows, fields (W, ...): those of the row before, the body rate extrapolated to t0.

    Args:
        found: estimates at the rows of the log.
        log: the flight.
        windows: W windows of the log.
    """
    here = jax.tree.map(lambda x: x[windows.row], found)
    since = (windows.start - log.time[windows.row])[:, None]
    return eqx.tree_at(lambda o: o.body_rate, here, here.body_rate + since * here.angular_acceleration)


def fit_observer(model: Quadrotor, logs: Sequence[FlightLog], observer: Observer | None = None) -> Observer:
    """Fit the noise levels by maximum likelihood of the filters' innovations.

    Args:
        model: the drone, with the effects with which it will be used.
        logs: flights that are not used for evaluation.
        observer: initial levels, which are kept where the logs do not determine them (those of the rotors, without
            measured rotor speeds).

    Raises:
        CfbError: there are no logs.
    """
    if not logs:
        raise CfbError("fit_observer needs at least one log.")
    first = _Levels.of(observer or Observer())
    data: list[tuple[Quadrotor, Flight, AnyArray, Replay]] = []
    for log in logs:
        flight, driven = replay_inputs(log, delay_of(log, model.parameters), float(model.parameters.gyro_delay))
        data.append((model, *_replayed(model, flight, driven)))
    leaves, structure = jax.tree.flatten(first)
    sizes = [leaf.size for leaf in leaves]

    def levels(vector: Array) -> _Levels:
        parts = jnp.split(vector, np.cumsum(sizes)[:-1])
        return jax.tree.unflatten(
            structure, [leaf * jnp.exp(part.reshape(leaf.shape)) for leaf, part in zip(leaves, parts, strict=True)]
        )

    @eqx.filter_jit
    def cost(vector: Array, data: tuple[tuple[Quadrotor, Flight, AnyArray, Replay], ...]) -> Array:
        total = sum(_surprise(*one, levels(vector)) for one in data)
        rows = sum(jnp.sum(one[1].valid) for one in data)
        return total / rows + RIDGE * jnp.sum(vector**2)

    solver = optx.BFGS(rtol=1e-3, atol=1e-3)
    start = jnp.zeros(sum(sizes), jnp.result_type(float))
    best = optx.minimise(cost, solver, start, tuple(data), max_steps=60, throw=False).value
    found = levels(best)
    arrays = {f.name: np.asarray(getattr(found, f.name)) for f in dataclasses.fields(found)}
    values: dict[str, Any] = {name: tuple(x.tolist()) if x.ndim else float(x) for name, x in arrays.items()}
    return Observer(**values)


def replay_inputs(
    log: FlightLog, delay: float, gyro_delay: float, use_measured: bool = True
) -> tuple[Flight, np.ndarray]:
    """Prepared flight and rotor speeds (n, 4), rad/s, that drive the body; these are used if ``measured`` is 1."""
    flight = prepare_flight(log, delay, gyro_delay)
    driven = causal_rotor_speed(log) if use_measured else None
    used = 1.0 if driven is not None else 0.0
    driven = np.zeros((len(log), 4)) if driven is None else driven
    return eqx.tree_at(lambda f: f.measured, flight, np.array(used)), last_repeated(driven, len(flight.time))


def causal_rotor_speed(log: FlightLog) -> np.ndarray | None:
    """Measured rotor speeds (n, 4), rad/s, invalid readings replaced by the last valid one; None if not measured."""
    if log.rotor_speed is None or (np.isfinite(log.rotor_speed).mean(axis=0) < MEASURED_SHARE).any():
        return None
    out = log.rotor_speed.copy()
    for motor in range(4):
        good = np.isfinite(out[:, motor])
        last = np.maximum.accumulate(np.where(good, np.arange(len(out)), -1))
        out[:, motor] = out[np.where(last >= 0, last, np.argmax(good)), motor]
    return out


def _replayed(model: Quadrotor, flight: Flight, driven: np.ndarray) -> tuple[Flight, np.ndarray, Replay]:
    """Flight, rotor speeds that drive it and the model's replay, padded so that compiled filters can be reused."""
    (said,) = replays(model, [Lane(flight, driven)])
    flight, (driven, said) = lengthened(flight, (driven, said))
    return flight, driven, said


@eqx.filter_jit
def _observe(model: Quadrotor, flight: Flight, driven: AnyArray, said: Replay, observer: _Levels) -> Observed:
    body, _ = _body(model, flight, said, observer)
    motors, _ = _motors(model, flight, driven, said, observer)
    return Observed(*body, *motors)


def _surprise(model: Quadrotor, flight: Flight, driven: AnyArray, said: Replay, observer: _Levels) -> Array:
    """Negative log-likelihood of all innovations, up to a constant."""
    _, errors = _body(model, flight, said, observer)
    _, motor_errors = _motors(model, flight, driven, said, observer)

    def of(error, variance, counts):
        return 0.5 * jnp.sum(counts[:, None] * (jnp.log(variance) + error**2 / variance))

    turning, pushing = errors
    counts = flight.valid * (1 - flight.fresh)
    return of(*turning, counts) + of(*pushing, counts) + of(*motor_errors[0], counts * flight.measured)


def _before(x: AnyArray) -> Array:
    """Shift values for the interval after each row to the interval before each row."""
    return jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]])


def _body(model: Quadrotor, flight: Flight, said: Replay, o: _Levels):
    """Body rate, angular acceleration, its unmodelled parts, unmodelled force; and innovations with variances."""

    def axis(rate, model_rate, torque, trim):
        def row(carry, inputs):
            (w, a, b), p = carry
            dt, alpha, gyro, fresh = inputs
            quick, slow = jnp.exp(-dt / o.torque_time), jnp.exp(-dt / o.trim_time)
            reach = o.torque_time * (1 - quick)
            move = jnp.array([[1.0, reach, dt], [0.0, quick, 0.0], [0.0, 0.0, slow]])
            walk = o.rate_walk**2 + (o.rate_share * alpha * alpha / TURN) ** 2 * AGREES
            noise = jnp.stack([walk * dt, torque**2 * (1 - quick**2), trim**2 * (1 - slow**2)])
            x = move @ jnp.stack([w, a, b]) + jnp.stack([alpha * dt, 0.0, 0.0])
            p = move @ p @ move.T + jnp.diag(noise)
            variance, error = p[0, 0] + o.gyro**2, gyro - x[0]
            gain = p[:, 0] / variance
            kept = x + gain * error, p - jnp.outer(gain, p[0])
            # After a gap only the trim is still known.
            anew = jnp.stack([gyro, 0.0, x[2]]), jnp.diag(jnp.stack([o.gyro**2, torque**2, p[2, 2]]))
            x, p = jax.tree.map(lambda new, old: jnp.where(fresh > 0, new, old), anew, kept)
            total = alpha + jnp.where(fresh > 0, 0.0, x[1]) + x[2]
            return (x, p), (x, total, error, variance)

        start = jnp.stack([rate[0], 0.0, 0.0]), jnp.diag(jnp.stack([o.gyro**2, torque**2, trim**2]))
        return jax.lax.scan(row, start, (interval, model_rate, rate, flight.fresh))[1]

    def push(carry, inputs):
        d, p = carry
        dt, model_force, measured, fresh = inputs
        keep = jnp.exp(-dt / o.force_time)
        d, p = keep * d, keep**2 * p + o.force**2 * (1 - keep**2)
        beyond = model_force - hover
        missed = o.force_share**2 * (beyond @ beyond)
        variance, error = p + o.accelerometer**2 + missed, measured - model_force - d
        gain = jnp.where(fresh > 0, 0.0, p / variance)
        return (d + gain * error, (1 - gain) * p), (d + gain * error, error, jnp.broadcast_to(variance, (3,)))

    hover = model.parameters.gravity * jnp.array([0.0, 0.0, 1.0])
    interval, alpha, force = _before(flight.interval), _before(said.angular_acceleration), _before(said.specific_force)
    levels = flight.body_rate, alpha, o.torque, o.trim
    state, total, error, variance = jax.vmap(axis, in_axes=(1, 1, 0, 0), out_axes=1)(*levels)
    rows = interval, force, flight.specific_force, flight.fresh
    _, (pushed, push_error, push_variance) = jax.lax.scan(push, (jnp.zeros(3), o.force**2), rows)
    known = state[..., 0], total, state[..., 1], state[..., 2], pushed
    return known, ((error, variance), (push_error, push_variance))


def _motors(model: Quadrotor, flight: Flight, driven: AnyArray, said: Replay, o: _Levels):
    """Rotor speed and the error of its steady value; and innovations with variances.

    The error e of the modelled speed follows the error b of its steady value with the motors' lag: T e' = b - e. So the
    filter does not depend on how effects change the motors.
    """
    lag = jnp.mean(model.changed_parameters().motor_time_constant)
    used = flight.measured

    def row(carry, inputs):
        x, b, pxx, pxb, pbb = carry
        dt, measured = inputs
        keep, decay = jnp.exp(-dt / o.rotor_offset_time), jnp.exp(-dt / lag)
        mix = 1 - decay
        x, b = decay * x + mix * b, keep * b
        pxx, pxb, pbb = (
            decay**2 * pxx + 2 * decay * mix * pxb + mix**2 * pbb + o.rotor_walk**2 * dt,
            keep * (decay * pxb + mix * pbb),
            keep**2 * pbb + o.rotor_offset**2 * (1 - keep**2),
        )
        variance, error = pxx + o.rotor**2, measured - x
        kx, kb = used * pxx / variance, used * pxb / variance
        x, b = x + kx * error, b + kb * error
        pxx, pxb, pbb = (1 - kx) * pxx, (1 - kx) * pxb, pbb - kb * pxb
        return (x, b, pxx, pxb, pbb), (x, b, error, jnp.broadcast_to(variance, (4,)))

    gap = used * (driven - said.rotor_speed)
    start = gap[0], jnp.zeros(4), o.rotor**2, jnp.zeros(()), o.rotor_offset**2
    _, (x, b, error, variance) = jax.lax.scan(row, start, (_before(flight.interval), gap))
    return (said.rotor_speed + x, b), ((error, variance),)
