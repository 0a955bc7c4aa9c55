"""How well a flight will tell the parameters, before it is flown.

`cfb fit` maximises the likelihood of one-step innovations (`sysid.identification.innovation`). Its Fisher information
is J^T J, with J the Jacobian of the whitened innovations at the true parameters, which in a simulated flight are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rotors import thrust
from cfb_mjx.model.state import State
from cfb_mjx.sysid.excitation.manoeuvres import STEP
from cfb_mjx.sysid.identification.flight_data import Segments, prepare
from cfb_mjx.sysid.identification.innovation import Noise, drive, innovations
from cfb_mjx.sysid.identification.uncertainty import LOOSEST, Uncertainty, assess
from cfb_mjx.sysid.identification.unknowns import UNITS, Unknowns

_ROUNDS = 2
BLOCK = 128
"""Rows the bootstrap keeps together, as in the fit: half a second at 250 Hz."""
_HOVER_ROWS = 50
"""Hover before the manoeuvre in `window_information`: by then the filter knows the disturbance as well as it can."""


@dataclass(frozen=True)
class Expected:
    """One parameter's expected uncertainty, SI."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class Prediction:
    """What `cfb fit` will be able to say.

    Attributes:
        names: of all that is asked for.
        parameters: those that can be told.
        unidentifiable: names of those that cannot.
        combinations: what can be told of them together.
        uncertainty: relative covariance, correlation.
        noise: levels found in the simulated flight.
    """

    names: tuple[str, ...]
    parameters: dict[str, Expected]
    unidentifiable: list[str]
    combinations: list[str]
    uncertainty: Uncertainty
    noise: Noise


class Linearised(eqx.Module):
    """The fit's residuals about the true parameters."""

    residual: Float[np.ndarray, "blocks rows 8"]
    """Whitened innovations at the truth, in blocks of `BLOCK` rows."""
    jacobian: Float[np.ndarray, "blocks rows 8 k"]
    """Their derivatives by relative changes of the quantities (offsets: in their units)."""
    noise: Noise


def linearise(logs: list[FlightLog], unknowns: Unknowns, use_measured: bool = True) -> Linearised:
    """Residuals and Jacobian of the fit at ``unknowns.nominal``, the truth, with noise levels of maximum likelihood.

    Args:
        logs: simulated flights, with noise and disturbances.
        unknowns: what would be fitted.
        use_measured: drive the body with measured rotor speeds where there are some.

    Raises:
        CfbError: a parameter that does not show in the innovations.
    """
    if "observation_delay" in unknowns.names:
        raise CfbError("--parameters observation_delay: a manoeuvre cannot be designed for it; leave it out.")
    data = prepare(list(logs))
    segments = jax.tree.map(jnp.asarray, data.segments)
    noise = Noise.first(data)
    for _ in range(_ROUNDS):
        noise = _levels(unknowns, noise, segments, use_measured)
    residual, jacobian = (np.asarray(x) for x in _linearise(unknowns, noise, segments, use_measured))
    counts = np.asarray(segments.valid * (1 - segments.warm_up))[:, 1:]
    jacobian = jacobian @ per_relative_change(unknowns)
    return Linearised(_blocks(residual, counts), _blocks(jacobian, counts), noise)


def predict(logs: list[FlightLog], unknowns: Unknowns, use_measured: bool = True) -> Prediction:
    """Uncertainty of a fit to simulated flights; arguments and errors as `linearise`."""
    at_truth = linearise(logs, unknowns, use_measured)
    found = assess(at_truth.residual, at_truth.jacobian, unknowns.names)
    values, std = np.asarray(unknowns.values(unknowns.start)), found.std * unknowns.scale(unknowns.start)
    known = {
        name: Expected(float(values[i]), float(std[i]), UNITS[name])
        for i, name in enumerate(unknowns.names)
        if name not in found.names
    }
    return Prediction(unknowns.names, known, found.names, found.combinations, found, at_truth.noise)


