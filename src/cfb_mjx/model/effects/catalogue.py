"""All effects by name: those of the library, one line each, and those of users (`register`, `cfb_mjx.plugins`)."""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
from collections.abc import Iterator, Mapping
from hashlib import sha256
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx import plugins
from cfb_mjx.documents import told
from cfb_mjx.errors import CfbError
from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.battery_sag import BatterySag
from cfb_mjx.model.effects.blade_flapping import BladeFlapping
from cfb_mjx.model.effects.cog_offset import CogOffset
from cfb_mjx.model.effects.command_delay import CommandDelay
from cfb_mjx.model.effects.downwash import Downwash
from cfb_mjx.model.effects.esc_rate_limit import EscRateLimit
from cfb_mjx.model.effects.formula import ResidualFormula
from cfb_mjx.model.effects.ground_effect import GroundEffect
from cfb_mjx.model.effects.gust import Gust
from cfb_mjx.model.effects.gyroscopic import Gyroscopic
from cfb_mjx.model.effects.inertia import Inertia
from cfb_mjx.model.effects.inertia_products import InertiaProducts
from cfb_mjx.model.effects.inflow_thrust import InflowThrust
from cfb_mjx.model.effects.jet import Jet
from cfb_mjx.model.effects.motor_asymmetry import MotorAsymmetry
from cfb_mjx.model.effects.motor_gain_mismatch import MotorGainMismatch
from cfb_mjx.model.effects.motor_hysteresis import MotorHysteresis
from cfb_mjx.model.effects.motor_second_order import MotorSecondOrder
from cfb_mjx.model.effects.motor_thermal_drift import MotorThermalDrift
from cfb_mjx.model.effects.motor_time_constant import MotorTimeConstant
from cfb_mjx.model.effects.parasitic_drag import ParasiticDrag
from cfb_mjx.model.effects.payload import Payload
from cfb_mjx.model.effects.payload_swing import PayloadSwing
from cfb_mjx.model.effects.position_moment import PositionMoment
from cfb_mjx.model.effects.prop_damage import PropDamage
from cfb_mjx.model.effects.rate_damping import RateDamping
from cfb_mjx.model.effects.regression_dilution import RegressionDilution
from cfb_mjx.model.effects.rotor_drag import RotorDrag
from cfb_mjx.model.effects.thrust_scale import ThrustScale
from cfb_mjx.model.effects.thrust_tilt import ThrustTilt
from cfb_mjx.model.effects.torque_scale import TorqueScale
from cfb_mjx.model.effects.translational_lift import TranslationalLift
from cfb_mjx.model.effects.vortex_ring import VortexRing
from cfb_mjx.model.effects.wall_effect import WallEffect
from cfb_mjx.model.effects.wind import Wind
from cfb_mjx.parameters.parameters import Parameters

_PHYSICS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        ThrustScale,
        TorqueScale,
        PropDamage,
        Inertia,
        InertiaProducts,
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
        MotorHysteresis,
        InflowThrust,
        TranslationalLift,
        VortexRing,
        GroundEffect,
        WallEffect,
        Gyroscopic,
        ThrustTilt,
        RotorDrag,
        ParasiticDrag,
        BladeFlapping,
        Wind,
        Gust,
        Jet,
        Downwash,
        PositionMoment,
        RateDamping,
        PayloadSwing,
    )
}


_SHIPPED = _PHYSICS | {kind.name: kind for kind in (ResidualFormula, RegressionDilution)}
COMMAND_LEAD = "command_lead"
"""Name that the search gives to a nuisance parameter of logs; no effect may have it."""


class Kinds(Mapping[str, type[Effect]]):
    """All effects by name at the moment of the call: the library's first, then those added with `register`."""

    def __init__(self, shipped: Mapping[str, type[Effect]]):
        self._shipped = shipped

    def _all(self) -> dict[str, type[Effect]]:
        return {**self._shipped, **plugins.kinds(_take)}

    def __getitem__(self, name: str) -> type[Effect]:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())


CATALOGUE = Kinds(_PHYSICS)
KNOWN = Kinds(_SHIPPED)
"""Effects that a model file may name: the catalogue, formulas (which a search tries only after it has found no effect),
and the statistical correction of predictors."""


@dataclasses.dataclass(frozen=True)
class SensorFault:
    """A fault of a recording: its parameter in a model file, the unit and the value of a healthy sensor.

    ``meaning`` and ``experiment`` say what it is and which flights reveal it.
    """

    parameter: str
    unit: str
    healthy: float
    meaning: str
    experiment: str


