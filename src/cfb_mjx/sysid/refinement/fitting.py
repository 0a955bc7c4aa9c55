"""The fit itself: projected Gauss-Newton steps on the predictions' robust loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import KNOWN, ParasiticDrag, RotorDrag, Wind
from cfb_mjx.sysid.refinement.numbers import Number, with_values
from cfb_mjx.sysid.refinement.predictions import AT_BOUND, TRIM, Predictions, Trim
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

    def at_bound(self, number: Number) -> bool:
        """Whether a number stands where it may not go further."""
        value, margin = self.values[self.numbers.index(number)], AT_BOUND * number.scale
        return bool(value <= number.low + margin or value >= number.high - margin)


def refine(
    model: Quadrotor,
    logs: Sequence[FlightLog],
    numbers: Sequence[Number],
    faults: SensorFaults = HEALTHY,
    weights: Mapping[str, float] | None = None,
    trimmed: bool = True,
    iterations: int = 12,
    progress: Callable[[str], None] = lambda _: None,
) -> Refinement:
    """Fit numbers of a model to its predictions of attitude and velocity at `HORIZONS`.

    The loss of a window is the norm of its error over what `hold` errs at that horizon, squared where small and linear
    where large, so that no window that goes astray decides. Commands go in, and in a second set of predictions the
    measured rotor speeds of the flights that have them; both count. Rotor speeds at a window's start come from the
    commands before and the model as it was before the fit. Every flight counts the same, however long, unless
    ``weights`` say otherwise. Solved by projected Gauss-Newton steps; run with x64 enabled.

    Args:
        model: where to start; effects it lacks are added at neutral.
        logs: flights.
        numbers: what may move (`plausible_numbers`, `free_numbers`); values outside their bounds are brought inside.
        faults: of the recording, taken out first.
        weights: of flights by name, where not 1.
        trimmed: estimate a trim torque of every flight beside the numbers. Without it the numbers are those that serve
            best on a flight whose trim nobody knows.
        iterations: steps at most.
        progress: told what happens.

    Raises:
        CfbError: no numbers, or no log allows a window.
    """
    if not numbers:
        raise CfbError("refine needs at least one number to fit; name an effect.")
    numbers = tuple(numbers)
    model = _prepared(model, numbers)
    shares = np.array([(weights or {}).get(log.name, 1.0) for log in logs])
    data = Predictions.of(model, [faults.repaired(log) for log in logs], shares / shares.mean())
    low, high = (np.array([getattr(n, side) for n in numbers]) for side in ("low", "high"))
    scale = np.array([n.scale for n in numbers])
    values = np.clip([n.of(model) for n in numbers], low, high)
    trims = np.zeros((len(logs), 3))
    start, damping = values.copy(), 1e-2
    first = cost = data.cost(with_values(model, numbers, values), trims)
    for step in range(iterations):
        normal = data.normal_equations(model, numbers, values, trims, trimmed)
        better = None
        while damping < 1e6:
            change, turn = normal.step(damping, (values - start) / scale, trims / TRIM, values, low, high)
            tried, other = np.clip(values + change * scale, low, high), trims + turn * TRIM
            reached = data.cost(with_values(model, numbers, tried), other)
            if reached < cost:
                better = tried, other, reached
                break
            damping *= 8
        if better is None:
            break
        gained, damping = cost - better[2], damping / 4
        values, trims, cost = better
        progress(f"step {step + 1}: mean loss {cost:.4f}")
        if gained < 1e-4 * cost:
            break
    normal = data.normal_equations(model, numbers, values, trims, trimmed)
    deviations = normal.deviations(values, low, high, scale)
    found = with_values(model, numbers, values)
    found = Quadrotor(found.parameters, found.effects[:-1], body=found.body)
    named = {log.name: trim for log, trim in zip(logs, trims, strict=True)}
    return Refinement(found, numbers, values, deviations, named, (first, cost))


def _prepared(model: Quadrotor, numbers: tuple[Number, ...]) -> Quadrotor:
    """Precise, with every effect that is asked for and a trim as the last one."""
    names = dict.fromkeys(n.effect for n in numbers)
    here = {type(e).name for e in model.effects}
    added = tuple(KNOWN[name].neutral() for name in names if name not in here)
    if {RotorDrag.name, ParasiticDrag.name} & {*names, *here}:
        # Their drag carries a wind; a conductance beside it would count it twice.
        added = tuple(Wind(0.0, 0.0) if isinstance(effect, Wind) else effect for effect in added)
    effects = (*model.effects, *added, Trim(jnp.zeros(3)))
    return Quadrotor(model.parameters, effects, body=model.body, integrator="rk4", rotor_loads="instant")
