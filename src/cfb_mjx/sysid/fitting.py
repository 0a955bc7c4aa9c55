"""Refitting a model's parameters to flights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.parameters import Entry, ModelFile, Parameters
from cfb_mjx.sysid.flight_data import FlightData, prepare
from cfb_mjx.sysid.innovation import Noise, drive, innovations, negative_log_likelihood
from cfb_mjx.sysid.uncertainty import Uncertainty, assess
from cfb_mjx.sysid.unknowns import UNITS, Unknowns, choose

ROUNDS = 4
"""Noise levels and parameters are found in turns; the fourth round changes an estimate by far less than its std."""


@dataclass(frozen=True)
class Estimate:
    """One fitted quantity, SI."""

    value: float
    std: float
    unit: str
    preset: float


@dataclass(frozen=True)
class Fit:
    """Result of `fit`."""

    estimates: dict[str, Estimate]
    """Identified parameters."""
    unidentifiable: dict[str, str]
    """What the data cannot tell: name to explanation."""
    parameters: Parameters
    noise: Noise
    uncertainty: Uncertainty
    names: tuple[str, ...]
    rows: int
    whiteness: np.ndarray
    """Lag-one correlation of the innovations per channel: near 0 when the noise model fits."""

    def model_file(self, base: ModelFile, source: str) -> ModelFile:
        """``base`` with the fitted constants, their uncertainty and ``source``."""
        return describe(base, self, source)


def default_parameters(logs: list[FlightLog]) -> str:
    """What can usually be told: inertia, J_m and the motors; the thrust scale where rotor speed was measured."""
    measured = any(log.rotor_speed is not None for log in logs)
    return "inertia,rotor_inertia,motor_time_constant,motor_gain" + (",thrust_scale" if measured else "")


def fit(
    logs: list[FlightLog],
    nominal: Parameters,
    parameters: str | tuple[str, ...] | None = None,
    use_measured: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Fit:
    """Fit parameters by the likelihood of one-step innovations, safe under feedback (`cfb_mjx.sysid.innovation`).

    Args:
        logs: flights; run with x64 enabled.
        nominal: where to start, and the values of all that is not fitted.
        parameters: names or groups (`cfb_mjx.sysid.unknowns.choose`).
        use_measured: drive the body with measured rotor speeds where a log has them.
        progress: called with (done, total).

    Raises:
        CfbError: unknown parameters, or logs without enough contiguous data.
    """
    unknowns = choose(parameters or default_parameters(logs), nominal)
    data = prepare(list(logs))
    if data.segments is None or data.rows < 100:
        names = ", ".join(log.name for log in logs)
        raise CfbError(f"{names}: too short a flight to fit; at least a second without a gap is needed.")
    segments = jax.tree.map(jnp.asarray, data.segments)
    vector, noise = unknowns.start, _first_noise(data)
    for done in range(ROUNDS):
        noise = _fit_noise(unknowns, vector, noise, segments, use_measured)
        vector = _fit_vector(unknowns, vector, noise, segments, use_measured)
        if progress is not None:
            progress(done + 1, ROUNDS)
    residual, jacobian = (np.asarray(x) for x in _linearise(unknowns, vector, noise, segments, use_measured))
    uncertainty = assess(residual, jacobian @ np.linalg.inv(unknowns.slope(vector)), unknowns.names)
    return _result(unknowns, vector, noise, uncertainty, data.rows, residual)


def _first_noise(data: FlightData) -> Noise:
    rotor = data.rotor_speed_noise if np.isfinite(data.rotor_speed_noise) else 10.0
    return Noise(
        gyro=jnp.maximum(jnp.asarray(data.rate_noise), 1e-3),
        rate_walk=jnp.full(3, 0.3),
        disturbance=jnp.full(3, 4.0),
        accelerometer=jnp.maximum(jnp.asarray(data.specific_force_noise[2]), 1e-2),
        force_disturbance=jnp.asarray(0.5),
        rotor=jnp.asarray(max(rotor, 1.0)),
        rotor_disturbance=jnp.asarray(20.0),
    )


@eqx.filter_jit
def _fit_noise(unknowns: Unknowns, vector, noise: Noise, segments, use_measured: bool) -> Noise:
    parameters = unknowns.apply(vector)
    driven = drive(parameters, segments, use_measured)

    def loss(x, _):
        return negative_log_likelihood(parameters, Noise.from_vector(x), segments, driven)

    # BFGS may stop short where a level does not matter; the rounds that follow go on from there.
    solver = optx.BFGS(rtol=1e-5, atol=1e-6)
    found = optx.minimise(loss, solver, noise.to_vector(), max_steps=40, throw=False)
    return Noise.from_vector(found.value)


def _residual(vector, unknowns: Unknowns, noise: Noise, segments, use_measured: bool):
    parameters = unknowns.apply(vector)
    error, variance = innovations(parameters, noise, segments, drive(parameters, segments, use_measured))
    # The variance follows the parameters a little (the motors' lag); as a weight it must not be fitted.
    return error / jnp.sqrt(jax.lax.stop_gradient(variance))


@eqx.filter_jit
def _fit_vector(unknowns: Unknowns, vector, noise: Noise, segments, use_measured: bool):
    residual = partial(_residual, unknowns=unknowns, noise=noise, segments=segments, use_measured=use_measured)
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    found = optx.least_squares(
        lambda x, _: residual(x), solver, vector, options={"jac": "fwd"}, max_steps=60, throw=False
    )
    return found.value


@eqx.filter_jit
def _linearise(unknowns: Unknowns, vector, noise: Noise, segments, use_measured: bool):
    residual = partial(_residual, unknowns=unknowns, noise=noise, segments=segments, use_measured=use_measured)
    return residual(vector), jax.jacfwd(residual)(vector)


def _result(unknowns, vector, noise, uncertainty: Uncertainty, rows: int, residual: np.ndarray) -> Fit:
    values = np.asarray(unknowns.values(vector))
    std = uncertainty.std * unknowns.scale(vector)
    preset = np.asarray(unknowns.values(unknowns.start))
    known = [i for i, name in enumerate(unknowns.names) if name not in uncertainty.names]
    explained = "; identified: " + ", ".join(uncertainty.combinations) if uncertainty.combinations else ""
    return Fit(
        estimates={
            unknowns.names[i]: Estimate(float(values[i]), float(std[i]), UNITS[unknowns.names[i]], float(preset[i]))
            for i in known
        },
        unidentifiable={name: f"these flights cannot tell {name}{explained}" for name in uncertainty.names},
        parameters=unknowns.apply(vector),
        noise=noise,
        uncertainty=uncertainty,
        names=unknowns.names,
        rows=rows,
        whiteness=_whiteness(residual),
    )


def _whiteness(residual: np.ndarray) -> np.ndarray:
    now, before = residual[:, 1:], residual[:, :-1]
    both = np.sum(now * before, axis=(0, 1))
    return both / np.maximum(np.sqrt(np.sum(now**2, axis=(0, 1)) * np.sum(before**2, axis=(0, 1))), 1e-300)


_FILE_KEYS = {
    "mass": "mass",
    "rotor_inertia": "rotor_inertia",
    "motor_time_constant": "motor_time_constant",
    "motor_gain": "motor_gain",
    "thrust_scale": "thrust_scale",
    "torque_scale": "torque_scale",
}


def describe(base: ModelFile, result: Fit, source: str) -> ModelFile:
    """A model file with the fitted constants; see `Fit.model_file`."""
    entries = dict(base.entries)

    def put(key, value, std, note=""):
        entries[key] = Entry(np.asarray(value, dtype=float), source + note, std)

    def deviation(name):
        return result.estimates[name].std if name in result.estimates else None

    for name, key in _FILE_KEYS.items():
        if name in result.names:
            std = deviation(name)
            value = np.asarray(getattr(result.parameters, key))
            put(key, value, None if std is None else np.full(value.shape, std), "" if std else "; not identified alone")
    axes = [n for n in ("inertia_xx", "inertia_yy", "inertia_zz") if n in result.names]
    if axes:
        std = np.array([deviation(n) or np.nan for n in ("inertia_xx", "inertia_yy", "inertia_zz")])
        put("inertia", result.parameters.inertia, std if np.isfinite(std).all() else None, f" ({', '.join(axes)})")
    if "cog_x" in result.names or "cog_y" in result.names:
        put("center_of_gravity", result.parameters.center_of_gravity, None)
    return replace(base, entries=entries)
