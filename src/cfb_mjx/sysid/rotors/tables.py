"""Thrust and torque curves from tables of bench points, and the check that a table is of one rotor of the drone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.bench_tables import MapTable
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import ModelFile, load_model_file, preset_names
from cfb_mjx.sysid.rotors.rotor_maps import MapFit, fit_map, powers

_COLUMN = {"thrust": "force", "torque": "torque"}
_FOUR_LEAST = 2.5


def require_one_rotor(tables: Sequence[MapTable], base: ModelFile) -> None:
    """Refuse tables whose thrust is clearly that of four rotors, a quarter of one rotor's, or another drone's.

    The propellers that fit this drone do not differ by such factors.

    Args:
        tables: bench points.
        base: the model to compare with.

    Raises:
        CfbError: the thrust is not that of one rotor; the message names the option to give.
    """
    for table in tables:
        ratio = _pull(table, base)
        if ratio is None:
            continue
        top = int(np.argmax(table.rotor_speed))
        point = f"{not_none(table.force)[top]:.3g} N at {table.rotor_speed[top]:.0f} rad/s"
        if ratio > _FOUR_LEAST:
            raise CfbError(
                f"{table.name}: {point} is {ratio:.1f} times what one rotor of {base.name} pulls, so it is the thrust "
                "of four; give --rotors 4."
            )
        asked = preset_names() if ratio < 1 / _FOUR_LEAST else ()
        others = {name: pull for name in asked if (pull := _pull(table, load_model_file(name)))}
        like = min(others, key=lambda n: abs(np.log(others[n])), default=None)
        if like is not None and 1 / _FOUR_LEAST < others[like] < _FOUR_LEAST:
            raise CfbError(
                f"{table.name}: {point} is {ratio:.2f} of what a rotor of {base.name} pulls and {others[like]:.2f} of "
                f"one of {like}; give --model {like}, or --rotors 1 if the thrust of one had been divided by four."
            )
        if ratio < 1 / _FOUR_LEAST:
            raise CfbError(
                f"{table.name}: {point} is {ratio:.2f} of what a rotor of {base.name} pulls, as if the thrust of one "
                "had been divided by four; give --rotors 1, or correct its unit."
            )


def fit_maps(
    tables: Sequence[MapTable], sigma: float, per_motor: bool = False, robust: bool = False, tared: bool = False
) -> dict[str, MapFit]:
    """Fit curves of ``thrust`` and ``torque`` to all tables that have these columns.

    Args:
        tables: bench points.
        sigma: reference rotor speed, rad/s.
        per_motor: as for `fit_map`.
        robust: as for `fit_map`.
        tared: as for `fit_map`.

    Returns:
        The fits under ``thrust`` and ``torque``.

    Raises:
        CfbError: as `fit_map`; ``per_motor`` with points whose motor is not stated.
    """
    found = {}
    for name, column in _COLUMN.items():
        used = [t for t in tables if getattr(t, column) is not None]
        if not used:
            continue
        motor = np.concatenate([t.motor for t in used])
        label = ", ".join(t.name for t in used)
        if per_motor and (motor == 0).any():
            raise CfbError(f"{label}: does not say which motor each point is of; add a column motor (1 to 4).")
        found[name] = fit_map(
            np.concatenate([t.rotor_speed for t in used]),
            np.concatenate([getattr(t, column) for t in used]),
            motor,
            robust=robust,
            per_motor=per_motor,
            sigma=sigma,
            name=f"{label} ({name})",
            tared=tared,
        )
    return found


def _pull(table: MapTable, model: ModelFile) -> float | None:
    """Median ratio of the measured thrust at high speeds to a model's thrust; None if it cannot be computed."""
    if table.force is None:
        return None
    sigma = float(model.entries["reference_rotor_speed"].value)
    curve = np.asarray(model.entries["thrust_polynomial"].value, float) * np.mean(model.entries["thrust_scale"].value)
    usual = powers(table.rotor_speed, sigma) @ curve
    fast = (table.rotor_speed > 0.6 * float(table.rotor_speed.max())) & (usual > 0)
    return float(np.median(table.force[fast] / usual[fast])) if fast.any() else None
