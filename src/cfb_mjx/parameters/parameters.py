"""The parameter pytree of the 17-state model (paper eqs. 1-10), and what each constant must satisfy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError


def _array(value) -> Array:
    return jnp.asarray(value, dtype=jnp.result_type(float))


class Parameters(eqx.Module):
    """Constants of one Crazyflie Brushless. Immutable; every field is a JAX array, so it can be batched and fitted.

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
    """Steady rotor speed at zero command of an affine motor map, rad/s. Zero in the paper."""
    reference_rotor_speed: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Rotor speed that makes s = Omega / sigma dimensionless in both polynomials [sigma], rad/s."""
    thrust_polynomial: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Coefficients of s^3, s^2, s in the thrust of one rotor [eq. 8], N."""
    torque_polynomial: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Coefficients of s^3, s^2, s in the aerodynamic torque of one rotor [eq. 9], N m."""
    thrust_scale: Float[Array, "*batch 4"] = eqx.field(converter=_array)
    """Factor on each rotor's thrust. One in the paper."""
    torque_scale: Float[Array, "*batch 4"] = eqx.field(converter=_array)
    """Factor on each rotor's aerodynamic torque. One in the paper."""
    pose_delay: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Age of the estimated pose and velocity when the controller reads them, s. Formerly ``observation_delay``."""
    attitude_offset: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Rotation vector from the true body axes to the axes the estimator reports, rad."""
    gyro_delay: Float[Array, "*batch"] = eqx.field(converter=_array)
    """Age of the gyro's reading when the controller reads it, s. The gyro is on the drone: a real one's filters make
    about 2 ms."""

    @property
    def observation_delay(self) -> Float[Array, "*batch"]:
        """Former name of ``pose_delay``."""
        return self.pose_delay


@dataclass(frozen=True)
class Specification:
    """Unit, shape (without batch axes) and the condition a parameter must meet."""

    unit: str
    shape: tuple[int, ...]
    meaning: str
    condition: str
    holds: Callable[[np.ndarray], bool]


def _positive(x: np.ndarray) -> bool:
    return bool(np.all(x > 0))


def _not_negative(x: np.ndarray) -> bool:
    return bool(np.all(x >= 0))


def _any(x: np.ndarray) -> bool:
    return True


def _physical_inertia(x: np.ndarray) -> bool:
    # Equality is a flat plate: still a body, so it is allowed.
    return bool(np.all(x > 0) and 2 * x.max() <= x.sum() * (1 + 1e-9))


SPECIFICATIONS: dict[str, Specification] = {
    "mass": Specification("kg", (), "take-off mass", "positive", _positive),
    "inertia": Specification(
        "kg m^2",
        (3,),
        "principal moments of inertia",
        "positive and obey the triangle inequality (no moment larger than the sum of the other two)",
        _physical_inertia,
    ),
    "center_of_gravity": Specification("m", (3,), "centre of gravity from the rotors' centre", "finite", _any),
    "gravity": Specification("m/s^2", (), "gravitational acceleration", "zero or positive", _not_negative),
    "rotor_spacing": Specification("m", (), "distance between neighbouring rotors", "positive", _positive),
    "rotor_inertia": Specification("kg m^2", (), "inertia of one rotor", "zero or positive", _not_negative),
    "motor_time_constant": Specification("s", (4,), "motor lag", "positive", _positive),
    "motor_gain": Specification("rad/s", (4,), "steady rotor speed per unit command", "positive", _positive),
    "motor_speed_offset": Specification("rad/s", (4,), "steady rotor speed at zero command", "finite", _any),
    "reference_rotor_speed": Specification("rad/s", (), "rotor speed where s = 1", "positive", _positive),
    "thrust_polynomial": Specification(
        "N", (3,), "thrust cubic", "give positive thrust at s = 1", lambda x: bool(np.all(x.sum(-1) > 0))
    ),
    "torque_polynomial": Specification(
        "N m", (3,), "torque cubic", "give zero or positive torque at s = 1", lambda x: bool(np.all(x.sum(-1) >= 0))
    ),
    "thrust_scale": Specification("1", (4,), "factor on thrust", "zero or positive", _not_negative),
    "torque_scale": Specification("1", (4,), "factor on aerodynamic torque", "zero or positive", _not_negative),
    "pose_delay": Specification("s", (), "age of pose and velocity", "zero or positive", _not_negative),
    "attitude_offset": Specification("rad", (3,), "attitude error of the estimator", "finite", _any),
    # Last: a parameter's place decides its random draws.
    "gyro_delay": Specification("s", (), "age of the gyro's reading", "zero or positive", _not_negative),
}

DEFAULTS: dict[str, float] = {
    "center_of_gravity": 0.0,
    "gravity": 9.81,
    "motor_speed_offset": 0.0,
    "thrust_scale": 1.0,
    "torque_scale": 1.0,
    "attitude_offset": 0.0,
    "gyro_delay": 0.0,
}
"""Neutral values of what a parameter file may leave out."""

FORMER_NAMES = {"observation_delay": "pose_delay"}
"""Names that files and commands may still use."""


def current_names(values: Mapping[str, Any], where: str | Path, prefix: str = "") -> dict[str, Any]:
    """The same values under the names of today.

    Raises:
        CfbError: one is given under both of its names.
    """
    for former, now in FORMER_NAMES.items():
        if former in values and now in values:
            raise CfbError(f"{where}: {prefix}{former} and {prefix}{now} are one thing; give {prefix}{now} alone.")
    return {FORMER_NAMES.get(name, name): value for name, value in values.items()}
