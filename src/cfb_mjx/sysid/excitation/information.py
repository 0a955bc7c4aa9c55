"""Expected uncertainty of the parameters from a flight, before it is flown.

`cfb fit` maximises the likelihood of one-step innovations (`sysid.identification.innovation`). Its Fisher information
is J^T J, where J is the Jacobian of the whitened innovations at the true parameters. In a simulated flight these are
known.

`separate` chooses the flight that distinguishes effects which earlier flights hardly distinguish.

Every path is flown in simulation by a drone that has one of the effects. Then each other effect is fitted to that
flight in its place. The log-likelihood that it fails to explain, in nats, is the information of the path about this
pair of effects. A path is ranked by the pair about which it has the least information.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.control import FirmwarePid, PositionHold
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import CATALOGUE, SENSOR_FAULTS, Effect
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rotors import thrust
from cfb_mjx.model.state import AnyArray, State
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.excitation.experiment import TICK, Conditions, Experiment, follow
from cfb_mjx.sysid.excitation.manoeuvres import PATHS, STEP, path
from cfb_mjx.sysid.identification.flight_data import Segments, parts, prepare
from cfb_mjx.sysid.identification.innovation import whitened
from cfb_mjx.sysid.identification.likelihood import fit_noise, slopes_in_blocks
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.uncertainty import LOOSEST, Scores, Uncertainty, assess
from cfb_mjx.sysid.identification.unknowns import UNITS, Unknowns
from cfb_mjx.sysid.tracing.jointly import confirm
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors

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
    segments = parts(not_none(data.segments))
    noise = Noise.first(data)
    for _ in range(_ROUNDS):
        noise = fit_noise(unknowns, unknowns.start, noise, segments, use_measured, False)
    found = slopes_in_blocks(unknowns, unknowns.start, noise, segments, use_measured, False)
    _, residuals, jacobians = zip(*found, strict=True)
    return Linearised(np.concatenate(residuals), np.concatenate(jacobians), noise)


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
    found = assess(Scores.of(at_truth.residual, at_truth.jacobian), unknowns.names)
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


TYPICAL = 0.2
"""Assumed strength of an effect that the model does not have, as a share of the upper end of its prior range."""
ENOUGH = 10.0
"""Nats required to decide between two effects: odds of twenty thousand to one."""
REACH = 5.0
"""A flight that deviates by more than this from its path, m, counts as not having followed it."""


@dataclass(frozen=True)
class Told:
    """Information of a path about pairs of effects.

    Attributes:
        path: name of the path.
        nats: log-likelihood per flight that the second effect cannot explain, by (true effect, second effect).
        flown: flight with the first of the effects.
        followed: whether every simulated drone followed the path.
    """

    path: str
    nats: dict[tuple[str, str], float]
    flown: Experiment
    followed: bool

    @property
    def worst(self) -> float:
        """Smallest number of nats over all pairs; zero if a drone did not follow the path."""
        return min(self.nats.values()) if self.followed else 0.0

    @property
    def flights(self) -> int | None:
        """Number of flights that decide every pair; None if 100 or more would be needed."""
        return max(1, int(np.ceil(ENOUGH / self.worst))) if self.worst > ENOUGH / 100 else None

    def to_json(self) -> dict[str, Any]:
        """All results except the flight as a JSON-compatible dictionary."""
        nats = {f"{true} against {other}": value for (true, other), value in self.nats.items()}
        return {"nats": nats, "flights": self.flights, "followed": self.followed}


def assumed(name: str, present: Sequence[Effect]) -> Effect:
    """The effect as in the model, or at a typical strength (`TYPICAL`, with alternating signs) if the model lacks it.

    Args:
        name: of the effect.
        present: effects of the model.

    Raises:
        CfbError: the effect is not in the catalogue.
    """
    if name in SENSOR_FAULTS:
        raise CfbError(
            f"{name} is a fault of the recording and not an effect on the flight; cfb close-loop looks for it."
        )
    if name not in CATALOGUE:
        raise CfbError(f"unknown effect {name}; the catalogue has {', '.join(sorted(CATALOGUE))}.")
    kind = CATALOGUE[name]
    own = next((effect for effect in present if type(effect).name == name), None)
    if own is not None and any(np.any(np.asarray(getattr(own, field)) != 0) for field in kind.strengths):
        return own
    effect = kind.neutral()
    for field in kind.strengths:
        old = np.asarray(getattr(effect, field))
        signs = np.resize([1.0, -1.0], old.shape) if kind.prior[field][0] < 0 else np.ones(old.shape)
        value = jnp.asarray(TYPICAL * kind.prior[field][1] * signs)
        effect = eqx.tree_at(lambda e, f=field: getattr(e, f), effect, value)
    return effect


def separate(
    model: Quadrotor,
    names: Sequence[str],
    conditions: Conditions = Conditions(),
    paths: Sequence[str] = tuple(PATHS),
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[Told]:
    """Rank paths by how well they distinguish some effects, the most informative first.

    Args:
        model: the drone; effects that it has are used with its strengths. Run with x64 enabled.
        names: at least two effects.
        conditions: expected noise and disturbances.
        paths: names of `PATHS`.
        seed: of noise and disturbances.
        progress: called with (done, total) simulations.

    Raises:
        CfbError: there are fewer than two effects, one is repeated, or one is not in the catalogue.
    """
    if len(set(names)) < 2 or len(set(names)) < len(names):
        raise CfbError(f"name at least two different effects to distinguish, found {', '.join(names) or 'none'}.")
    there = {name: assumed(name, model.effects) for name in names}
    others = tuple(effect for effect in model.effects if type(effect).name not in names)
    stabiliser = PositionHold(FirmwarePid.hovering(model.parameters))
    found = []
    for index, which in enumerate(paths):
        nats, flights, wanted = {}, [], path(which, TICK)
        for true, effect in there.items():
            flying = eqx.tree_at(lambda m: m.effects, model, (*others, effect), is_leaf=lambda x: isinstance(x, tuple))
            flown = follow(flying, stabiliser, wanted, conditions, seed, name=which)
            flights.append(flown)
            if progress is not None:
                progress(len(there) * index + len(flights), len(there) * len(paths))
            if not _followed(flown, wanted):
                continue
            nats |= {(true, n): x for n, x in _unexplained(flown.log, model, others, true, effect, names).items()}
        found.append(Told(which, nats, flights[0], len(nats) == len(names) * (len(names) - 1)))
    return sorted(found, key=lambda told: -told.worst)


def _followed(flown: Experiment, wanted: np.ndarray) -> bool:
    away = np.linalg.norm(flown.state.position - wanted[:, :3], axis=1)
    return bool(np.isfinite(away).all() and away.max() < REACH)


def _unexplained(
    log: FlightLog, model: Quadrotor, others: tuple[Effect, ...], true: str, effect: Effect, names: Sequence[str]
) -> dict[str, float]:
    """Nats of a flight with ``effect`` that each other effect cannot explain."""
    delay, gyro_delay = float(model.parameters.pose_delay), float(model.parameters.gyro_delay)
    search = Search.start([log], model.parameters, delay, check_sensors([log], delay, gyro_delay), others)
    nothing = search.learned(search.nothing())
    right = nothing.having(effect)
    right = search.settled(search.learned(right))
    nothing, linear = search.refine(nothing)
    probes = search.probes(nothing, linear)
    found = {}
    for name in names:
        if name == true:
            continue
        best = nothing
        # An effect whose fitted sign is meaningless has no probe and explains nothing of this flight.
        if name in probes:
            evidence, variant = probes[name]
            best = search.settled(search.with_candidate(nothing, variant, evidence))
        found[name] = confirm(search, replace(best, levels=right.levels), right).gain
    return found
