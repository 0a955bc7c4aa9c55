"""Multiple shooting: parameters that predict best over a horizon, from the measured state of every window.

The classical estimator, right for flights without feedback or without unmodelled disturbances. Under feedback it is
biased (`innovation` says why and is the default); ``cfb fit --compare`` shows its answer beside the
default one.

A window starts at a measured state, which carries noise, and at rotor speeds nobody may have measured. With free
initial states these errors are unknowns too, as likely as the sensors' noise says; being many and each seen by its own
window only, they are eliminated: with r the prediction errors at the measured start, whitened by the sensors' noise,
and G their derivative by the start's errors in standard deviations, the covariance of r is I + G G^T, and r is whitened
by the inverse of its Cholesky factor (generalised least squares; the same estimate as fitting every start).
"""

from __future__ import annotations

from collections.abc import Callable
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
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification.result import Fit, summarise
from cfb_mjx.sysid.identification.robust import tempered
from cfb_mjx.sysid.identification.shooting_data import Batch, batches
from cfb_mjx.sysid.identification.solver import least_squares
from cfb_mjx.sysid.identification.uncertainty import assess
from cfb_mjx.sysid.identification.unknowns import Unknowns, choose
from cfb_mjx.sysid.prediction import predict_one

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
    uncertainty = assess(residual[live], jacobian[live] @ slope, unknowns.names)
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