def typical(predictions: list[Prediction]) -> Prediction:
    """The middle one, from the surest to the least sure: noise makes a single flight's bootstrap jump."""

    def unsure(prediction: Prediction) -> tuple[int, float]:
        return len(prediction.unidentifiable), float(np.log(prediction.uncertainty.std).sum())

    return sorted(predictions, key=unsure)[len(predictions) // 2]


def _blocks(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(s, n, ...) cut into blocks of `BLOCK` consecutive rows, without those in which nothing counts."""
    more = -values.shape[1] % BLOCK
    padded = np.pad(values, [(0, 0), (0, more)] + [(0, 0)] * (values.ndim - 2)).reshape(-1, BLOCK, *values.shape[2:])
    return padded[np.pad(counts, [(0, 0), (0, more)]).reshape(-1, BLOCK).any(axis=1)]


@eqx.filter_jit
def _levels(unknowns: Unknowns, noise: Noise, segments: Segments, use_measured: bool) -> Noise:
    driven = drive(unknowns.nominal, noise, segments, use_measured)

    def loss(x, _):
        error, variance = innovations(unknowns.nominal, Noise.from_vector(x), segments, driven)
        return 0.5 * jnp.sum(jnp.log(variance) + error**2 / variance) / jnp.sum(segments.valid)

    solver = optx.BFGS(rtol=1e-5, atol=1e-6)
    return Noise.from_vector(optx.minimise(loss, solver, noise.to_vector(), max_steps=60, throw=False).value)


@eqx.filter_jit
def _linearise(unknowns: Unknowns, noise: Noise, segments: Segments, use_measured: bool):
    def residual(x):
        return whitened(unknowns.apply(x), noise, segments, use_measured)

    return residual(unknowns.start), jax.jacfwd(residual)(unknowns.start)


def whitened(parameters, noise: Noise, segments: Segments, use_measured: bool) -> Float[Array, "s n 8"]:
    """Innovations over their standard deviations, which as weights are not differentiated (as in the fit)."""
    error, variance = innovations(parameters, noise, segments, drive(parameters, noise, segments, use_measured))
    return error / jnp.sqrt(jax.lax.stop_gradient(variance))


def window_information(
    model: Quadrotor,
    commands: Float[Array, "n 4"],
    path: State,
    unknowns: Unknowns,
    noise: Noise,
    measured_rotors: bool,
    relative: Float[Array, "k k"],
) -> Float[Array, "k k"]:
    """Fisher information of one undisturbed manoeuvre after hover; differentiable in the commands.

    Args:
        model: the true drone; its parameters are those of ``unknowns``.
        commands: (n, 4) of the manoeuvre.
        path: (n,) states after each of them (`cfb_mjx.sysid.excitation.manoeuvres.flown`).
        unknowns: what is to be told.
        noise: levels.
        measured_rotors: whether rotor speed is logged.
        relative: `per_relative_change` of the unknowns.

    Returns:
        (k, k), for relative changes of the quantities (offsets: cm).
    """
    hover = jnp.broadcast_to(model.hover_command(), (_HOVER_ROWS, 4))
    start = model.hover_state()
    count = _HOVER_ROWS + commands.shape[0]
    path = jax.tree.map(
        lambda s, x: jnp.concatenate([jnp.broadcast_to(s, (_HOVER_ROWS + 1, *s.shape)), x])[:count], start, path
    )
    force = jax.vmap(lambda speed: jnp.sum(thrust(model.parameters, speed)))(path.rotor_speed) / model.parameters.mass
    row = jnp.arange(count)
    data = Segments(
        interval=jnp.where(row == 0, 0.0, STEP),
        valid=jnp.ones(count),
        command=jnp.concatenate([hover, commands]),
        rotor_speed=path.rotor_speed,
        measured=jnp.asarray(float(measured_rotors)),
        warm_up=(row < _HOVER_ROWS).astype(float),
        body_rate=path.body_rate,
        specific_force=jnp.stack([0 * force, 0 * force, force], axis=1),
    )
    data = jax.tree.map(lambda x: x[None], data)
    jacobian = jax.jacfwd(lambda x: whitened(unknowns.apply(x), noise, data, measured_rotors))(unknowns.start)
    jacobian = jacobian.reshape(-1, len(unknowns.names)) @ relative
    return jacobian.T @ jacobian


def per_relative_change(unknowns: Unknowns) -> np.ndarray:
    """(k, k) derivative of the fit's vector by relative changes of the quantities (offsets: in their units)."""
    return np.linalg.inv(unknowns.slope(unknowns.start))


def log_determinant(information: Float[Array, "k k"]) -> Float[Array, ""]:
    """D-optimality: log det of the information, with the little known before (50 %, where a fit gives up)."""
    return jnp.linalg.slogdet(information + jnp.eye(len(information)) / LOOSEST**2)[1]


def marginal_std(information: Float[Array, "k k"]) -> np.ndarray:
    """(k,) standard deviations with everything else unknown, of relative changes (offsets: cm)."""
    information = np.asarray(information)
    return np.sqrt(np.diag(np.linalg.inv(information + np.eye(len(information)) / LOOSEST**2)))
