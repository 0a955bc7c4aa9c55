"""Every effect by name. Adding one is one module and one line here."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.battery_sag import BatterySag
from cfb_mjx.model.effects.blade_flapping import BladeFlapping
from cfb_mjx.model.effects.cog_offset import CogOffset
from cfb_mjx.model.effects.command_delay import CommandDelay
from cfb_mjx.model.effects.esc_rate_limit import EscRateLimit
from cfb_mjx.model.effects.formula import ResidualFormula
from cfb_mjx.model.effects.ground_effect import GroundEffect
from cfb_mjx.model.effects.gust import Gust
from cfb_mjx.model.effects.gyroscopic import Gyroscopic
from cfb_mjx.model.effects.inertia import Inertia
from cfb_mjx.model.effects.inflow_thrust import InflowThrust
from cfb_mjx.model.effects.jet import Jet
from cfb_mjx.model.effects.motor_asymmetry import MotorAsymmetry
from cfb_mjx.model.effects.motor_gain_mismatch import MotorGainMismatch
from cfb_mjx.model.effects.motor_second_order import MotorSecondOrder
from cfb_mjx.model.effects.motor_thermal_drift import MotorThermalDrift
from cfb_mjx.model.effects.motor_time_constant import MotorTimeConstant
from cfb_mjx.model.effects.parasitic_drag import ParasiticDrag
from cfb_mjx.model.effects.payload import Payload
from cfb_mjx.model.effects.payload_swing import PayloadSwing
from cfb_mjx.model.effects.position_moment import PositionMoment
from cfb_mjx.model.effects.regression_dilution import RegressionDilution
from cfb_mjx.model.effects.rotor_drag import RotorDrag
from cfb_mjx.model.effects.thrust_scale import ThrustScale
from cfb_mjx.model.effects.thrust_tilt import ThrustTilt
from cfb_mjx.model.effects.torque_scale import TorqueScale
from cfb_mjx.model.effects.wind import Wind
from cfb_mjx.parameters.parameters import Parameters

CATALOGUE: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        ThrustScale,
        TorqueScale,
        Inertia,
        CogOffset,
        Payload,
        MotorGainMismatch,
        MotorTimeConstant,
        MotorAsymmetry,
        MotorSecondOrder,
        MotorThermalDrift,
        BatterySag,
        CommandDelay,
        EscRateLimit,
        InflowThrust,
        GroundEffect,
        Gyroscopic,
        ThrustTilt,
        RotorDrag,
        ParasiticDrag,
        BladeFlapping,
        Wind,
        Gust,
        Jet,
        PositionMoment,
        PayloadSwing,
    )
}


KNOWN: dict[str, type[Effect]] = CATALOGUE | {kind.name: kind for kind in (ResidualFormula, RegressionDilution)}
"""What a model file may name: the catalogue; formulas, which a search turns to only when it fails; and what predictors
do instead of physics."""


@dataclasses.dataclass(frozen=True)
class SensorFault:
    """One thing that can be wrong with a recording: its parameter in a model file, unit and value when healthy."""

    parameter: str
    unit: str
    healthy: float


SENSOR_FAULTS: dict[str, SensorFault] = {
    "sensor_delay": SensorFault("delay", "s", 0.0),
    "sensor_velocity_scale": SensorFault("scale", "1", 1.0),
    "sensor_gyro_lowpass": SensorFault("lag", "s", 0.0),
    "sensor_time_shift": SensorFault("shift", "s", 0.0),
}
"""What a model file may name beside physics: it changes what is recorded, not how the drone flies."""


def effect_from_mapping(item: Mapping[str, Any], where: str, parameters: Parameters | None = None) -> Effect:
    """Build an effect from ``{name, parameters}`` as written in a model YAML; what is left out is neutral.

    Args:
        item: the mapping.
        where: the file, for errors.
        parameters: of the same file, where there are any: fields of earlier versions may need them.

    Raises:
        CfbError: unknown effect, unknown parameter or a value that is not a number, named.
    """
    name = item.get("name")
    if not isinstance(name, str) or name not in KNOWN:
        raise CfbError(f"{where}: unknown effect {name!r}; known are {', '.join(sorted([*KNOWN, *SENSOR_FAULTS]))}.")
    kind = KNOWN[name]
    fields = {field.name for field in dataclasses.fields(kind)}
    values = item.get("parameters") or {}
    if not isinstance(values, Mapping):
        raise CfbError(f"{where}: effects.{name}.parameters must be a mapping, found {values!r}.")
    for key in item:
        if key not in ("name", "parameters", "source", "uncertainty", "p_value"):
            raise CfbError(f"{where}: unknown key 'effects.{name}.{key}'.")
    try:
        values = kind.migrated(values, parameters)
    except CfbError as error:
        raise CfbError(f"{where}: {error}") from None
    neutral = kind.neutral()
    arguments = {field: getattr(neutral, field) for field in fields}
    for key, raw in values.items():
        if key not in fields:
            raise CfbError(
                f"{where}: unknown key 'effects.{name}.parameters.{key}'; known are {', '.join(sorted(fields))}."
            )
        try:
            value = np.asarray(raw, dtype=np.float64)
        except (TypeError, ValueError):
            value = np.asarray(np.nan)
        shape = np.shape(arguments[key])
        if not np.all(np.isfinite(value)) or value.shape not in ((), shape):
            count = int(np.prod(shape))
            raise CfbError(f"{where}: effects.{name}.parameters.{key} = {raw!r} must be {count} finite number(s).")
        arguments[key] = value
    return kind(**arguments)


def effect_to_mapping(effect: Effect) -> dict[str, Any]:
    """The inverse of `effect_from_mapping`."""
    values = {field.name: np.asarray(getattr(effect, field.name)).tolist() for field in dataclasses.fields(effect)}
    return {"name": effect.name, "parameters": values, "source": effect.source}
