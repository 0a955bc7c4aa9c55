"""Multiple shooting: parameters that predict best over a horizon, from the measured state of every window.

The classical estimator, right for flights without feedback or without unmodelled disturbances. Under feedback it is
biased (`cfb_mjx.sysid.innovation` says why and is the default); ``cfb fit`` shows its answer beside the default one.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rotors import rotor_speed_history
from cfb_mjx.model.state import State
from cfb_mjx.model.vector import Vec, multiply
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight_data import white_noise
from cfb_mjx.sysid.prediction import predict_one
from cfb_mjx.sysid.uncertainty import Uncertainty, assess
from cfb_mjx.sysid.unknowns import Unknowns, choose
from cfb_mjx.sysid.windows import find_windows

HORIZONS = (0.05, 0.1, 0.2)


class _LogWindows(eqx.Module):
    """One log's windows as arrays."""

    time: jax.Array
    command: jax.Array
    row: jax.Array
    since_row: jax.Array
    state: State
    step: jax.Array
    inputs: jax.Array
    at: jax.Array
    truth: State
    weight: jax.Array
    """(12,) one over the noise of position, velocity, attitude, body rate."""
    measured: bool = eqx.field(static=True)


def shoot(
    logs: list[FlightLog],
    nominal: Parameters,
    parameters: str | tuple[str, ...],
    horizons: tuple[float, ...] = HORIZONS,
    use_measured: bool = True,
) -> tuple[Unknowns, np.ndarray, Uncertainty]:
    """Least squares on the prediction errors at the horizons, weighted by the sensors' noise.

    Initial states are the measured ones; rotor speeds at the start are measured, or come from the commands since the
    log began. Returns the unknowns, the fitted vector and its uncertainty.

    Raises:
        CfbError: unknown parameters, or no window in any log.
    """
    unknowns = choose(parameters, nominal)
    prepared = [_prepare(log, nominal, horizons, use_measured) for log in logs]
    prepared = [item for item in prepared if item is not None]
    if not prepared:
        raise CfbError(f"{', '.join(log.name for log in logs)}: no prediction window fits; fly at least 1.2 s.")

    found = _solve(unknowns, prepared)
    residual, jacobian = (np.asarray(x) for x in _linearise(unknowns, found, prepared))
    return (
        unknowns,
        np.asarray(found),
        assess(residual, jacobian @ np.linalg.inv(unknowns.slope(found)), unknowns.names),
    )


def _residual(vector, unknowns: Unknowns, prepared: list[_LogWindows]):
    model = Quadrotor(unknowns.apply(vector), integrator="rk4", rotor_loads="instant")
    return jnp.concatenate([_log_residual(model, item) for item in prepared])


@eqx.filter_jit
def _solve(unknowns: Unknowns, prepared: list[_LogWindows]):
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    return optx.least_squares(
        lambda x, _: _residual(x, unknowns, prepared),
        solver,
        unknowns.start,
        options={"jac": "fwd"},
        max_steps=60,
        throw=False,
    ).value


@eqx.filter_jit
def _linearise(unknowns: Unknowns, vector, prepared: list[_LogWindows]):
    def residual(x):
        return _residual(x, unknowns, prepared)

    return residual(vector), jax.jacfwd(residual)(vector)


def _log_residual(model: Quadrotor, item: _LogWindows):
    start = item.state
    if not item.measured:
        parameters = model.parameters
        history = rotor_speed_history(parameters, item.time, item.command)[item.row]
        target = parameters.motor_gain * jnp.clip(item.command[item.row], 0, 1) + parameters.motor_speed_offset
        speed = target + (history - target) * jnp.exp(-item.since_row[:, None] / parameters.motor_time_constant)
        start = eqx.tree_at(lambda s: s.rotor_speed, start, speed)

    def one(state, step, inputs, at, truth):
        path = predict_one(model, state, step, inputs, item.measured)
        found = jax.tree.map(lambda x: x[at], path)
        turn = jax.vmap(lambda a, b: multiply(_conjugate(a), Vec.unstack(b)).stack())(
            truth.quaternion, found.quaternion
        )
        # Twice the vector part: the rotation vector of a small error, whichever sign the quaternion has.
        angle = 2 * turn[:, 1:] * jnp.sign(turn[:, :1])
        error = [found.position - truth.position, found.velocity - truth.velocity, angle]
        return jnp.concatenate([*error, found.body_rate - truth.body_rate], axis=1) * item.weight

    return jax.vmap(one)(start, item.step, item.inputs, item.at, item.truth)


def _conjugate(q) -> Vec:
    return Vec(q[0], -q[1], -q[2], -q[3])


def _prepare(log: FlightLog, nominal: Parameters, horizons, use_measured: bool) -> _LogWindows | None:
    delay = log.metadata.get("observation_delay")
    delay = float(nominal.observation_delay) if delay is None else delay
    windows = find_windows(log, horizons, delay)
    if not len(windows):
        return None
    measured = bool(use_measured and np.isfinite(windows.rotor_speed).all())

    def state(prefix: str) -> State:
        fields = [getattr(windows, prefix + name) for name in ("position", "velocity", "quaternion", "body_rate")]
        speed = windows.rotor_speed[:, 0] if measured and not prefix else np.zeros((*fields[0].shape[:-1], 4))
        return State(*fields, rotor_speed=speed)

    item = _LogWindows(
        time=log.time,
        command=log.command,
        row=windows.row,
        since_row=windows.start - log.time[windows.row],
        state=state(""),
        step=windows.step,
        inputs=windows.rotor_speed[:, 1:] if measured else windows.command,
        at=windows.at,
        truth=state("true_"),
        weight=1 / _noise(log),
        measured=measured,
    )
    return jax.tree.map(jnp.asarray, item)


def _noise(log: FlightLog) -> np.ndarray:
    """(12,) noise of a row, from third differences; both ends of a window carry it."""

    def level(values):
        return np.maximum(white_noise(values), 1e-6)

    attitude = 2 * level(log.quaternion[:, 1:])
    return np.sqrt(2) * np.concatenate([level(log.position), level(log.velocity), attitude, level(log.body_rate)])
