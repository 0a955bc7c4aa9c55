"""The parameter pytree of the 17-state model (paper eqs. 1-10), and the unit, shape and limits of each parameter.

The limits are declared once, beside the units: impossible values are refused, unusual ones give a warning.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError, CfbWarning

_SLACK = 1e-6
"""Relative amount by which a number may exceed a limit: the rounding of single precision."""
_OTHERS = {
    "kg": (("g", 1e-3),),
    "m": (("mm", 1e-3), ("cm", 1e-2)),
    "s": (("ms", 1e-3),),
    "rad": (("deg", math.pi / 180),),
    "rad/s": (("rpm", math.pi / 30),),
    "kg m^2": (("g cm^2", 1e-7), ("g m^2", 1e-3)),
}
"""Other units in which numbers are often given, with factors, by unit."""


@dataclass(frozen=True)
class Limits:
    """Limits of one number, in its unit; all ends belong to the ranges.

    Values outside ``hard_low`` to ``hard_high`` are impossible and refused. Values outside ``soft_low`` to
    ``soft_high`` are unusual and give a warning.
    """

    hard_low: float
    hard_high: float
    soft_low: float
    soft_high: float

    def __post_init__(self):
        if not self.hard_low <= self.soft_low <= self.soft_high <= self.hard_high:
            raise ValueError(f"{self}: soft limits must lie between hard ones")

    def holds(self, value):
        """Whether each number is within the hard limits; NaN is not. For NumPy and JAX, also traced."""
        return (value >= _down(self.hard_low)) & (value <= _up(self.hard_high))

    def usual(self, value):
        """Whether each number is within the soft limits."""
        return (value >= _down(self.soft_low)) & (value <= _up(self.soft_high))

    def check(self, value: Any, name: str, unit: str, warn: bool = False) -> None:
        """Refuse impossible values. Traced numbers are not checked.

        Args:
            value: number or array.
            name: its name in messages, for example "FILE: parameters.mass".
            unit: its unit.
            warn: whether unusual values give a warning.

        Raises:
            CfbError: a number outside the hard limits.
        """
        numbers = concrete(value)
        if numbers is None:
            return
        impossible = np.asarray(~self.holds(numbers))
        if impossible.any():
            said, number = _first(name, numbers, impossible)
            span = _span(self.hard_low, self.hard_high, unit)
            raise CfbError(f"{said} must lie between {span}{self._hint(number, unit)}.")
        unusual = np.asarray(~self.usual(numbers))
        if warn and unusual.any():
            said, number = _first(name, numbers, unusual)
            span = _span(self.soft_low, self.soft_high, unit)
            text = f"{said} is unusual; usually it lies between {span}{self._hint(number, unit)}."
            warnings.warn(text, CfbWarning, stacklevel=3)

    def _hint(self, number: float, unit: str) -> str:
        for other, factor in _OTHERS.get(unit, ()):
            if self.usual(number * factor):
                return f": in {unit}, {number:g} {other} is {number * factor:.6g}"
        return ""


def concrete(value: Any) -> np.ndarray | None:
    """Numbers of an array in float64; None if they are traced, or not all in this process."""
    if isinstance(value, Tracer) or (isinstance(value, jax.Array) and not value.is_fully_addressable):
        return None
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return None


def _down(limit: float) -> float:
    return limit - _SLACK * abs(limit)


def _up(limit: float) -> float:
    return limit + _SLACK * abs(limit)


def _first(name: str, numbers: np.ndarray, chosen: np.ndarray) -> tuple[str, float]:
    """Text "name[index] = number" of the first chosen number, and the number."""
    index = tuple(map(int, np.argwhere(chosen)[0]))
    number = float(numbers[index])
    return f"{name}{''.join(f'[{i}]' for i in index)} = {number:g}", number


def _span(low: float, high: float, unit: str) -> str:
    return f"{low:g} and {high:g}" + ("" if unit == "1" else f" {unit}")


def _array(value) -> Array:
    return jnp.asarray(value, dtype=jnp.result_type(float))


class Parameters(eqx.Module):
    """Constants of one Crazyflie Brushless. Immutable; every field is a JAX array and can be batched and fitted.

    Symbols in brackets are the paper's. Motors are in firmware order M1..M4 (front-right, back-right, back-left,
    front-left).
    """

    mass: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Take-off mass [m], kg."""
    inertia: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Principal moments of inertia about the centre of gravity [J], body x, y, z, kg m^2."""
    center_of_gravity: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Centre of gravity relative to the centre of the rotors, body axes, m."""
    gravity: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Gravitational acceleration along world -z [g], m/s^2."""
    rotor_spacing: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Distance between neighbouring rotor axes [l], m; rotors sit at +-l/2 in x and y."""
    rotor_inertia: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Moment of inertia of one rotor with its bell about its axis [J_m], kg m^2."""
    motor_time_constant: Float[Array, "*batch 4"] = eqx.field(converter=_array)
    """First-order lag of each motor [T, eq. 5], s."""
    motor_gain: Float[Array, "*batch 4"] = eqx.field(converter=_array)
    """Steady rotor speed per unit command [K, eq. 5], rad/s."""
    motor_speed_offset: Float[Array, "*batch 4"] = eqx.field(converter=_array)
    """Steady rotor speed at zero command, for an affine motor map, rad/s. Zero in the paper."""
    reference_rotor_speed: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Rotor speed sigma that makes s = Omega / sigma dimensionless in both polynomials, rad/s."""
    thrust_polynomial: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Coefficients of s^3, s^2, s of the thrust of one rotor [eq. 8], N."""
    torque_polynomial: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Coefficients of s^3, s^2, s of the aerodynamic torque of one rotor [eq. 9], N m."""
    thrust_scale: Float[Array, "*batch 4"] = eqx.field(converter=_array)
    """Factor on each rotor's thrust. One in the paper."""
    torque_scale: Float[Array, "*batch 4"] = eqx.field(converter=_array)
    """Factor on each rotor's aerodynamic torque. One in the paper."""
    pose_delay: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Age of the estimated pose and velocity when the controller reads them, s. Formerly ``observation_delay``."""
    attitude_offset: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Rotation vector from the true body axes to the axes the estimator reports, rad."""
    gyro_delay: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Age of the gyro's reading when the controller reads it, s. The gyro is on the drone; the filters of a real one
    cause about 2 ms."""

    @property
    def observation_delay(self) -> Float[Array, "*batch"]:
        """Former name of ``pose_delay``."""
        return self.pose_delay

    def __check_init__(self):
        for name, specification in SPECIFICATIONS.items():
            specification.check(getattr(self, name), f"parameters.{name}")

    def require_arrays(self, batched: bool = True) -> None:
        """Refuse what ``eqx.tree_at`` allows: a Python number in place of an array, or an array of another shape.

        Args:
            batched: whether batch axes may come first.

        Raises:
            CfbError: a field is not an array, or has another shape.
        """
        for name, specification in SPECIFICATIONS.items():
            value, shape = getattr(self, name), specification.shape
            if not hasattr(value, "shape") or not hasattr(value, "dtype"):
                raise CfbError(
                    f"parameters.{name} = {value!r} is a {type(value).__name__}, not an array of shape {shape}; "
                    "put jnp.asarray(...) there."
                )
            axes = value.ndim - len(shape)
            if axes < 0 or value.shape[axes:] != shape:
                raise CfbError(f"parameters.{name} has shape {value.shape}; it must be {shape}, after any batch axes.")
            if axes and not batched:
                raise CfbError(f"parameters.{name} has shape {value.shape}, not {shape}; use jax.vmap for many drones.")


@dataclass(frozen=True)
class Specification:
    """Unit, shape (without batch axes), limits of every component, and a condition on all components together."""

    unit: str
    shape: tuple[int, ...]
    meaning: str
    limits: Limits
    condition: str = ""
    """Description of the condition ``together``, to follow "must"."""
    together: Callable[[Any], Any] | None = None
    """Whether components (last axis, NumPy or JAX) are possible together."""

    def check(self, value: Any, name: str, warn: bool = False, together: bool = True) -> None:
        """Refuse impossible values. Traced numbers are not checked.

        Args:
            value: number or array, batch axes first.
            name: its name in messages.
            warn: whether unusual values give a warning.
            together: whether to check the condition on all components together.

        Raises:
            CfbError: a value is impossible.
        """
        self.limits.check(value, name, self.unit, warn)
        numbers = concrete(value)
        if together and self.together is not None and numbers is not None and not np.all(self.together(numbers)):
            raise CfbError(f"{name} = {numbers.tolist()} must {self.condition}.")


def physical_inertia(x: Any) -> Any:
    """Whether principal moments of inertia (last axis) are possible for a rigid body; those of a flat plate are."""
    # The tolerance is the rounding of single precision.
    return 2 * x.max(-1) <= x.sum(-1) * (1 + 1e-6)


SPECIFICATIONS: dict[str, Specification] = {
    "mass": Specification("kg", (), "take-off mass", Limits(1e-3, 10.0, 0.015, 0.2)),
    "inertia": Specification(
        "kg m^2",
        (3,),
        "principal moments of inertia",
        Limits(1e-8, 1.0, 2e-6, 1e-3),
        "obey the triangle inequality (no moment larger than the sum of the other two)",
        physical_inertia,
    ),
    "center_of_gravity": Specification(
        "m", (3,), "centre of gravity from the rotors' centre", Limits(-0.1, 0.1, -0.03, 0.03)
    ),
    "gravity": Specification("m/s^2", (), "gravitational acceleration", Limits(0.0, 100.0, 1.0, 25.0)),
    "rotor_spacing": Specification("m", (), "distance between neighbouring rotors", Limits(0.005, 2.0, 0.03, 0.25)),
    "rotor_inertia": Specification("kg m^2", (), "inertia of one rotor", Limits(0.0, 1e-4, 0.0, 1e-6)),
    "motor_time_constant": Specification("s", (4,), "motor lag", Limits(1e-5, 5.0, 1e-3, 0.3)),
    # At 20000 rad/s the tips of 3 cm blades would move at 600 m/s: larger numbers are in rpm.
    "motor_gain": Specification("rad/s", (4,), "steady rotor speed per unit command", Limits(1.0, 2e4, 500.0, 6000.0)),
    "motor_speed_offset": Specification(
        "rad/s", (4,), "steady rotor speed at zero command", Limits(-2e4, 2e4, -1000.0, 1000.0)
    ),
    "reference_rotor_speed": Specification("rad/s", (), "rotor speed where s = 1", Limits(1e-3, 1e6, 1.0, 2e4)),
    "thrust_polynomial": Specification(
        "N",
        (3,),
        "thrust cubic",
        Limits(-100.0, 100.0, -5.0, 5.0),
        "give positive thrust at s = 1",
        lambda x: x.sum(-1) > 0,
    ),
    "torque_polynomial": Specification(
        "N m",
        (3,),
        "torque cubic",
        Limits(-10.0, 10.0, -0.1, 0.1),
        "give zero or positive torque at s = 1",
        lambda x: x.sum(-1) >= 0,
    ),
    "thrust_scale": Specification("1", (4,), "factor on thrust", Limits(0.0, 10.0, 0.3, 2.0)),
    "torque_scale": Specification("1", (4,), "factor on aerodynamic torque", Limits(0.0, 10.0, 0.2, 4.0)),
    "pose_delay": Specification("s", (), "age of pose and velocity", Limits(0.0, 1.0, 0.0, 0.1)),
    "attitude_offset": Specification("rad", (3,), "attitude error of the estimator", Limits(-3.15, 3.15, -0.3, 0.3)),
    # Keep it last: the position of a parameter determines its random draws.
    "gyro_delay": Specification("s", (), "age of the gyro's reading", Limits(0.0, 1.0, 0.0, 0.05)),
}
"""Specifications of all parameters, used for files, ``--set``, randomisation, fits and constructors."""

DEFAULTS: dict[str, float] = {
    "center_of_gravity": 0.0,
    "gravity": 9.81,
    "motor_speed_offset": 0.0,
    "thrust_scale": 1.0,
    "torque_scale": 1.0,
    "attitude_offset": 0.0,
    "gyro_delay": 0.0,
}
"""Neutral values of parameters that a file may omit."""

FORMER_NAMES = {"observation_delay": "pose_delay"}
"""Former names of parameters, still accepted in files and commands."""


def current_names(values: Mapping[Any, Any], where: str | Path, prefix: str = "") -> dict[Any, Any]:
    """Replace former names by present ones.

    Args:
        values: values by name.
        where: file, for messages.
        prefix: path of the names within the file, for messages.

    Raises:
        CfbError: a value is given under both names.
    """
    for former, now in FORMER_NAMES.items():
        if former in values and now in values:
            raise CfbError(f"{where}: {prefix}{former} and {prefix}{now} are the same; give only {prefix}{now}.")
    return {FORMER_NAMES.get(name, name): value for name, value in values.items()}
