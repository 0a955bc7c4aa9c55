"""Fit of model parameters to predictions: projected Gauss-Newton steps on a robust loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import KNOWN, ParasiticDrag, RotorDrag, Wind
from cfb_mjx.sysid.refinement.numbers import Number, with_values
from cfb_mjx.sysid.refinement.predictions import AT_BOUND, TRIM, Normal, Predictions, Trim
from cfb_mjx.sysid.sensor_faults import HEALTHY, SensorFaults


@dataclass(frozen=True)
class Refinement:
    """Outcome of `refine`.

    Attributes:
        model: the fitted drone, without trims.
        numbers: the N fitted parameters.
        values: (N,) of the parameters.
        deviations: (N,) standard deviations, from the scatter of blocks of windows; NaN for a parameter at a bound.
        trims: trim torque (3,) of each flight, N m, by log name.
        cost: mean loss before and after the fit.
        normal: normal equations at ``values``.
        data: windows that were predicted.
    """

    model: Quadrotor
    numbers: tuple[Number, ...]
    values: np.ndarray
    deviations: np.ndarray
    trims: dict[str, np.ndarray]
    cost: tuple[float, float]
    normal: Normal
    data: Predictions

    def at_bound(self, number: Number) -> bool:
        """Whether a parameter is at one of its bounds."""
        value, margin = self.values[self.numbers.index(number)], AT_BOUND * number.scale
        return bool(number.held or value <= number.low + margin or value >= number.high - margin)

    @property
    def pressed(self) -> list[str]:
        """Names of the strengths of effects (`Effect.strengths`) that are at a bound."""
        fitted = (n for n in self.numbers if not n.held)
        return [n.name for n in fitted if n.field in KNOWN[n.effect].strengths and self.at_bound(n)]

    def uncertainty(self, effect: str) -> dict[str, float | list[float | None] | None]:
        """Standard deviations of an effect's parameters by field; None for a parameter at a bound."""
        found: dict[str, Any] = {}
        for number, std in zip(self.numbers, self.deviations, strict=True):
            if number.effect == effect:
                known = float(std) if np.isfinite(std) else None
                found[number.field] = known if number.index is None else [*found.get(number.field, []), known]
        return found

    @property
    def correlation(self) -> np.ndarray:
        """Correlation (N, N) of the parameters' errors; NaN for parameters at a bound."""
        free = np.array([not self.at_bound(n) for n in self.numbers])
        inverse = np.linalg.inv(self.normal.weighed(free))[: free.sum(), : free.sum()]
        spread = np.sqrt(np.diag(inverse))
        found = np.full((len(free), len(free)), np.nan)
        found[np.ix_(free, free)] = inverse / np.outer(spread, spread)
        return found

    def foreseen(self, numbers: Sequence[Number], model: Quadrotor) -> float:
        """Mean loss after one Gauss-Newton step with additional parameters.

        Args:
            numbers: additional parameters, of effects that are not fitted yet.
            model: the drone with these effects, at values where they hardly act.
        """
        every = (*self.numbers, *numbers)
        model = _prepared(model, every)
        low, high, scale = bounds(every)
        values = np.clip([n.of(model) for n in every], low, high)
        model = with_values(model, every, values)
        trims = self._trims
        data = self.data.started(model)
        normal = data.normal_equations(model, every, values, trims, self.normal.trimmed)
        change, turn = normal.step(1e-2, np.zeros(len(every)), trims / TRIM, values, low, high)
        tried = with_values(model, every, np.clip(values + change * scale, low, high))
        return data.started(tried).cost(tried, trims + turn * TRIM)

    def growth(self, effects: Sequence[str]) -> float:
        """Increase of the mean loss without some effects, according to its curvature at the optimum."""
        matrix, change, answer = self._answer(effects)
        whole = change + answer
        return float(0.5 * whole @ matrix @ whole / self.data.count)

    def without(self, effects: Sequence[str]) -> Left:
        """Errors of the predictions without some effects.

        The other parameters compensate according to the curvature of the loss at the optimum, or not at all if that
        predicts worse.
        """
        _, change, answer = self._answer(effects)
        low, high, scale = bounds(self.numbers)
        count = len(self.numbers)
        out = np.array([n.effect in effects for n in self.numbers])
        found = []
        for share in (1.0, 0.0):
            step = change + share * answer
            values = self.values + step[:count] * scale
            values = np.where(out, values, np.clip(values, low, high))
            turn = step[count:].reshape(-1, 3) * TRIM if self.normal.trimmed else 0.0
            found.append(self._left(with_values(self.model, self.numbers, values), self._trims + turn))
        return min(found, key=lambda pair: pair[1])[0]

    @property
    def left(self) -> Left:
        """Errors of the predictions with all effects."""
        return self.judged(self.model)

    def judged(self, model: Quadrotor) -> Left:
        """Errors of the same predictions by another model, each flight with its fitted trim."""
        return self._left(model, self._trims)[0]

    def loss(self, model: Quadrotor) -> float:
        """Mean loss of the same predictions by another model, each flight with its fitted trim."""
        return self._left(model, self._trims)[1]

    @property
    def _trims(self) -> np.ndarray:
        return np.array(list(self.trims.values()))

    def _left(self, model: Quadrotor, trims: np.ndarray) -> tuple[Left, float]:
        """Errors of a model's predictions with the given trims, and their mean loss."""
        trimmed = _trimmed(model)
        data = self.data.started(trimmed)
        errors = data.errors(trimmed, trims)
        losses = data.losses(errors)
        return Left(model, errors, losses), data.mean(losses, trims)

    def _answer(self, effects: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Linear response of the fit to the removal of effects, in units of the scales.

        The order is that of the parameters, then of the trims if they are estimated.

        Returns:
            The weighted normal matrix, the change of the removed effects' parameters to neutral, and the compensating
            change of the others.
        """
        out = np.array([n.effect in effects for n in self.numbers])
        _, _, scale = bounds(self.numbers)
        neutral = np.array([n.of_neutral() for n in self.numbers])
        every = np.ones(len(out), dtype=bool)
        matrix = self.normal.weighed(every)
        change, answer = np.zeros(len(matrix)), np.zeros(len(matrix))
        change[: len(out)] = np.where(out, neutral - self.values, 0.0) / scale
        free = ~out & np.array([not self.at_bound(n) for n in self.numbers])
        at = np.searchsorted(self.normal.chosen(every), self.normal.chosen(free))
        answer[at] = -np.linalg.solve(matrix[np.ix_(at, at)], matrix[at] @ change)
        return matrix, change, answer


@dataclass(frozen=True)
class Left:
    """Errors of a model on the windows of a fit, predicted from commands and, where measured, from rotor speeds.

    Attributes:
        model: the drone.
        errors: (W, H, 2) errors of attitude and velocity relative to `hold`, one array per kind of prediction.
        losses: (W, H, 2) their losses.
    """

    model: Quadrotor
    errors: list[np.ndarray]
    losses: list[np.ndarray]


def refine(
    model: Quadrotor,
    logs: Sequence[FlightLog],
    numbers: Sequence[Number],
    faults: SensorFaults = HEALTHY,
    weights: Mapping[str, float] | None = None,
    trimmed: bool = True,
    trims: Mapping[str, np.ndarray] | None = None,
    iterations: int = 12,
    most_windows: int | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Refinement:
    """Fit parameters of a model to its predictions of attitude and velocity at `HORIZONS`.

    The loss is the Huber loss of the norm of each error, relative to the mean error of `hold` at that horizon, so that
    outlying windows do not dominate. Each window is predicted from commands, and a second time from measured rotor
    speeds if the flight has them. Rotor speeds and effect memories at a window's start come from the log before it,
    replayed by the current model of the fit. All flights have the same weight regardless of their length, unless
    ``weights`` are given. The solver takes projected Gauss-Newton steps. Run with x64 enabled.

    Args:
        model: where to start; effects that it does not have are added at neutral.
        logs: flights.
        numbers: parameters to fit (`plausible_numbers`, `free_numbers`); values outside their bounds are clipped.
        faults: of the recording, which are removed first.
        weights: weights of flights by log name; 1 by default.
        trimmed: estimate a trim torque for every flight. Without it, the parameters are optimal for flights whose trim
            is unknown.
        trims: initial trim torques (3,) by log name, N m; zero by default.
        iterations: maximum number of steps.
        most_windows: maximum number of windows; by default all. Windows overlap, so every second or third of them
            gives nearly the same result.
        progress: called with a message after each step.

    Raises:
        CfbError: there are no parameters to fit, x64 is not enabled, or no log allows a window.
    """
    if jnp.result_type(float) != np.float64:
        raise CfbError('refine needs 64-bit numbers: call jax.config.update("jax_enable_x64", True) first.')
    if not numbers:
        raise CfbError("refine needs at least one number to fit; name an effect.")
    numbers = tuple(numbers)
    model = _prepared(model, numbers)
    shares = np.array([(weights or {}).get(log.name, 1.0) for log in logs])
    data = Predictions.of(model, [faults.repaired(log) for log in logs], shares / shares.mean(), most_windows)
    low, high, scale = bounds(numbers)
    values = np.clip([n.of(model) for n in numbers], low, high)
    turns = np.array([(trims or {}).get(log.name, np.zeros(3)) for log in logs])
    start, damping = values.copy(), 1e-2
    model = with_values(model, numbers, values)
    data = data.started(model)
    first = cost = data.cost(model, turns)
    for step in range(iterations):
        normal = data.normal_equations(model, numbers, values, turns, trimmed)
        better = None
        while damping < 1e6:
            change, turn = normal.step(damping, (values - start) / scale, turns / TRIM, values, low, high)
            tried, other = np.clip(values + change * scale, low, high), turns + turn * TRIM
            moved = with_values(model, numbers, tried)
            began = data.started(moved)
            reached = began.cost(moved, other)
            if reached < cost:
                better = tried, other, reached, moved, began
                break
            damping *= 8
        if better is None:
            break
        gained, damping = cost - better[2], damping / 4
        values, turns, cost, model, data = better
        progress(f"step {step + 1}: mean loss {cost:.4f}")
        if gained < 1e-4 * cost:
            break
    normal = data.normal_equations(model, numbers, values, turns, trimmed)
    deviations = normal.deviations(values, low, high, scale)
    found = Quadrotor(model.parameters, model.effects[:-1], body=model.body)
    named = {log.name: trim for log, trim in zip(logs, turns, strict=True)}
    return Refinement(found, numbers, values, deviations, named, (first, cost), normal, data)


def bounds(numbers: Sequence[Number]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower bounds, upper bounds and scales of N parameters, each (N,)."""
    low, high, scale = np.array([(n.low, n.high, n.scale) for n in numbers]).T
    return low, high, scale


def _prepared(model: Quadrotor, numbers: tuple[Number, ...]) -> Quadrotor:
    """The model with every effect of ``numbers`` and a trim as its last effect."""
    names = dict.fromkeys(n.effect for n in numbers)
    here = {type(e).name for e in model.effects}
    added = tuple(KNOWN[name].neutral() for name in names if name not in here)
    if {RotorDrag.name, ParasiticDrag.name} & {*names, *here}:
        # The drag effects transmit the wind; with a conductance of its own the wind would count twice.
        added = tuple(Wind(0.0, 0.0) if isinstance(effect, Wind) else effect for effect in added)
    return _trimmed(Quadrotor(model.parameters, (*model.effects, *added), body=model.body))


def _trimmed(model: Quadrotor) -> Quadrotor:
    effects = (*model.effects, Trim(jnp.zeros(3)))
    return Quadrotor(model.parameters, effects, body=model.body, rotor_loads="instant")
