"""Motor constants from commands and measured rotor speeds: flights under feedback as well as bench steps.

The paper (section III-B, eq. 5) has one time constant T and a gain K. Optional extras: an offset (steady speed affine
in the command), separate time constants for spin-up and spin-down, and a dead time. Each extra is tested against the
model without it. The estimator is described in `cfb_mjx.sysid.rotors.motor_filter`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.bench_tables import MotorRecord
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification.result import Estimate, numbers_of
from cfb_mjx.sysid.rotors.common_lag import common_lag
from cfb_mjx.sysid.rotors.motor_filter import DEAD_TIME_UNIT, Motor
from cfb_mjx.sysid.rotors.motor_likelihood import Optimum, first_guess, maximise
from cfb_mjx.sysid.rotors.motor_tracks import MotorData, gather

UNITS = {
    "motor_time_constant": "s",
    "motor_gain": "rad/s",
    "motor_speed_offset": "rad/s",
    "spin_up_time_constant": "s",
    "spin_down_time_constant": "s",
    "dead_time": "s",
}
ENTRIES = ("motor_time_constant", "motor_gain", "motor_speed_offset")
"""What a model file holds of the motors."""
SIGNIFICANT = 0.01
_INNER = frozenset({"asymmetric", "dead_time"})
"""Extras tested whether asked for or not: left out where they are real, they bend all other constants."""
_LAGS = ("spin_up_time_constant", "spin_down_time_constant")
_EXTRA_NAMES = {
    "asymmetric": _LAGS,
    "dead_time": ("dead_time",),
    "offset": ("motor_speed_offset",),
}
_UNKNOWN = {
    "motor_gain": "the commands hardly tell the gain",
    "motor_speed_offset": "the commands stay in too narrow a range to tell the offset",
    "motor_time_constant": "the commands hardly change, so the lag does not show",
    "spin_up_time_constant": "the commands hardly ever rise, so the spin-up lag does not show",
    "spin_down_time_constant": "the commands hardly ever fall, so the spin-down lag does not show",
    "dead_time": "the commands hardly change, so a dead time does not show",
}


@dataclass(frozen=True)
class ExtraTest:
    """Whether the data ask for an extra: likelihood ratio against the same model without it.

    Attributes:
        name: ``asymmetric``, ``dead_time`` or ``offset``.
        p_value: of the ratio, after dividing it by the bootstrap's variance inflation: rows are not independent where
            the noise model is not quite right.
        bic_gain: by how much the Bayesian information criterion falls, likewise; positive is for the extra.
    """

    name: str
    p_value: float
    bic_gain: float

    @property
    def supported(self) -> bool:
        """Both criteria agree: significant, and worth its parameter."""
        return bool(self.p_value < SIGNIFICANT and self.bic_gain > 0)


@dataclass(frozen=True)
class GroupFit:
    """One motor, or all as if they were one.

    Attributes:
        estimates: identified constants, SI. ``motor_time_constant`` is always the one constant of a plain model; where
            there are extras it is the nearest to them (`common_lag`).
        unidentifiable: what the data cannot tell: name to explanation.
        tests: of the extras, also of those that were not asked for.
        extras: the fit holds: those asked for, and those that the data support, without which the other constants
            would be wrong.
        optimum: of the fit with those extras.
    """

    estimates: dict[str, Estimate]
    unidentifiable: dict[str, str]
    tests: tuple[ExtraTest, ...]
    extras: frozenset[str]
    optimum: Optimum

    @property
    def motor(self) -> Motor:
        """Constants and noise levels, with the extras."""
        return self.optimum.motor

    def to_json(self) -> dict:
        """Constants, tests, noise levels and how well they describe the rows, in JSON terms."""
        tests = {t.name: {"p_value": t.p_value, "bic_gain": t.bic_gain, "supported": t.supported} for t in self.tests}
        noise = self.motor
        return {
            "parameters": numbers_of(self.estimates),
            "fitted_with": sorted(self.extras),
            "unidentifiable": list(self.unidentifiable),
            "unidentifiable_because": self.unidentifiable,
            "extras": tests,
            "noise": {
                "reading_radps": noise.reading,
                "walk_radps_per_sqrt_s": noise.walk,
                "wander_radps": noise.wander,
            },
            "innovation_lag_one_correlation": self.optimum.whiteness,
            "share_of_rows_beyond_5_std": self.optimum.outliers,
            "rows": self.optimum.rows,
        }


@dataclass(frozen=True)
class MotorFit:
    """Result of `fit_motors`.

    Attributes:
        common: all motors as one.
        motors: each on its own, by number; empty unless asked for.
        differences: p-value that the motors agree, by constant; empty likewise.
        records: what was fitted.
    """

    common: GroupFit
    motors: dict[int, GroupFit]
    differences: dict[str, float]
    records: tuple[MotorRecord, ...]

    def values(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """(4,) values and standard deviations for a model file; None where the data do not tell this constant.

        A motor that was not fitted, or whose own data do not tell the constant, gets the common one.
        """
        groups = [self.motors.get(i, self.common) for i in range(1, 5)]
        each = (g.estimates.get(name, self.common.estimates.get(name)) for g in groups)
        found = [e for e in each if e is not None]
        if len(found) < len(groups):
            return None
        return np.array([e.value for e in found]), np.array([e.std for e in found])


def fit_motors(
    records: Sequence[MotorRecord],
    nominal: Parameters,
    offset: bool = False,
    asymmetric: bool = False,
    dead_time: bool = False,
    per_motor: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> MotorFit:
    """Fit T and K, and what else is asked for, to recordings of commands and rotor speeds.

    Args:
        records: flights (`record_of`) or bench steps; run with x64 enabled.
        nominal: where to start, and the value of the offset unless it is fitted.
        offset: fit the steady rotor speed at zero command (``motor_speed_offset``) also where the data do not ask for
            it.
        asymmetric: separate time constants for spin-up and spin-down.
        dead_time: fit the time from a command to its first effect; any number, not a multiple of the row interval.
        per_motor: fit every motor on its own as well.
        progress: called with (done, total).

    Raises:
        CfbError: too little data, or ``per_motor`` with recordings that do not say which motor they are of.
    """
    if per_motor:
        _motor_numbers(records)
    asked = {"offset": offset, "asymmetric": asymmetric, "dead_time": dead_time}
    extras = frozenset(name for name, on in asked.items() if on)
    common = MotorFit(_fit_group(_gathered(records, None), nominal, None, extras, None), {}, {}, tuple(records))
    if progress is not None:
        progress(1, 1 + len(_motor_numbers(records)) if per_motor else 1)
    return each_motor(common, nominal, progress) if per_motor else common


def each_motor(fit: MotorFit, nominal: Parameters, progress: Callable[[int, int], None] | None = None) -> MotorFit:
    """The same with every motor fitted on its own, with the extras that all of them together need.

    Args:
        fit: of all motors as one.
        nominal: where to start.
        progress: called with (done, total).

    Raises:
        CfbError: too little data, or recordings that do not say which motor they are of.
    """
    numbers = _motor_numbers(fit.records)
    groups = {}
    for done, number in enumerate(numbers):
        # One motor alone has less to say about extras than all together.
        data = _gathered(fit.records, number)
        groups[number] = _fit_group(data, nominal, number, fit.common.extras, fit.common.extras)
        if progress is not None:
            progress(done + 2, 1 + len(numbers))
    return MotorFit(fit.common, groups, _differences(groups), fit.records)


def fit_again(fit: MotorFit, records: Sequence[MotorRecord], nominal: Parameters) -> MotorFit:
    """The same model of all motors as one, with the extras it holds, fitted to other recordings."""
    extras = fit.common.extras
    common = _fit_group(_gathered(records, None), nominal, None, extras, extras)
    return MotorFit(common, {}, {}, tuple(records))


def _motor_numbers(records: Sequence[MotorRecord]) -> list[int]:
    numbers = sorted({n for r in records for n in r.motors} - {0})
    if not numbers:
        raise CfbError(
            f"{', '.join(r.name for r in records)}: does not say which motor it is of; name the columns "
            "omega1..omega4 to fit each on its own."
        )
    return numbers


def _gathered(records: Sequence[MotorRecord], number: int | None) -> MotorData:
    data = gather(records, number)
    if data is None or data.rows < 50:
        what = f"motor {number} has" if number else "there are"
        names = ", ".join(r.name for r in records)
        raise CfbError(f"{names}: {what} too few rotor speeds in a row to fit; at least 50 rows without a gap.")
    return data


def _fit_group(data: MotorData, nominal: Parameters, motor: int | None, asked: frozenset, decided) -> GroupFit:
    start = {
        name: float(np.mean(x) if motor is None else np.broadcast_to(x, 4)[motor - 1])
        for name in ("motor_time_constant", "motor_gain", "motor_speed_offset")
        for x in [np.asarray(getattr(nominal, name))]
    }
    guess = first_guess(data, *start.values())
    if decided is None:
        best, tests, extras = _decide(data, asked, guess)
    else:
        best, tests, extras = maximise(data, _free(decided), guess), (), decided
    estimates = _estimates(best, start | dict.fromkeys(_LAGS, start["motor_time_constant"]) | {"dead_time": 0.0})
    if extras & _INNER and set(estimates) & {*_LAGS, "motor_time_constant"}:
        lag, std = common_lag(best, data)
        estimates = {"motor_time_constant": Estimate(lag, std, "s", start["motor_time_constant"])} | {
            name: e for name, e in estimates.items() if name != "motor_time_constant"
        }
    return GroupFit(estimates, _unidentifiable(best, data), tests, extras, best)


def _decide(data: MotorData, asked: frozenset, guess: np.ndarray) -> tuple[Optimum, tuple[ExtraTest, ...], frozenset]:
    """The fit with the extras asked for or needed, and the tests of all: each is left out of the largest model."""
    all_of = asked | _INNER
    whole = maximise(data, _free(all_of), guess)
    smaller = {e: maximise(data, _free(all_of - {e}), _without(whole, e, guess)) for e in sorted(all_of)}
    nearest = min(smaller.values(), key=lambda o: o.loss)
    if nearest.loss < whole.loss:
        whole = maximise(data, _free(all_of), nearest.vector)
    tests = [_test(e, whole, fit) for e, fit in smaller.items()]
    extras = asked | {t.name for t in tests if t.supported}
    known = {all_of: whole} | {all_of - {e}: fit for e, fit in smaller.items()}
    best = known[extras] if extras in known else maximise(data, _free(extras), guess)
    if "offset" not in asked:
        shifted = maximise(data, _free(extras | {"offset"}), best.vector)
        tests.append(_test("offset", shifted, best))
        if tests[-1].supported:
            # Held at zero where the data contradict it, it would bend the gain and with it the lag.
            best, extras = shifted, extras | {"offset"}
    return best, tuple(tests), extras


def _without(fit: Optimum, extra: str, guess: np.ndarray) -> np.ndarray:
    """The vector of ``fit`` with an extra taken out: where to start the model without it."""
    # The noise has to explain what the extra did, so its levels start wide again.
    vector = np.concatenate([fit.vector[:5], guess[5:]])
    if extra == "dead_time":
        vector[2:4] = np.log(np.maximum(np.exp(vector[2:4]) + DEAD_TIME_UNIT * vector[4], 2e-3))
        vector[4] = 0.0
    elif extra == "asymmetric":
        vector[2:4] = vector[2:4].mean()
    else:
        vector[:2] = guess[:2]
    return vector


def _free(extras: frozenset) -> tuple[str, ...]:
    return (
        *(_LAGS if "asymmetric" in extras else ("motor_time_constant",)),
        "motor_gain",
        *(("motor_speed_offset",) if "offset" in extras else ()),
        *(("dead_time",) if "dead_time" in extras else ()),
    )


def _estimates(best: Optimum, preset: dict[str, float]) -> dict[str, Estimate]:
    return {
        name: Estimate(best.value(name), best.std(name), UNITS[name], preset[name])
        for name in best.names
        if name not in best.uncertainty.names
    }


def _unidentifiable(best: Optimum, data: MotorData) -> dict[str, str]:
    unknown = best.uncertainty.names
    reasons = {name: _UNKNOWN[name] for name in unknown}
    if {"motor_gain", "motor_speed_offset"} <= set(unknown):
        u = float(np.mean(data.tracks.command[data.tracks.judged > 0]))
        together = best.value("motor_gain") * u + best.value("motor_speed_offset")
        text = f"motor_gain and motor_speed_offset only together: {together:.4g} rad/s at u = {u:.3g}"
        reasons |= {"motor_gain": text, "motor_speed_offset": text}
    return reasons


def _test(extra: str, larger: Optimum, smaller: Optimum) -> ExtraTest:
    if set(_EXTRA_NAMES[extra]) & set(larger.uncertainty.names):
        return ExtraTest(extra, 1.0, -math.log(larger.rows))
    widening = max(larger.inflation[larger.names.index(name)] for name in _EXTRA_NAMES[extra])
    ratio = float(max(2 * (smaller.loss - larger.loss), 0.0) / widening**2)
    return ExtraTest(extra, chi_square_tail(ratio, 1), ratio - math.log(larger.rows))


def _differences(groups: dict[int, GroupFit]) -> dict[str, float]:
    """p-value that all motors share a constant, from their estimates' weighted spread."""
    found = {}
    for name in UNITS:
        known = [g.estimates[name] for g in groups.values() if name in g.estimates]
        if len(known) > 1:
            value, weight = np.array([e.value for e in known]), np.array([e.std**-2.0 for e in known])
            spread = np.sum(weight * (value - np.sum(weight * value) / np.sum(weight)) ** 2)
            found[name] = chi_square_tail(spread, len(known) - 1)
    return found


def chi_square_tail(value: float, degrees: int) -> float:
    """Probability that a chi-square variable with ``degrees`` of freedom exceeds ``value``."""
    return float(gammaincc(jnp.asarray(degrees / 2), jnp.asarray(value / 2)))
