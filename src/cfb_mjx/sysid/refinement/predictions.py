"""Predictions of many windows of many flights, their errors, and the normal equations of a model's parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor, State
from cfb_mjx.model.effects import Condition, Effect, Wrench
from cfb_mjx.model.effects.base import overrides
from cfb_mjx.model.state import AnyArray
from cfb_mjx.model.vector import Vec
from cfb_mjx.sysid.flight import MEASURED_SHARE, Flight, delay_of, prepare_flight
from cfb_mjx.sysid.metrics import BLOCK, errors
from cfb_mjx.sysid.prediction import hold, predict_one, starts_of_windows
from cfb_mjx.sysid.refinement.numbers import STEP, Number, with_values
from cfb_mjx.sysid.windows import Windows, find_starts, find_windows

HORIZONS = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Horizons at which predictions are compared with measurements, s."""
TRIM = 2e-4
"""Prior standard deviation of a flight's trim torque, N m: a battery half a millimetre off its place."""
NO_MEAN = 1e4
"""Weight of the squared mean of the trims, in units of `TRIM`, relative to the weight of one window."""
HUBER = 0.3
"""Threshold of the Huber loss, relative to the error of `hold`."""
AT_BOUND = 1e-3
"""Distance from a bound, in units of the scale, within which a parameter counts as being at the bound."""
ALIKE = 2.0
"""Two flights are of one kind if the errors of `hold` differ by less than this factor."""
CHUNK = 64
"""Number of windows predicted at once."""
GROUP = 12
"""Number of models predicted at once."""
_STEPS = 64
"""Windows are padded to a multiple of this number of steps."""


class Trim(Effect):
    """A constant torque of one flight: a nuisance parameter of the fit, not in the catalogue."""

    name: ClassVar[str] = "trim"
    units: ClassVar[dict[str, str]] = {"torque": "N m"}
    source: ClassVar[str] = "estimated beside a refinement (cfb_mjx.sysid.refinement)"
    prior: ClassVar[dict[str, tuple[float, float]]] = {}
    strengths: ClassVar[tuple[str, ...]] = ()

    torque: Array

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        return Wrench(wrench.force, wrench.torque + Vec(*(self.torque[..., i] for i in range(3))))