SENSOR_FAULTS: dict[str, SensorFault] = {
    "sensor_delay": SensorFault(
        "delay",
        "s",
        0.0,
        "pose and velocity are older than the log declares",
        "fast turns in yaw and hard stops: delay shows where signals change quickly",
    ),
    "sensor_velocity_scale": SensorFault(
        "scale", "1", 1.0, "logged velocity is not in scale with logged position", "long straight passes"
    ),
    "sensor_gyro_lowpass": SensorFault(
        "lag", "s", 0.0, "the gyro is filtered and lags", "cfb excite roll-pitch: fast rates show a filter"
    ),
    "sensor_gyro_scale": SensorFault(
        "scale", "1", 1.0, "the gyro is not in scale with the turning of the pose", "cfb excite roll-pitch"
    ),
    "sensor_time_shift": SensorFault(
        "shift",
        "s",
        0.0,
        "command and rotor-speed columns are late or early against all others",
        "sharp command steps with rotor speed logged",
    ),
}
"""Faults that a model file may name beside effects: they change the recording, not the flight."""


def effect_from_mapping(item: Mapping[str, Any], where: str, parameters: Parameters | None = None) -> Effect:
    """Build an effect from ``{name, parameters}`` as in a model YAML; missing parameters are neutral.

    Args:
        item: the mapping.
        where: the file, for messages.
        parameters: parameters of the same file, needed to translate fields of some earlier versions.

    Raises:
        CfbError: an unknown effect or parameter, or a value that is not a number or outside its limits. The message
            names it and ``where``.

    Warns:
        CfbWarning: a value that is possible but unusual.
    """
    name = item.get("name")
    if not isinstance(name, str) or name not in KNOWN:
        known = ", ".join(sorted([*KNOWN, *SENSOR_FAULTS]))
        said = f"{where}: unknown effect {told(name)}; known are {known}"
        raise CfbError(f"{said}; load an effect of your own with --plugin FILE.py.")
    kind = KNOWN[name]
    fields = {field.name for field in dataclasses.fields(kind)}
    values = item.get("parameters") or {}
    if not isinstance(values, Mapping):
        raise CfbError(f"{where}: effects.{name}.parameters must be a mapping, found {told(values)}.")
    for key in item:
        if key not in ("name", "parameters", "source", "uncertainty", "spread", "p_value"):
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
        shape = np.shape(arguments[key])
        value = _numbers(raw, shape)
        if value is None or not np.all(np.isfinite(value)):
            count = int(np.prod(shape))
            raise CfbError(f"{where}: effects.{name}.parameters.{key} = {told(raw)} must be {count} finite number(s).")
        if key in kind.limits:
            kind.limits[key].check(value, f"{where}: effects.{name}.parameters.{key}", kind.units[key], warn=True)
        arguments[key] = value
    for what in ("uncertainty", "spread"):
        _check_widths(item, what, neutral, where)
    return kind(**arguments)


