"""Expected uncertainty of the parameters from a flight, before it is flown.

`cfb fit` maximises the likelihood of one-step innovations (`sysid.identification.innovation`). Its Fisher information
is J^T J, where J is the Jacobian of the whitened innovations at the true parameters. In a simulated flight these are
known.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rotors import thrust
from cfb_mjx.model.state import AnyArray, State
from cfb_mjx.sysid.excitation.manoeuvres import STEP
from cfb_mjx.sysid.identification.fitting import fit_noise, fit_slopes, in_blocks
from cfb_mjx.sysid.identification.flight_data import Segments, prepare
from cfb_mjx.sysid.identification.innovation import whitened
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.uncertainty import LOOSEST, Uncertainty, assess
from cfb_mjx.sysid.identification.unknowns import UNITS, Unknowns

_ROUNDS = 3
"""Number of fits of the noise levels in `linearise`."""
_HOVER_ROWS = 50
"""Rows of hover before the manoeuvre in `window_information`, in which the filter converges."""


@dataclass(frozen=True)
class Expected:
    """Value and expected standard deviation of one parameter, SI."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class Prediction:
    """Expected result of `cfb fit`.

    Attributes:
        names: of all requested parameters.
        parameters: identifiable parameters with their expected uncertainty.
        unidentifiable: names of parameters that cannot be identified.
        combinations: identifiable combinations of these.
        uncertainty: relative covariance and correlation.
        noise: noise levels fitted to the simulated flight.
    """

    names: tuple[str, ...]
    parameters: dict[str, Expected]
    unidentifiable: list[str]
    combinations: list[str]
    uncertainty: Uncertainty
    noise: Noise


class Linearised(eqx.Module):
    """Residuals of a fit, linearised at the true parameters."""

    residual: Float[np.ndarray, "blocks rows 8"]
    """Whitened innovations at the true parameters, in the fit's blocks of rows."""
    jacobian: Float[np.ndarray, "blocks rows 8 k"]
    """Derivatives with respect to relative changes of the quantities (offsets: in their units)."""
    noise: Noise
    """Fitted noise levels."""


def linearise(logs: list[FlightLog], unknowns: Unknowns, use_measured: bool = True) -> Linearised:
    """Residuals and Jacobian of a fit at the true parameters, with maximum-likelihood noise levels.

    Args:
        logs: simulated flights, with noise and disturbances.
        unknowns: parameters to be fitted; the nominal values are the true ones.
        use_measured: drive the body with measured rotor speeds where available.

    Raises:
        CfbError: a parameter does not affect the innovations (``pose_delay``).
    """
    if "pose_delay" in unknowns.names:
        raise CfbError("--parameters pose_delay: a manoeuvre cannot be designed for it; leave it out.")
    data = prepare(list(logs))
    segments = jax.tree.map(jnp.asarray, data.segments)
    noise = Noise.first(data)
    for _ in range(_ROUNDS):
        noise = fit_noise(unknowns, unknowns.start, noise, segments, use_measured, False)
    residual, jacobian = fit_slopes(unknowns, unknowns.start, noise, segments, use_measured, False)
    jacobian = np.asarray(jacobian) @ per_relative_change(unknowns)
    return Linearised(*in_blocks(segments, np.asarray(residual), jacobian), noise)


def predict(logs: list[FlightLog], unknowns: Unknowns, use_measured: bool = True) -> Prediction:
    """Expected uncertainty of a fit to simulated flights.

    Args:
        logs: as for `linearise`.
        unknowns: as for `linearise`.
        use_measured: as for `linearise`.

    Raises:
        CfbError: as `linearise`.
    """
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
    """The median prediction by total uncertainty, because the bootstrap of a single flight varies with its noise."""

    def unsure(prediction: Prediction) -> tuple[int, float]:
        return len(prediction.unidentifiable), float(np.log(prediction.uncertainty.std).sum())

    return sorted(predictions, key=unsure)[len(predictions) // 2]


def window_information(
    model: Quadrotor,
    commands: Float[Array, "n 4"],
    path: State,
    unknowns: Unknowns,
    noise: Noise,
    measured_rotors: bool,
    relative: Float[Array, "k k"],
) -> Float[Array, "k k"]:
    """Fisher information of one undisturbed manoeuvre after hover; differentiable with respect to the commands.

    Args:
        model: the true drone; its parameters are the nominal ones of ``unknowns``.
        commands: (n, 4) of the manoeuvre.
        path: (n,) states after each command (`cfb_mjx.sysid.excitation.manoeuvres.flown`).
        unknowns: parameters to be fitted.
        noise: noise levels.
        measured_rotors: whether rotor speed is logged.
        relative: `per_relative_change` of the unknowns.

    Returns:
        Information (k, k) for relative changes of the quantities (offsets: in their units).
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
        doubt=jnp.zeros((count, 4)),
        excess=jnp.zeros((count, 4)),
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
    """Derivatives (k, k) of the fit's vector with respect to relative changes of the quantities.

    Offsets change in their units (`OFFSETS`).
    """
    return np.linalg.inv(unknowns.slope(unknowns.start))


def log_determinant(information: Float[AnyArray, "k k"]) -> Float[Array, ""]:
    """D-optimality criterion: log determinant of the information plus a weak prior of 50 % (`LOOSEST`)."""
    return jnp.linalg.slogdet(information + jnp.eye(len(information)) / LOOSEST**2)[1]


def marginal_std(information: Float[AnyArray, "k k"]) -> np.ndarray:
    """Marginal standard deviations (k,) of relative changes (offsets: in their units), with the same weak prior."""
    known = np.asarray(information)
    return np.sqrt(np.diag(np.linalg.inv(known + np.eye(len(known)) / LOOSEST**2)))
