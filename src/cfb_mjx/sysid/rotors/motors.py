"""Motor constants from commands and measured rotor speeds, for flights under feedback and for bench steps.

The paper's model (section III-B, eq. 5) has one time constant T and a gain K. Optional extras are an offset (the steady
speed is then affine in the command), separate time constants for spin-up and spin-down, and a dead time. Each extra is
tested against the model without it. The estimator is described in `cfb_mjx.sysid.rotors.motor_filter`.

If extras are fitted, `common_lag` finds the single time constant equivalent to the whole motor.

A direct fit of a model without dead time would explain the dead time by noise and bias the constants. Instead, the full
motor is fitted first. Then the single lag is chosen whose response to the recorded commands is closest to that of the
full motor. Both responses are simulated from the commands alone, so neither noise nor feedback biases this
least-squares step.

`replay` simulates fitted motors with the recorded commands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.bench_tables import MotorRecord
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.fitted import Estimate, numbers_of
from cfb_mjx.sysid.rotors.motor_filter import (
    DEAD_TIME_UNIT,
    Motor,
    MotorData,
    Optimum,
    Tracks,
    first_guess,
    gather,
    maximise,
    simulate,
    undisturbed,
)


@eqx.filter_jit
def _response(vector, tracks: Tracks):
    def speed(x):
        found = simulate(Motor.from_vector(x), tracks) * tracks.judged
        return found, found

    slope, found = jax.jacfwd(speed, has_aux=True)(vector)
    return found, slope


def common_lag(full: Optimum, data: MotorData) -> tuple[float, float]:
    """Time constant of the closest single lag, and its standard deviation, s.

    Args:
        full: fit with spin-up and spin-down constants, a dead time, or both.
        data: recordings to which it was fitted.
    """
    tracks = jax.tree.map(jnp.asarray, data.tracks)
    goal, full_slope = (np.asarray(x) for x in _response(jnp.asarray(full.vector), tracks))
    vector = np.array(full.vector)
    motor = full.motor
    vector[2:4], vector[4] = np.log(max(0.5 * (motor.spin_up + motor.spin_down) + motor.dead_time, 2e-3)), 0.0
    slope = np.zeros_like(goal)
    for _ in range(12):
        found, slope = (np.asarray(x) for x in _response(jnp.asarray(vector), tracks))
        slope = slope[..., 2] + slope[..., 3]
        change = np.sum(slope * (goal - found)) / np.sum(slope**2)
        vector[2:4] += np.clip(change, -0.5, 0.5)
        if abs(change) < 1e-8:
            break
    # Derivative of the closest lag with respect to the constants of the full motor; gain and offset affect both alike.
    moved = np.einsum("sn,snk->k", slope, full_slope) / np.sum(slope**2) @ full.directions
    level = [i for i, name in enumerate(full.names) if name in ("motor_gain", "motor_speed_offset")]
    moved[level] = 0.0
    std = float(np.sqrt(moved @ full.uncertainty.covariance @ moved))
    lag = float(np.exp(vector[2]))
    return lag, std * lag


UNITS = {
    "motor_time_constant": "s",
    "motor_gain": "rad/s",
    "motor_speed_offset": "rad/s",
    "spin_up_time_constant": "s",
    "spin_down_time_constant": "s",
    "dead_time": "s",
}
ENTRIES = ("motor_time_constant", "motor_gain", "motor_speed_offset")
"""Constants of the motors in a model file."""
SIGNIFICANT = 0.01
"""Largest p-value at which an extra is supported."""
_INNER = frozenset({"asymmetric", "dead_time"})
"""Extras that are always tested, because omitting a real one biases all other constants."""
_LAGS = ("spin_up_time_constant", "spin_down_time_constant")
_EXTRA_NAMES = {
    "asymmetric": _LAGS,
    "dead_time": ("dead_time",),
    "offset": ("motor_speed_offset",),
}
_UNKNOWN = {
    "motor_gain": "the commands hardly determine the gain",
    "motor_speed_offset": "the range of the commands is too narrow to determine the offset",
    "motor_time_constant": "the commands hardly change, so the lag cannot be determined",
    "spin_up_time_constant": "the commands hardly ever rise, so the spin-up lag cannot be determined",
    "spin_down_time_constant": "the commands hardly ever fall, so the spin-down lag cannot be determined",
    "dead_time": "the commands hardly change, so a dead time cannot be determined",
}


@dataclass(frozen=True)
class ExtraTest:
    """Likelihood-ratio test of an extra against the same model without it.

    The log-likelihood ratio is divided by the variance inflation of the bootstrap, because the innovations are
    correlated if the noise model is not quite right.

    Attributes:
        name: ``asymmetric``, ``dead_time`` or ``offset``.
        p_value: of the ratio.
        bic_gain: decrease of the Bayesian information criterion; positive if the extra is favoured.
    """

    name: str
    p_value: float
    bic_gain: float

    @property
    def supported(self) -> bool:
        """Whether the extra is significant and lowers the Bayesian information criterion."""
        return bool(self.p_value < SIGNIFICANT and self.bic_gain > 0)


@dataclass(frozen=True)
class GroupFit:
    """Fit of one motor, or of all motors treated as one.

    Attributes:
        estimates: identified constants, SI. ``motor_time_constant`` is always the single time constant of a model
            without extras; in a fit with extras, it is the closest one (`common_lag`).
        unidentifiable: constants that the data do not determine: name to explanation.
        tests: of the extras, including those that were not requested.
        extras: extras in the fit: those requested, and those the data support, without which the other constants would
            be biased.
        optimum: maximum-likelihood estimate with those extras.
    """

    estimates: dict[str, Estimate]
    unidentifiable: dict[str, str]
    tests: tuple[ExtraTest, ...]
    extras: frozenset[str]
    optimum: Optimum

    @property
    def motor(self) -> Motor:
        """Constants and noise levels of the fit."""
        return self.optimum.motor

    def to_json(self) -> dict:
        """Constants, tests, noise levels and diagnostics as a JSON-compatible dictionary."""
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
        common: fit of all motors treated as one.
        motors: fits of single motors, by number; empty unless requested.
        differences: p-value of the hypothesis that all motors share a constant, by constant; empty unless requested.
        records: recordings that were fitted.
    """

    common: GroupFit
    motors: dict[int, GroupFit]
    differences: dict[str, float]
    records: tuple[MotorRecord, ...]

    def values(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Values (4,) and standard deviations (4,) of a constant for a model file; None if it is not identified.

        A motor that was not fitted, or whose own data do not determine the constant, gets the common value.
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
    """Fit time constant, gain and optional extras to recordings of commands and rotor speeds.

    Args:
        records: flights (`record_of`) or bench steps; run with x64 enabled.
        nominal: initial values, and the value of the offset unless it is fitted.
        offset: fit the steady rotor speed at zero command (``motor_speed_offset``) even if the data do not require it.
        asymmetric: fit separate time constants for spin-up and spin-down even if the data do not require them.
        dead_time: fit the time from a command to its first effect even if the data do not require it. It is continuous,
            not a multiple of the row interval.
        per_motor: also fit every motor separately.
        progress: called with (done, total).

    Raises:
        CfbError: there is too little data, or ``per_motor`` is set and the recordings do not state the motor.
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
    """Fit every motor separately, with the extras of the common fit.

    Args:
        fit: fit of all motors treated as one.
        nominal: initial values.
        progress: called with (done, total).

    Raises:
        CfbError: there is too little data, or the recordings do not state the motor.
    """
    numbers = _motor_numbers(fit.records)
    groups = {}
    for done, number in enumerate(numbers):
        # All motors together determine the extras better than one motor.
        data = _gathered(fit.records, number)
        groups[number] = _fit_group(data, nominal, number, fit.common.extras, fit.common.extras)
        if progress is not None:
            progress(done + 2, 1 + len(numbers))
    return MotorFit(fit.common, groups, _differences(groups), fit.records)


def fit_again(fit: MotorFit, records: Sequence[MotorRecord], nominal: Parameters) -> MotorFit:
    """Fit all motors, treated as one, to other recordings, with the same extras as in ``fit``."""
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
    """Choose the extras: test each by removing it from the largest model, keep those requested or supported.

    Returns:
        The fit with the chosen extras, the tests of all extras, and the chosen extras.
    """
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
            # A real offset that is held at zero would bias the gain and, with it, the lag.
            best, extras = shifted, extras | {"offset"}
    return best, tuple(tests), extras


def _without(fit: Optimum, extra: str, guess: np.ndarray) -> np.ndarray:
    """Initial vector of the model without an extra, from a fit with it."""
    # The noise now has to explain what the extra did, so its levels start from the first guess again.
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
    """p-values of the hypothesis that all motors share a constant, from the weighted spread of their estimates."""
    found = {}
    for name in UNITS:
        known = [g.estimates[name] for g in groups.values() if name in g.estimates]
        if len(known) > 1:
            value, weight = np.array([e.value for e in known]), np.array([e.std**-2.0 for e in known])
            spread = np.sum(weight * (value - np.sum(weight * value) / np.sum(weight)) ** 2)
            found[name] = chi_square_tail(spread, len(known) - 1)
    return found


def chi_square_tail(value: float, degrees: int) -> float:
    """Probability that a chi-square variable with ``degrees`` degrees of freedom exceeds ``value``."""
    return float(gammaincc(jnp.asarray(degrees / 2), jnp.asarray(value / 2)))


@dataclass(frozen=True)
class Replay:
    """Simulation of one motor over the piece of its recordings in which the command varies most.

    Attributes:
        motor: number 1 to 4; 0 if not known.
        time: (n,) s from the start of the piece.
        command: (n,) in [0, 1].
        measured: (n,) rotor speed, rad/s; NaN where missing.
        simulated: (n,) rotor speed from the commands alone, rad/s.
        rms: of measured minus simulated speed over all recordings of the motor, rad/s.
    """

    motor: int
    time: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray
    rms: float


def replay(fit: MotorFit) -> list[Replay]:
    """Simulate every motor from its commands, with its own constants if it was fitted separately."""
    found = []
    for number in sorted({n for record in fit.records for n in record.motors}):
        data = gather(fit.records, number)
        if data is None:
            continue
        tracks = data.tracks
        vector = fit.motors.get(number, fit.common).optimum.vector
        simulated = np.asarray(undisturbed(jnp.asarray(vector), jax.tree.map(jnp.asarray, tracks)).rotor_speed)
        judged = tracks.judged > 0
        error = (tracks.rotor_speed - simulated)[judged]
        # Do not show a piece that is much shorter than the others, even if the command varies a lot in it.
        enough = judged.sum(axis=1) >= 0.5 * judged.sum(axis=1).max()
        moves = [float(np.std(c[j])) if ok else -1.0 for c, j, ok in zip(tracks.command, judged, enough, strict=True)]
        shown = int(np.argmax(moves))
        rows = slice(0, int(np.flatnonzero(judged[shown])[-1]) + 1)
        measured = np.where(tracks.measured[shown] > 0, tracks.rotor_speed[shown], np.nan)
        columns = (tracks.time[shown], tracks.command[shown], measured, simulated[shown])
        time, command, measured, alone = (np.asarray(column)[rows] for column in columns)
        found.append(Replay(number, time, command, measured, alone, float(np.sqrt(np.mean(error**2)))))
    return found