def _numbers(raw: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """The value of a field, one number or ``shape`` numbers (null becomes NaN); None if it is neither."""
    try:
        value = np.asarray(raw, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return value if value.shape in ((), shape) else None


def _check_widths(item: Mapping[str, Any], what: str, neutral: Effect, where: str) -> None:
    """Refuse standard deviations that do not fit the fields of an effect. null means unknown.

    An ``uncertainty`` may belong to a field of an earlier version, because nothing is drawn from it.
    """
    widths, at = item.get(what), f"effects.{neutral.name}.{what}"
    if widths is None:
        return
    if not isinstance(widths, Mapping):
        raise CfbError(f"{where}: {at} must be a mapping, found {told(widths)}.")
    known = {field.name for field in dataclasses.fields(neutral)}
    if what == "spread" and (unknown := sorted(map(str, set(widths) - known))):
        raise CfbError(f"{where}: unknown key '{at}.{unknown[0]}'; known are {', '.join(sorted(known))}.")
    for field in known & set(widths):
        shape = np.shape(getattr(neutral, field))
        value = _numbers(widths[field], shape)
        if value is None or np.any(value < 0) or np.any(np.isinf(value)):
            count = int(np.prod(shape))
            raise CfbError(
                f"{where}: {at}.{field} = {told(widths[field])} must be {count} finite number(s), zero or positive."
            )


def effect_to_mapping(effect: Effect) -> dict[str, Any]:
    """Write an effect as ``{name, parameters, source}``; the inverse of `effect_from_mapping`."""
    values = {field.name: np.asarray(getattr(effect, field.name)).tolist() for field in dataclasses.fields(effect)}
    return {"name": effect.name, "parameters": values, "source": effect.source}


def register(kind: Any) -> Any:
    """Register an effect of your own for model files, fits, the search, reports and training. Also a decorator.

    It stays registered until the process ends, or until the surrounding block of `cfb_mjx.plugins.plugged` ends. A
    class that is defined again, as in a notebook cell that runs twice, replaces itself.

    Args:
        kind: the class, derived from `Effect`.

    Returns:
        The class.

    Raises:
        CfbError: the class is incomplete, or its name is taken.
    """
    if not (isinstance(kind, type) and issubclass(kind, Effect)):
        raise CfbError(f"{kind!r} is not an effect; register a class derived from cfb_mjx.model.Effect.")
    if (complaint := _complaint(kind)) is not None:
        raise CfbError(f"effect {kind.__qualname__}: {complaint}.")
    plugins.add(kind.name, kind)
    return kind


def written(name: str) -> str:
    """Hash of the source that defines an effect; a run that was begun with another source must not be resumed."""
    kind = KNOWN[name]
    try:
        text = inspect.getsource(sys.modules[kind.__module__])
    except (OSError, TypeError, KeyError):  # defined in an interactive shell
        text = kind.__qualname__
    return sha256(text.encode()).hexdigest()


def outside(name: str) -> bool:
    """Whether an effect is not part of the library."""
    return name not in _SHIPPED


def _take(found: object) -> None:
    """Register the effect of an entry point, or all effects of a module."""
    if not isinstance(found, ModuleType):
        register(found)
        return
    shipped = {Effect, *_SHIPPED.values()}
    kinds = [v for v in vars(found).values() if isinstance(v, type) and issubclass(v, Effect) and v not in shipped]
    # Base classes that others derive from are not effects themselves.
    kinds = [kind for kind in kinds if "name" in vars(kind) or not kind.__subclasses__()]
    if not kinds:
        raise CfbError("defines no effect (a class derived from cfb_mjx.model.Effect).")
    for kind in kinds:
        register(kind)


def _complaint(kind: type[Effect]) -> str | None:
    """What is missing or wrong in a user's effect; None if nothing is."""
    name = getattr(kind, "name", None)
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        return f"'name' must consist of lower-case letters, digits and underscores, found {name!r}"
    shipped = {key: each.__name__ for key, each in _SHIPPED.items()} | {COMMAND_LEAD: "the search"}
    if (owner := (shipped | dict.fromkeys(SENSOR_FAULTS, "a sensor fault")).get(name)) is not None:
        return f"{owner} has the name {name!r} already"
    fields = [item.name for item in dataclasses.fields(kind)]
    for attribute in ("units", "prior"):
        given = getattr(kind, attribute, None)
        if not isinstance(given, Mapping) or set(given) != set(fields):
            return f"'{attribute}' must have an entry for each field ({', '.join(fields)}), found {given!r}"
    for field, span in kind.prior.items():
        if not (np.shape(span) == (2,) and np.all(np.isfinite(span)) and span[0] < span[1]):
            return f"'prior' of {field} must be two numbers, low and high, found {span!r}"
    strengths = getattr(kind, "strengths", None)
    if not isinstance(strengths, tuple) or not strengths or not set(strengths) <= set(fields):
        return f"'strengths' must be a tuple of the fields that are zero at neutral, found {strengths!r}"
    shape = set(fields) - set(strengths)
    if not kind.probes or not all(isinstance(p, Mapping) and set(p) <= shape for p in kind.probes):
        return f"'probes' must be a tuple of mappings that set fields other than strengths, found {kind.probes!r}"
    if not set(kind.coarse) <= set(range(len(kind.probes))):
        return f"the keys of 'coarse' must be indices of probes, from 0, found {kind.coarse!r}"
    return _complaint_about_neutral(kind)


def _complaint_about_neutral(kind: type[Effect]) -> str | None:
    functions = {name for name in vars(Effect) if name[0] != "_" and inspect.isfunction(getattr(Effect, name))}
    changing = sorted(functions - {"start", "sense", "advance", "follow"})
    if not any(getattr(kind, hook) is not getattr(Effect, hook) for hook in changing):
        return f"it changes nothing; override one of {', '.join(changing)}"
    if kind.neutral.__func__ is Effect.neutral.__func__:
        return "'neutral' is missing: a classmethod that returns the effect at the values where it vanishes"
    neutral = kind.neutral()
    if type(neutral) is not kind:
        return f"'neutral' must return a {kind.__name__}, found {neutral!r}"
    for field in kind.prior:
        value, (low, high) = getattr(neutral, field), kind.prior[field]
        if not isinstance(value, jax.Array) or not jnp.issubdtype(value.dtype, jnp.floating) or value.ndim > 1:
            return (
                f"field {field} must be an array of one number or a row of them, as the converters 'number' and "
                f"'vector' of cfb_mjx.model.effects.fields make it, found {value!r}"
            )
        if field in kind.strengths and (np.any(np.asarray(value) != 0) or not low <= 0 <= high):
            return f"strength {field} must be zero at neutral, and its prior contain 0, found {value}, {low} to {high}"
    return None
