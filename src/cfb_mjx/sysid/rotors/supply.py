"""Motors with a varying supply voltage: dependence of the rotor speed on it, on a bench and in flight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypedDict, Unpack

import numpy as np

from cfb_mjx.logs.bench_tables import MotorRecord
from cfb_mjx.model.effects.battery_sag import NOMINAL_VOLTAGE, BatterySag
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.rotors.motors import MotorFit, each_motor, fit_again, fit_motors
from cfb_mjx.sysid.rotors.tables import VARIES

SURE = 3.0
"""Significance that a slope needs, in standard deviations."""


class Extras(TypedDict, total=False):
    """Options of `fit_motors`: what to fit in addition to lag and gain."""

    offset: bool
    asymmetric: bool
    dead_time: bool


def fit_under_supply(
    records: Sequence[MotorRecord],
    nominal: Parameters,
    per_motor: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **extras: Unpack[Extras],
) -> tuple[MotorFit, list[str]]:
    """Fit motors to commands, or to commands times voltage if that is likelier.

    The voltage is considered if all recordings have one and it varies.

    Args:
        records: as for `fit_motors`.
        nominal: as for `fit_motors`.
        per_motor: as for `fit_motors`.
        progress: as for `fit_motors`.
        **extras: as for `fit_motors`.

    Returns:
        The fit, whose gain is that at 3.7 V if the voltage is used, and notes on the decision.

    Raises:
        CfbError: as `fit_motors`.
    """

    def finished(fit: MotorFit) -> MotorFit:
        return each_motor(fit, nominal, progress) if per_motor else fit

    plain = fit_motors(records, nominal, **extras)
    if (voltages := _telling_voltages(records)) is None:
        return finished(plain), []
    pairs = zip(records, voltages, strict=True)
    scaled = [replace(r, command=r.command * voltage[:, None] / NOMINAL_VOLTAGE) for r, voltage in pairs]
    followed = fit_motors(scaled, nominal, **extras)
    gained = plain.common.optimum.loss - followed.common.optimum.loss
    if gained <= 0:
        return finished(plain), [
            "speed does not follow the voltage of the supply: the command alone explains it better."
        ]
    said = (
        f"speed follows command times voltage (log-likelihood +{gained:.0f} over the command alone): the gain is that "
        f"at {NOMINAL_VOLTAGE} V; the effect battery_sag makes a model follow the voltage."
    )
    return finished(followed), [said]


@dataclass(frozen=True)
class Sag:
    """Dependence of rotor speed on battery voltage: slope and lag of `BatterySag`, and the slope's std."""

    slope: float
    lag: float
    std: float


SLOPES = (0.0, 0.5, 1.0)
"""Slopes at which the likelihood is evaluated; the optimum is that of a parabola through them."""
LAGS = (0.02, 3.0)
"""Lags between battery voltage and its effect on the rotors that are tried, s. The rotors respond to every dip under
load, or only to the state of charge."""


def fit_with_sag(
    records: Sequence[MotorRecord], nominal: Parameters, **extras: Unpack[Extras]
) -> tuple[MotorFit, Sag | None]:
    """Fit every motor separately, together with their common dependence on battery voltage (``battery_sag``).

    Dividing the speed by ``1 + slope (V - 3.7 V) / 3.7 V`` removes this dependence.

    Args:
        records: as for `fit_motors`.
        nominal: as for `fit_motors`.
        **extras: as for `fit_motors`.

    Returns:
        The fit, whose constants are those at 3.7 V, and the dependence. The latter is None if no voltage was logged, if
        it hardly varies, or if the motors do not depend on it.

    Raises:
        CfbError: as `fit_motors`.
    """
    fit = fit_motors(records, nominal, **extras)
    if _telling_voltages(records) is None:
        return each_motor(fit, nominal), None

    def divided(slope: float, lag: float) -> tuple[MotorFit, float]:
        """Fit to the divided speeds, and its negative log-likelihood of the measured speeds."""
        factors = [1 + slope * (_felt(r, lag) - NOMINAL_VOLTAGE) / NOMINAL_VOLTAGE for r in records]
        pairs = zip(records, factors, strict=True)
        found = fit_again(fit, [replace(r, rotor_speed=r.rotor_speed / f[:, None]) for r, f in pairs], nominal)
        best = found.common.optimum
        return found, best.loss + best.rows * float(np.mean(np.log(np.concatenate(factors))))

    low, high = BatterySag.prior["slope"]
    best, least = None, fit.common.optimum.loss
    for lag in LAGS:
        losses = [fit.common.optimum.loss, *(divided(slope, lag)[1] for slope in SLOPES[1:])]
        bend, tilt, _ = np.polyfit(SLOPES, losses, 2)
        slope = float(np.clip(-0.5 * tilt / bend, low, high)) if bend > 0 else 0.0
        followed, loss = divided(slope, lag)
        widening = float(np.max(followed.common.optimum.inflation))
        sag = Sag(slope, lag, widening / float(np.sqrt(2 * bend)) if bend > 0 else np.inf)
        if loss < least and slope > SURE * sag.std:
            best, least = (followed, sag), loss
    if best is None:
        return each_motor(fit, nominal), None
    return each_motor(best[0], nominal), best[1]


def _telling_voltages(records: Sequence[MotorRecord]) -> list[np.ndarray] | None:
    """The voltages of all records; None unless all records have one and it varies enough."""
    voltages = [v for r in records if (v := r.battery_voltage) is not None and np.isfinite(v).all()]
    tells = len(voltages) == len(records) and np.std(np.concatenate(voltages)) >= VARIES
    return voltages if tells else None


def _felt(record: MotorRecord, lag: float) -> np.ndarray:
    """Voltage (n,) through a first-order low-pass filter that starts at the first reading, V."""
    voltage = not_none(record.battery_voltage)
    felt = np.empty(len(record.time))
    felt[0] = voltage[0]
    kept = np.exp(-np.diff(record.time) / lag)
    for i, (now, share) in enumerate(zip(voltage[1:], kept, strict=True)):
        felt[i + 1] = now + (felt[i] - now) * share
    return felt
