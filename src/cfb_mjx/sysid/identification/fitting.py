"""Refitting a model's parameters to flights."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from cfb_mjx.devices import Devices
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification.feedback import detect
from cfb_mjx.sysid.identification.flight_data import Segments, prepare
from cfb_mjx.sysid.identification.innovation import CHANNELS, drive, negative_log_likelihood, whitened
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.result import Fit, summarise
from cfb_mjx.sysid.identification.robust import tempered
from cfb_mjx.sysid.identification.shooting import shoot
from cfb_mjx.sysid.identification.solver import least_squares
from cfb_mjx.sysid.identification.uncertainty import assess
from cfb_mjx.sysid.identification.unknowns import Unknowns, choose

ROUNDS = 8
"""Noise levels and parameters are found in turns, at most so often."""
SETTLED = 5e-4
"""A round that changes no parameter by more than this share is the last."""
BLOCK = 128
"""Rows the bootstrap keeps together: half a second at 250 Hz, longer than the disturbance stays correlated."""


EXTRAS = ("motor_speed_offset", "thrust_linear")
"""Fitted by default where rotor speed was measured, and kept where they differ from the preset by `CLEAR` deviations:
on real motors the steady speed is affine in the command, and the thrust's slope near hover is not the paper's."""
CLEAR = 4.0


def default_parameters(logs: list[FlightLog]) -> str:
    """What can usually be told: inertia, J_m, motors and trim; the thrust scale where rotor speed was measured."""
    measured = any(log.rotor_speed is not None for log in logs)
    return "inertia,rotor_inertia,motor_time_constant,motor_gain,cog" + (",thrust_scale" if measured else "")


def fit(
    logs: list[FlightLog],
    nominal: Parameters,
    parameters: str | tuple[str, ...] | None = None,
    use_measured: bool = True,
    robust: bool = False,
    estimator: Literal["auto", "innovation", "shooting"] = "auto",
    progress: Callable[[int, int], None] | None = None,
    over: Devices | None = None,
) -> Fit:
    """Fit parameters to flights; what the flights cannot tell gets no number.

    Args:
        logs: flights; run with x64 enabled.
        nominal: where to start, and the values of all that is not fitted.
        parameters: names or groups (`unknowns.choose`); None takes `default_parameters`, and those of
            `EXTRAS` that the flights ask for.
        use_measured: drive the body with measured rotor speeds where a log has them.
        robust: let outliers count linearly instead of squared.
        estimator: ``innovation``, safe under feedback (`innovation`), or ``shooting``
            (`shooting`), which is not. ``auto`` takes the first, which is right with and without
            feedback, unless the observation delay is asked for: that shows in the pose only, which it does not read.
        progress: called with (done, total).
        over: devices to divide the segments of the flights over.

    Raises:
        CfbError: unknown parameters, or logs without enough contiguous data.
    """
    if parameters is None:
        base = default_parameters(logs)
        if estimator == "shooting" or not use_measured or "thrust_scale" not in base:
            return fit(logs, nominal, base, use_measured, robust, estimator, progress, over)
        whole = fit(logs, nominal, ",".join([base, *EXTRAS]), use_measured, robust, estimator, progress, over)
        kept = [name for name in EXTRAS if _differs(whole, name)]
        if len(kept) == len(EXTRAS):
            return whole
        return fit(logs, nominal, ",".join([base, *kept]), use_measured, robust, estimator, progress, over)
    unknowns = choose(parameters, nominal)
    if estimator == "auto":
        estimator = "shooting" if "pose_delay" in unknowns.names else "innovation"
    if estimator == "shooting":
        return shoot(
            logs, nominal, unknowns.names, use_measured=use_measured, robust=robust, progress=progress, over=over
        )
    data = prepare(list(logs))
    if data.segments is None or data.rows < 100:
        names = ", ".join(log.name for log in logs)
        raise CfbError(f"{names}: too short a flight to fit; at least a second without a gap is needed.")
    segments = _on_devices(data.segments, over)
    vector, noise = unknowns.start, Noise.first(data)
    if over is not None:  # placed as the rounds return it, or the second would compile anew
        vector, noise = over.whole((vector, noise))
    for done in range(ROUNDS):
        before = vector
        noise = fit_noise(unknowns, vector, noise, segments, use_measured, robust)
        vector = _fit_vector(unknowns, vector, noise, segments, use_measured, robust)
        if progress is not None:
            progress(done + 1, ROUNDS)
        if done and float(jnp.max(jnp.abs(vector - before))) < SETTLED:
            break
    if progress is not None:
        progress(ROUNDS, ROUNDS)
    linear = fit_slopes(unknowns, vector, noise, segments, use_measured, robust)
    return _finish(unknowns, vector, noise, segments, *linear, data.rows)


def _on_devices(segments: Segments, over: Devices | None) -> Segments:
    if over is None or not over.several:
        return jax.tree.map(jnp.asarray, segments)
    # What is added to divide evenly counts for nothing.
    valid = np.concatenate([segments.valid, np.zeros((-len(segments.valid) % over.count, segments.valid.shape[1]))])
    return eqx.tree_at(lambda s: s.valid, over.shared(segments), over.along(valid))


def _finish(unknowns: Unknowns, vector, noise: Noise, segments: Segments, residual, jacobian, rows: int) -> Fit:
    residual, jacobian = np.asarray(residual), np.asarray(jacobian)
    slope = np.linalg.inv(unknowns.slope(vector))
    uncertainty = assess(*in_blocks(segments, residual, jacobian @ slope), unknowns.names)
    whiteness = dict(zip(CHANNELS, map(float, _lag_one(residual)), strict=True))
    more = {"noise": noise, "whiteness": whiteness, "feedback": detect(segments, residual)}
    return summarise(unknowns, vector, uncertainty, "innovation", rows, **more)


def _differs(result: Fit, name: str) -> bool:
    found = result.estimates.get(name)
    return found is not None and abs(found.value - found.preset) > CLEAR * found.std


@eqx.filter_jit
def fit_noise(unknowns: Unknowns, vector, noise: Noise, segments: Segments, use_measured: bool, robust: bool) -> Noise:
    """Noise levels of largest likelihood at ``vector``, from ``noise`` on; at most some forty steps."""
    parameters = unknowns.apply(vector)
    # The smoothed rotor speeds stay those of the last round's noise: the rotors' own readings say how noisy they are.
    driven = drive(parameters, noise, segments, use_measured, robust)

    def loss(x, _):
        return negative_log_likelihood(parameters, Noise.from_vector(x), segments, driven, robust)

    # BFGS may stop short where a level does not matter; the rounds that follow go on from there.
    solver = optx.BFGS(rtol=1e-5, atol=1e-6)
    found = optx.minimise(loss, solver, noise.to_vector(), max_steps=40, throw=False)
    return Noise.from_vector(found.value)


def _residual(vector, unknowns: Unknowns, noise: Noise, segments: Segments, use_measured: bool, robust: bool):
    return tempered(whitened(unknowns.apply(vector), noise, segments, use_measured, robust), robust)


@eqx.filter_jit
def _fit_vector(unknowns: Unknowns, vector, noise: Noise, segments: Segments, use_measured: bool, robust: bool):
    residual = partial(
        _residual, unknowns=unknowns, noise=noise, segments=segments, use_measured=use_measured, robust=robust
    )
    return least_squares(residual, vector)


@eqx.filter_jit
def fit_slopes(unknowns: Unknowns, vector, noise: Noise, segments: Segments, use_measured: bool, robust: bool):
    """Residuals (s, n, 8) of the fit at ``vector``, and their derivatives (s, n, 8, k) by it."""
    residual = partial(
        _residual, unknowns=unknowns, noise=noise, segments=segments, use_measured=use_measured, robust=robust
    )
    return residual(vector), jax.jacfwd(residual)(vector)


def in_blocks(segments: Segments, residual: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and Jacobians cut into blocks of `BLOCK` rows, without those in which nothing counts."""
    counts = np.asarray(segments.valid * (1 - segments.warm_up))[:, 1:].reshape(-1, BLOCK).any(axis=1)
    channels, k = jacobian.shape[-2:]
    return residual.reshape(-1, BLOCK, channels)[counts], jacobian.reshape(-1, BLOCK, channels, k)[counts]


def _lag_one(residual: np.ndarray) -> np.ndarray:
    now, before = residual[:, 1:], residual[:, :-1]
    both = np.sum(now * before, axis=(0, 1))
    return both / np.maximum(np.sqrt(np.sum(now**2, axis=(0, 1)) * np.sum(before**2, axis=(0, 1))), 1e-300)
