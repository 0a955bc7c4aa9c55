"""The fit itself: projected Gauss-Newton steps on the predictions' robust loss."""

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
    """Outcome of `refine`."""

    model: Quadrotor
    numbers: tuple[Number, ...]
    values: np.ndarray
    deviations: np.ndarray
    """Standard deviations from the scatter of blocks of windows; NaN where a number stands at a bound."""
    trims: dict[str, np.ndarray]
    """(3,) of each flight, N m."""
    cost: tuple[float, float]
    """Mean loss before and after."""
    normal: Normal
    """Normal equations at ``values``."""
    data: Predictions
    """What was predicted."""

    def at_bound(self, number: Number) -> bool:
        """Whether a number stands where it may not go further."""
        value, margin = self.values[self.numbers.index(number)], AT_BOUND * number.scale
        return bool(number.held or value <= number.low + margin or value >= number.high - margin)

    @property
    def pressed(self) -> list[str]:
        """Names of strengths of effects (`Effect.strengths`) that stand at a bound."""
        fitted = (n for n in self.numbers if not n.held)
        return [n.name for n in fitted if n.field in KNOWN[n.effect].strengths and self.at_bound(n)]

    def uncertainty(self, effect: str) -> dict[str, float | list[float | None] | None]:
        """Standard deviations of an effect's numbers by field; None where one stands at a bound."""
        found: dict[str, Any] = {}
        for number, std in zip(self.numbers, self.deviations, strict=True):
            if number.effect == effect:
                known = float(std) if np.isfinite(std) else None
                found[number.field] = known if number.index is None else [*found.get(number.field, []), known]
        return found

    @property
    def correlation(self) -> np.ndarray:
        """(N, N) of the numbers' errors; NaN for those at a bound."""
        free = np.array([not self.at_bound(n) for n in self.numbers])
        inverse = np.linalg.inv(self.normal.weighed(free))[: free.sum(), : free.sum()]
        spread = np.sqrt(np.diag(inverse))
        found = np.full((len(free), len(free)), np.nan)
        found[np.ix_(free, free)] = inverse / np.outer(spread, spread)
        return found

    def foreseen(self, numbers: Sequence[Number], model: Quadrotor) -> float:
        """Mean loss that more numbers promise, as far as the loss's curvature where they begin tells.

        Args:
            numbers: of effects that are not fitted yet.
            model: with these effects, at values at which they hardly act.
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
        """By how much the mean loss grows without some effects, as far as its curvature at the optimum tells."""
        matrix, change, answer = self._answer(effects)
        whole = change + answer
        return float(0.5 * whole @ matrix @ whole / self.data.count)

    def without(self, effects: Sequence[str]) -> Left:
        """What is left without some effects.

        The other numbers make up for them as far as the curvature of the loss at the optimum tells; not at all if that
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
        """What is left with all effects."""
        return self.judged(self.model)

    def judged(self, model: Quadrotor) -> Left:
        """What another model leaves of the same predictions, each flight with the trim that was found."""
        return self._left(model, self._trims)[0]

    def loss(self, model: Quadrotor) -> float:
        """Mean loss of the same predictions by another model, likewise."""
        return self._left(model, self._trims)[1]

    @property
    def _trims(self) -> np.ndarray:
        return np.array(list(self.trims.values()))

    def _left(self, model: Quadrotor, trims: np.ndarray) -> tuple[Left, float]:
        """What a model leaves with some trims, and its mean loss."""
        trimmed = _trimmed(model)
        data = self.data.started(trimmed)
        errors = data.errors(trimmed, trims)
        losses = data.losses(errors)
        return Left(model, errors, losses), data.mean(losses, trims)

    def _answer(self, effects: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How the fit answers to some effects' absence, all in scales: numbers first, then the trims if estimated.

        Returns:
            The weighed matrix, the change of the effects' numbers to neutral, and the move of the others that makes up
            for it.
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
    """What a model leaves of the predictions of a fit, each by commands and by rotor speeds where measured.

    Attributes:
        model: the model.
        errors: (W, H, 2) of attitude and velocity, over what `hold` errs.
        losses: (W, H, 2) of these.
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
    """Fit numbers of a model to its predictions of attitude and velocity at `HORIZONS`.

    The loss of a window is the norm of its error over what `hold` errs at that horizon, squared where small and linear
    where large, so that no window that goes astray decides. Commands go in, and in a second set of predictions the
    measured rotor speeds of the flights that have them; both count. Rotor speeds and memories at a window's start come
    from what was logged before, by the model as it stands at that step of the fit. Every flight counts the same,
    however long, unless ``weights`` say otherwise. Solved by projected Gauss-Newton steps; run with x64 enabled.

    Args:
        model: where to start; effects it lacks are added at neutral.
        logs: flights.
        numbers: what may move (`plausible_numbers`, `free_numbers`); values outside their bounds are brought inside.
        faults: of the recording, taken out first.
        weights: of flights by name, where not 1.
        trimmed: estimate a trim torque of every flight beside the numbers. Without it the numbers are those that serve
            best on a flight whose trim nobody knows.
        trims: (3,) of each flight by name, N m, to start from; zero by default.
        iterations: steps at most.
        most_windows: windows overlap, and every second or third of them tells nearly as much; by default all count.
        progress: told what happens.

    Raises:
        CfbError: no numbers, no 64-bit numbers, or no log that allows a window.
    """
    if jnp.result_type(float) != np.float64:
        raise CfbError('refine needs 64-bit numbers: jax.config.update("jax_enable_x64", True) before anything else.')
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
    """(N,) lowest and highest values, and scales."""
    low, high, scale = np.array([(n.low, n.high, n.scale) for n in numbers]).T
    return low, high, scale


def _prepared(model: Quadrotor, numbers: tuple[Number, ...]) -> Quadrotor:
    """Precise, with every effect that is asked for and a trim as the last one."""
    names = dict.fromkeys(n.effect for n in numbers)
    here = {type(e).name for e in model.effects}
    added = tuple(KNOWN[name].neutral() for name in names if name not in here)
    if {RotorDrag.name, ParasiticDrag.name} & {*names, *here}:
        # Their drag carries a wind; a conductance beside it would count it twice.
        added = tuple(Wind(0.0, 0.0) if isinstance(effect, Wind) else effect for effect in added)
    return _trimmed(Quadrotor(model.parameters, (*model.effects, *added), body=model.body))


def _trimmed(model: Quadrotor) -> Quadrotor:
    effects = (*model.effects, Trim(jnp.zeros(3)))
    return Quadrotor(model.parameters, effects, body=model.body, rotor_loads="instant")
