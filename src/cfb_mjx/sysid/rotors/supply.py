"""Motors on a bench whose supply sags: do they follow the command, or the command times the voltage?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cfb_mjx.logs.bench_tables import MotorRecord
from cfb_mjx.model.effects.battery_sag import NOMINAL_VOLTAGE
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.rotors.motors import MotorFit, fit_motors
from cfb_mjx.sysid.rotors.steady import VARIES


def fit_under_supply(records: Sequence[MotorRecord], nominal: Parameters, **options) -> tuple[MotorFit, list[str]]:
    """Motors from commands, or from commands times voltage where all records have one that changes and it is likelier.

    Args:
        records: as for `fit_motors`.
        nominal: as for `fit_motors`.
        **options: as for `fit_motors`.

    Returns:
        The fit, whose gain is that at 3.7 V where the voltage counts, and what was decided, in words.

    Raises:
        CfbError: as `fit_motors`.
    """
    plain = fit_motors(records, nominal, **options)
    voltages = [r.battery_voltage for r in records]
    if any(v is None or not np.isfinite(v).all() for v in voltages) or np.std(np.concatenate(voltages)) < VARIES:
        return plain, []
    scaled = [replace(r, command=r.command * r.battery_voltage[:, None] / NOMINAL_VOLTAGE) for r in records]
    followed = fit_motors(scaled, nominal, **options)
    gained = plain.common.optimum.loss - followed.common.optimum.loss
    if gained <= 0:
        return plain, ["speed does not follow the voltage of the supply: the command alone explains it better."]
    said = (
        f"speed follows command times voltage (log-likelihood +{gained:.0f} over the command alone): the gain is that "
        f"at {NOMINAL_VOLTAGE} V; the effect battery_sag makes a model follow the voltage."
    )
    return followed, [said]
