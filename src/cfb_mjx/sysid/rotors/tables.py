"""Thrust and torque curves from tables of bench points, and the check that a table is of one rotor of the drone.

Motor gain and offset come from steady points: ``omega = a + b u V``, or ``a + b u`` without a voltage.

A brushless motor controller applies the battery voltage for the share u of the time, so the speed is proportional to
u V. On a bench where the battery voltage drops by a volt, the residual is 10 rad/s; with a line in u alone it is 46.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.bench_tables import MapTable, SteadyPoints
from cfb_mjx.model.effects.battery_sag import NOMINAL_VOLTAGE
from cfb_mjx.model.effects.fields import HOVER_SPEED
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


_FEWEST, _LEVELS = 6, 3
VARIES = 0.05  # V; smallest standard deviation of the voltage at which its effect can be determined
_OUTLIER = 5.0  # spreads


@dataclass(frozen=True)
class SteadyFit:
    """Gain and offset of the motors.

    Attributes:
        gain: increase of the speed per unit command, rad/s; at 3.7 V if the voltage is used.
        gain_std: its standard deviation.
        offset: speed of the line at zero command, rad/s.
        offset_std: its standard deviation.
        per_volt: gain per volt, rad/s; None if the voltage was not measured, did not vary or explains nothing.
        spread: rms distance of the points from the line, rad/s.
        spread_without_voltage: the same for a line in the command alone.
        outliers: share of points more than five spreads from the line, which are left out.
        points: number of points.
    """

    gain: float
    gain_std: float
    offset: float
    offset_std: float
    per_volt: float | None
    spread: float
    spread_without_voltage: float
    outliers: float
    points: int

    @property
    def sag_slope(self) -> float | None:
        """Relative change of speed per relative change of voltage in hover: the slope of `battery_sag`."""
        return None if self.per_volt is None else 1.0 - self.offset / HOVER_SPEED

    def to_json(self) -> dict:
        """Results other than gain and offset as a JSON-compatible dictionary."""
        return {
            "gain_per_volt": self.per_volt,
            "battery_sag_slope": self.sag_slope,
            "spread_radps": self.spread,
            "spread_without_voltage_radps": self.spread_without_voltage,
            "share_of_outliers": self.outliers,
            "points": self.points,
        }


def fit_steady(tables: list[SteadyPoints]) -> SteadyFit:
    """Fit one line through all points of all motors.

    Args:
        tables: steady points.

    Raises:
        CfbError: too few points or too few different commands.
    """
    label = ", ".join(t.name for t in tables)
    u, omega = (np.concatenate([getattr(t, f) for t in tables]) for f in ("command", "rotor_speed"))
    levels = len(np.unique(np.round(u, 2)))
    if len(u) < _FEWEST or levels < _LEVELS:
        raise CfbError(
            f"{label}: {len(u)} steady points at {levels} different commands; a line needs {_FEWEST} at {_LEVELS}."
        )
    voltages = [t.battery_voltage for t in tables if t.battery_voltage is not None]
    voltage = np.concatenate(voltages) if len(voltages) == len(tables) else None
    plain = _line(u, omega, u)
    scaled = None if voltage is None or np.std(voltage) < VARIES else _line(u * voltage, omega, u)
    if scaled is None or scaled[2] > plain[2]:  # a controller that keeps the speed does not follow the voltage
        (offset, slope), std, spread, outliers = plain
        return SteadyFit(slope, std[1], offset, std[0], None, spread, spread, outliers, len(u))
    (offset, slope), std, spread, outliers = scaled
    return SteadyFit(
        slope * NOMINAL_VOLTAGE,
        std[1] * NOMINAL_VOLTAGE,
        offset,
        std[0],
        slope,
        spread,
        plain[2],
        outliers,
        len(u),
    )


def _line(x: np.ndarray, y: np.ndarray, setting: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Robust line fit: offset and slope, their standard deviations, spread of the points, share of outliers.

    Speed sensors that count a blade twice or miss one read double or half for whole settings. So the fit starts from
    least absolute residuals and then leaves out distant points. Errors of points of one ``setting`` are correlated.
    """
    from scipy.optimize import least_squares

    design = np.stack([np.ones_like(x), x], axis=1)
    size = np.array([1000.0, 1000.0 / max(float(np.abs(x).max()), 1e-9)])
    start = np.linalg.lstsq(design, y, rcond=None)[0]
    slopes = cast(Any, lambda t: design)
    theta = least_squares(lambda t: design @ t - y, start, jac=slopes, loss="soft_l1", f_scale=1.0, x_scale=size).x
    good = np.ones(len(y), dtype=bool)
    for _ in range(20):
        residual = y - design @ theta
        spread = 1.4826 * float(np.median(np.abs(residual[good] - np.median(residual[good])))) + 1e-9
        now = np.abs(residual) <= _OUTLIER * spread
        theta = np.linalg.lstsq(design[now], y[now], rcond=None)[0]
        if (now == good).all():
            break
        good = now
    residual = (y - design @ theta)[good]
    inverse = np.linalg.inv(design[good].T @ design[good])
    _, group = np.unique(np.round(setting[good], 4), return_inverse=True)
    scores = np.zeros((group.max() + 1, 2))
    np.add.at(scores, group, design[good] * residual[:, None])
    covariance = inverse @ (scores.T @ scores) @ inverse
    spread = float(np.sqrt(np.mean(residual**2)))
    return theta, np.sqrt(np.diag(covariance)), spread, float(1 - good.mean())