@dataclass(frozen=True)
class Normal:
    """Normal equations in units of the scales: the model's parameters first, then three trims of every flight.

    Attributes:
        matrix: (n, n) Gauss-Newton matrix, without priors.
        gradient: (n,) of the loss, without priors.
        scatter: (n, n) sum over blocks of windows of the outer products of their gradients.
        count: number of the model's parameters.
        share: (F,) weights of the flights.
        trimmed: whether the trims are estimated; otherwise they are fixed.
    """

    matrix: np.ndarray
    gradient: np.ndarray
    scatter: np.ndarray
    count: int
    share: np.ndarray
    trimmed: bool

    def chosen(self, free: np.ndarray) -> np.ndarray:
        """Positions of the model parameters marked in ``free`` (count,), and of the trims if they are estimated."""
        own = np.full(len(self.gradient) - self.count, self.trimmed)
        return np.flatnonzero(np.concatenate([free, own]))

    def weighed(self, free: np.ndarray) -> np.ndarray:
        """The matrix with the priors added, for the parameters of `chosen`."""
        trims = np.zeros(((len(self.gradient) - self.count) // 3, 3))
        at = self.chosen(free)
        return self._whole(np.zeros(self.count), trims)[0][np.ix_(at, at)]

    def _whole(self, offset: np.ndarray, trims: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # The prior has a standard deviation of one scale (one TRIM) and the weight of a single window.
        at = np.concatenate([offset, trims.ravel()])
        prior = np.eye(len(at))
        mean = self.share / len(trims)
        prior[self.count :, self.count :] += NO_MEAN * np.kron(np.outer(mean, mean), np.eye(3))
        return self.matrix + prior, self.gradient + prior @ at

    def _free(self, gradient: np.ndarray, values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        free = np.full(len(gradient), self.trimmed)
        own = gradient[: self.count]
        free[: self.count] = ~((values <= low) & (own > 0) | (values >= high) & (own < 0))
        return free

    def step(self, damping, offset, trims, values, low, high) -> tuple[np.ndarray, np.ndarray]:
        """Damped Gauss-Newton step of parameters and trims, in units of their scales.

        ``offset`` and ``trims`` are the distances from the prior means, in the same units.
        """
        matrix, gradient = self._whole(offset, trims)
        free = self._free(gradient, values, low, high)
        change = np.zeros(len(gradient))
        inner = matrix[np.ix_(free, free)]
        change[free] = -np.linalg.solve(inner + damping * np.diag(np.diag(inner)), gradient[free])
        return change[: self.count], change[self.count :].reshape(-1, 3)

    def deviations(self, values, low, high, scale) -> np.ndarray:
        """Standard deviations of the parameters by the sandwich formula; NaN for a parameter at a bound."""
        matrix, gradient = self._whole(np.zeros(self.count), np.zeros(((len(self.gradient) - self.count) // 3, 3)))
        free = self._free(gradient, values, low, high)
        inverse = np.linalg.inv(matrix[np.ix_(free, free)])
        spread = np.full(len(gradient), np.nan)
        spread[free] = np.sqrt(np.diag(inverse @ self.scatter[np.ix_(free, free)] @ inverse))
        margin = AT_BOUND * scale
        inside = (values > low + margin) & (values < high - margin)
        return np.where(inside, spread[: self.count] * scale, np.nan)


@dataclass(frozen=True)
class _Part:
    """Windows of all flights with one kind of input: commands or measured rotor speeds.

    Attributes:
        measured: whether the input is measured rotor speeds.
        flights: windows of every flight, with the rotor speeds and effect memories at their starts.
        steps: number of steps to which windows are padded; it differs between flights of different rates or gaps.
        flight: (W,) index of the flight of each window, ascending.
        row: (W,) index of the window among those of its flight.
        weight: (W,) weight of each window.
    """

    measured: bool
    flights: list[tuple[Windows, np.ndarray, tuple]]
    steps: int
    flight: np.ndarray
    row: np.ndarray
    weight: np.ndarray

    def chunks(self) -> Iterator[dict[str, Any]]:
        """Inputs of the predictions in batches of `CHUNK` windows, made when needed, because they are large."""
        for first in range(0, len(self.flight), CHUNK):
            # The last chunk repeats its last window, so that one compiled program serves all.
            chosen = np.minimum(np.arange(first, first + CHUNK), len(self.flight) - 1)
            flight, row = self.flight[chosen], self.row[chosen]
            pieces = [self._inputs(i, row[flight == i]) for i in np.unique(flight)]
            yield jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *pieces) | {"flight": jnp.asarray(flight)}

    def _inputs(self, i: int, row: np.ndarray) -> dict[str, Any]:
        windows, start, memory = self.flights[i]
        pad = self.steps - windows.step.shape[1]
        fed = windows.rotor_speed[row, 1:] if self.measured else windows.command[row]
        speed = windows.rotor_speed[row, 0] if self.measured else start[row]
        state = (windows.position, windows.velocity, windows.quaternion, windows.body_rate)
        return {
            "state": (*(x[row] for x in state), speed, jax.tree.map(lambda x: np.asarray(x)[row], memory)),
            "step": np.pad(windows.step[row], ((0, 0), (0, pad))),
            "fed": np.pad(fed, ((0, 0), (0, pad), (0, 0)), mode="edge"),
            "at": windows.at[row],
            "quaternion": windows.true_quaternion[row],
            "velocity": windows.true_velocity[row],
        }


@dataclass(frozen=True)
class Predictions:
    """All windows of a fit.

    Attributes:
        parts: windows predicted from commands, and windows predicted from measured rotor speeds.
        share: (F,) weights of the flights, 1 on average.
        sizes: (H, 2) mean errors of `hold`: attitude, rad, and velocity, m/s.
        flown: log, windows and prepared rows of every flight; None for the rows of a flight without windows.
    """

    parts: list[_Part]
    share: np.ndarray
    sizes: Array
    flown: tuple[tuple[FlightLog, Windows, Flight | None], ...]

    @classmethod
    def of(cls, model: Quadrotor, logs: Sequence[FlightLog], share: np.ndarray, most: int | None = None) -> Predictions:
        """Find the windows of all flights.

        Args:
            model: supplies the sensor delays.
            logs: flights.
            share: (F,) weights of the flights.
            most: approximate maximum number of windows in all; long flights then keep every second, third, ... window.

        Raises:
            CfbError: no log allows a window.
        """
        gyro_delay = float(model.parameters.gyro_delay)
        delays = [delay_of(log, model.parameters) for log in logs]
        starts = [find_starts(log, HORIZONS, delay, gyro_delay) for log, delay in zip(logs, delays, strict=True)]
        each = np.inf if most is None else most / len(logs)
        flown = []
        for log, delay, own in zip(logs, delays, starts, strict=True):
            windows = find_windows(log, HORIZONS, delay, gyro_delay, own[:: max(1, round(len(own) / each))])
            flown.append((log, windows, prepare_flight(log, delay, gyro_delay) if len(windows) else None))
        held = [_norms(hold(windows, HORIZONS), windows) for _, windows, _ in flown if len(windows)]
        if not held:
            names = ", ".join(log.name for log in logs)
            raise CfbError(f"{names}: no prediction window fits; a log must fly at least 1.2 s without a gap.")
        sizes = jnp.asarray(np.concatenate(held).mean(axis=0))
        return cls([], share, sizes, tuple(flown))

    def started(self, model: Quadrotor) -> Predictions:
        """The same windows, with the rotor speeds and effect memories at their starts according to a model."""
        # A trim has no memory; without it, the compiled program of the evaluation can be reused.
        plain = Quadrotor(model.parameters, model.effects[:-1], model.body)
        began = starts_of_windows(plain, *zip(*self.flown, strict=True))
        pairs = zip(self.flown, began, strict=True)
        flights = [(windows, speed, (*memory, ())) for (_, windows, _), (speed, memory) in pairs]
        kinds = (_part(flights, self.share, measured) for measured in (False, True))
        return replace(self, parts=[part for part in kinds if part is not None])

    def errors(self, model: Quadrotor, trims: np.ndarray) -> list[np.ndarray]:
        """Errors (W, H, 2) of attitude and velocity relative to those of `hold`, for every part."""
        return [np.linalg.norm(error, axis=-1) for error in self._raw(model, trims)]

    def _raw(self, model: Quadrotor, trims: np.ndarray) -> list[np.ndarray]:
        """The same, (W, H, 2, 3), as vectors."""
        found = []
        for part in self.parts:
            chunks = [np.asarray(_scaled(model, c, _own(trims, c), self.sizes, part.measured)) for c in part.chunks()]
            found.append(np.concatenate(chunks)[: len(part.flight)])
        return found

    def losses(self, errors: list[np.ndarray]) -> list[np.ndarray]:
        """Weighted Huber losses (W, H, 2) of `errors`, for every part."""
        pairs = zip(self.parts, errors, strict=True)
        return [
            part.weight[:, None, None] * np.where(e < HUBER, 0.5 * e**2 / HUBER, e - 0.5 * HUBER) for part, e in pairs
        ]

    @property
    def count(self) -> int:
        """Number of errors over which the mean loss is taken."""
        return sum(len(part.flight) for part in self.parts) * len(HORIZONS) * 2

    def cost(self, model: Quadrotor, trims: np.ndarray) -> float:
        """Mean loss over windows, horizons and quantities, including the prior of the trims; infinite if diverged."""
        return self.mean(self.losses(self.errors(model, trims)), trims)

    def mean(self, losses: list[np.ndarray], trims: np.ndarray) -> float:
        """`cost` from losses that are already computed."""
        total = sum(np.sum(loss) for loss in losses)
        prior = np.sum((trims / TRIM) ** 2) + NO_MEAN * np.sum((self.share @ trims / TRIM / len(trims)) ** 2)
        mean = float((total + 0.5 * prior) / self.count)
        return mean if np.isfinite(mean) else np.inf

    def normal_equations(
        self,
        model: Quadrotor,
        numbers: tuple[Number, ...],
        values: np.ndarray,
        trims: np.ndarray,
        trimmed: bool = True,
    ) -> Normal:
        """Normal equations of the loss, without priors, by finite differences.

        Args:
            model: the drone.
            numbers: the N parameters.
            values: (N,) of the parameters.
            trims: (F, 3) trim torques, N m.
            trimmed: whether the trims are estimated.
        """
        count, flights = len(numbers), len(trims)
        width = count + 3 * flights
        matrix, gradient, scatter = np.zeros((width, width)), np.zeros(width), np.zeros((width, width))
        model = with_values(model, numbers, values)
        # Held parameters need no derivative.
        free = [k for k, n in enumerate(numbers) if not n.held]
        steps = np.array([numbers[k].step(values[k]) for k in free])
        moved = [with_values(model, numbers, _but(values, k, by)) for k, by in zip(free, steps, strict=True)]
        # The parameters of an effect whose memory follows the flight also act through the memory at a window's start.
        kept = {type(e).name for e in model.effects if overrides(e, "follow")}
        # Of the windows that begin elsewhere only the errors are kept: their inputs are as large as all others'.
        elsewhere = {
            i: self.started(moved[i])._raw(moved[i], trims) for i, k in enumerate(free) if numbers[k].effect in kept
        }
        along = np.concatenate([[numbers[k].scale for k in free] / steps, np.full(3, 1 / STEP)])
        for place, part in enumerate(self.parts):
            groups = [
                _moves(model, moved, chunk, _own(trims, chunk), self.sizes, part.measured) for chunk in part.chunks()
            ]
            found = np.concatenate(groups, axis=1)[:, : len(part.flight)]
            for i, there in elsewhere.items():
                found[1 + i] = there[place]
            error, slope = found[0], np.zeros((*found[0].shape, count + 3))
            difference = _unwrapped(found[1:], error, np.asarray(self.sizes)) - error
            slope[..., [*free, count, count + 1, count + 2]] = np.moveaxis(difference, 0, -1) * along
            heavy = part.weight[:, None, None, None] / np.maximum(np.linalg.norm(error, axis=-1, keepdims=True), HUBER)
            flat = slope.reshape(len(slope), -1, count + 3)
            pull = (heavy * error).reshape(len(error), -1)
            push = np.broadcast_to(heavy, error.shape).reshape(len(error), -1)
            for i in np.unique(part.flight):
                mine = np.flatnonzero(part.flight == i)
                at = np.concatenate([np.arange(count), count + 3 * i + np.arange(3)])
                matrix[np.ix_(at, at)] += np.einsum("wri,wr,wrj->ij", flat[mine], push[mine], flat[mine], optimize=True)
                each = np.einsum("wri,wr->wi", flat[mine], pull[mine])
                gradient[at] += each.sum(axis=0)
                sums = np.add.reduceat(each, np.arange(0, len(mine), BLOCK))
                scatter[np.ix_(at, at)] += sums.T @ sums
        return Normal(matrix, gradient, scatter, count, self.share, trimmed)


def _unwrapped(found: np.ndarray, near: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Errors (..., H, 2, 3) with attitude errors near half a turn replaced by the equivalent vector closer to ``near``.

    A rotation by about pi has two nearly equivalent rotation vectors; finite differences must not jump between them.
    """
    turn = found[..., 0, :] * sizes[:, :1]
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    far = np.linalg.norm(turn - near[..., 0, :] * sizes[:, :1], axis=-1, keepdims=True) > np.pi
    turned = np.where(far, turn * (1 - 2 * np.pi / np.maximum(angle, 1e-9)), turn)
    return np.stack([turned / sizes[:, :1], found[..., 1, :]], axis=-2)


def _but(values: np.ndarray, k: int, by: float) -> np.ndarray:
    """The values with the k-th one moved."""
    return values + by * (np.arange(len(values)) == k)


def kinds_alike(model: Quadrotor, logs: Sequence[FlightLog]) -> dict[str, float]:
    """Weights of flights by log name that balance the kinds of flight.

    Two flights are of one kind if their mean attitude errors of `hold` after half a second differ by less than the
    factor `ALIKE`. A flight's weight is one over the number of flights of its kind.
    """
    errs = {}
    for log in logs:
        delay = delay_of(log, model.parameters)
        windows = find_windows(log, HORIZONS, delay, float(model.parameters.gyro_delay))
        if len(windows):
            errs[log.name] = np.log(_norms(hold(windows, HORIZONS), windows)[:, -1, 0].mean() + 1e-9)
    near = np.log(ALIKE)
    return {name: 1 / sum(abs(own - other) < near for other in errs.values()) for name, own in errs.items()}


def _part(flights: list[tuple], share: np.ndarray, measured: bool) -> _Part | None:
    """Windows with one kind of input; None if no flight has any."""
    longest = max((windows.step.shape[1] for windows, *_ in flights if len(windows)), default=0)
    rows = [_usable(windows, measured) for windows, *_ in flights]
    counts = np.array([len(own) for own in rows])
    flight = np.repeat(np.arange(len(flights)), counts)
    if not len(flight):
        return None
    weight = share[flight] * len(flight) / (np.count_nonzero(counts) * counts[flight])
    return _Part(measured, flights, _STEPS * -(-longest // _STEPS), flight, np.concatenate(rows), weight)


def _usable(windows: Windows, measured: bool) -> np.ndarray:
    """Indices of the windows that have a kind of input."""
    speed = np.isfinite(windows.rotor_speed)
    if not measured:
        return np.arange(len(windows))
    return np.flatnonzero(speed.all(axis=(1, 2)) & (speed.size > 0 and speed.mean() > MEASURED_SHARE))


def _own(trims: np.ndarray, chunk: dict) -> Array:
    """Trim (W, 3) of the flight of each window of a chunk. Its shape does not depend on the number of flights."""
    return jnp.asarray(trims[np.asarray(chunk["flight"])])


def _norms(predicted: State, windows: Windows) -> np.ndarray:
    """Errors (W, H, 2) of attitude, rad, and velocity, m/s."""
    found = errors(windows, predicted)
    return np.stack([np.radians(found["attitude"]), found["velocity"]], axis=-1)


def _rotation_vector(frm: AnyArray, to: AnyArray) -> Array:
    """Rotation vector (..., 3) from one attitude to another, rad."""
    scalar = jnp.sum(frm * to, axis=-1)
    vector = frm[..., :1] * to[..., 1:] - to[..., :1] * frm[..., 1:] - jnp.cross(frm[..., 1:], to[..., 1:])
    length = jnp.sqrt(jnp.sum(vector**2, axis=-1) + 1e-24)
    angle = 2 * jnp.arctan2(length, jnp.abs(scalar)) * jnp.where(scalar < 0, -1.0, 1.0)
    return (angle / length)[..., None] * vector


def _error(model: Quadrotor, window: dict, trim: Array, sizes: Array, measured: bool) -> Array:
    """Errors (H, 2, 3) of attitude and velocity of one window, relative to those of `hold`."""
    model = eqx.tree_at(lambda m: m.effects[-1].torque, model, trim)
    flown = predict_one(model, State(*window["state"]), window["step"], window["fed"], measured)
    turn = _rotation_vector(window["quaternion"], flown.quaternion[window["at"]])
    drift = flown.velocity[window["at"]] - window["velocity"]
    return jnp.stack([turn, drift], axis=1) / sizes[:, :, None]


@eqx.filter_jit
def _scaled(model: Quadrotor, chunk: dict, trims: Array, sizes: Array, measured: bool) -> Array:
    """Errors (W, H, 2, 3) of all windows of a chunk."""
    return jax.vmap(lambda window, trim: _error(model, window, trim, sizes, measured))(chunk, trims)


def _moves(
    model: Quadrotor, moved: list[Quadrotor], chunk: dict, trims: Array, sizes: Array, measured: bool
) -> np.ndarray:
    """Errors `_scaled` (1 + N + 3, W, H, 2, 3) of the model, of the moved models, and with each trim component moved.

    Finite differences in groups of fixed size need one compiled program for any set of parameters. Automatic
    derivatives would be traced again for every new set, which takes a minute where the predictions take a second.
    """
    every = [(m.effects, np.zeros(3)) for m in (model, *moved)] + [
        (model.effects, TRIM * STEP * row) for row in np.eye(3)
    ]
    found = []
    for first in range(0, len(every), GROUP):
        group = [every[min(i, len(every) - 1)] for i in range(first, first + GROUP)]
        effects, by = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *group)
        found.append(_grouped(model, effects, chunk, trims + by[:, None], sizes, measured))
    return np.concatenate(found)[: len(every)]


@eqx.filter_jit
def _grouped(
    model: Quadrotor, effects: tuple[Effect, ...], chunk: dict, trims: Array, sizes: Array, measured: bool
) -> Array:
    """Errors `_scaled` (G, W, H, 2, 3) of G models that differ in the effects' parameters and in the trims."""

    def one(own, turned):
        return _scaled(eqx.tree_at(lambda m: m.effects, model, own), chunk, turned, sizes, measured)

    return jax.vmap(one)(effects, trims)
