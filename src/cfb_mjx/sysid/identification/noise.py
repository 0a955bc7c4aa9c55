"""Noise of a flight: what the sensors do to what they measure, and what pushes the drone that no model knows."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.sysid.identification.flight_data import FlightData

_SHORTEST, _LONGEST = 0.03, 3.0  # correlation time of the disturbance, s

UNTIMED = 0.3
"""Least of `Noise.command`: a step came at any moment between two rows (1 / sqrt(12) of it), however smooth the others
are. Steps that come in time with the rows would else decide how long commands act."""
_FLOORS = np.array([1e-4] * 6 + [1e-3] * 3 + [1e-3, 1e-5, 1e-3, 1e-2, 1e-2, 1e-2, UNTIMED])
"""Least of every level, in the order of `Noise` without the correlation time."""


class Noise(eqx.Module):
    """Standard deviations, one per axis where there are axes, and the two time constants that go with them."""

    gyro: Float[Array, "3"]
    """White noise of a gyro row, rad/s."""
    rate_walk: Float[Array, "3"]
    """White angular acceleration, rad/s per square root of a second."""
    disturbance: Float[Array, "3"]
    """Wandering angular acceleration, rad/s^2."""
    correlation_time: Float[Array, ""]
    """Of the wandering angular acceleration, s."""
    accelerometer: Float[Array, ""]
    """White noise of the z accelerometer, m/s^2."""
    accelerometer_lag: Float[Array, ""]
    """Time constant of the accelerometer's low-pass filter, s."""
    force_disturbance: Float[Array, ""]
    """Wandering specific force along z, m/s^2."""
    rotor: Float[Array, ""]
    """White noise of a rotor speed row, rad/s."""
    rotor_walk: Float[Array, ""]
    """White rotor acceleration, rad/s per square root of a second: what the motor model misses."""
    rotor_disturbance: Float[Array, ""]
    """Wandering error of the steady rotor speed, rad/s."""

    command: Float[Array, ""]
    """Error of the mean command between two rows, as a share of `Segments.doubt`: commands that were not logged."""

    def to_vector(self) -> Float[Array, "17"]:
        """Unconstrained numbers, for optimisation."""
        middle = jnp.sqrt(_SHORTEST * _LONGEST)
        time = jnp.log(self.correlation_time / middle) / jnp.log(_LONGEST / middle)
        levels = (self.gyro, self.rate_walk, self.disturbance, self.accelerometer, self.accelerometer_lag)
        levels = (*levels, self.force_disturbance, self.rotor, self.rotor_walk, self.rotor_disturbance, self.command)
        levels = jnp.concatenate([jnp.atleast_1d(level) for level in levels])
        # A level at its floor stays there and movable: a thousandth of the floor above it.
        logs = jnp.log(jnp.maximum(levels - _FLOORS, 1e-3 * _FLOORS))
        return jnp.concatenate([logs[:9], jnp.arctanh(jnp.clip(time, -0.999, 0.999))[None], logs[9:]])

    @staticmethod
    def from_vector(vector: Float[Array, "17"]) -> Noise:
        """Inverse of `to_vector`; a floor keeps a vanishing level from flattening the likelihood."""
        x = jnp.exp(jnp.concatenate([vector[:9], vector[10:]])) + _FLOORS
        middle = jnp.sqrt(_SHORTEST * _LONGEST)
        return Noise(
            gyro=x[0:3],
            rate_walk=x[3:6],
            disturbance=x[6:9],
            correlation_time=middle * jnp.exp(jnp.tanh(vector[9]) * jnp.log(_LONGEST / middle)),
            accelerometer=x[9],
            accelerometer_lag=x[10],
            force_disturbance=x[11],
            rotor=x[12],
            rotor_walk=x[13],
            rotor_disturbance=x[14],
            command=x[15],
        )

    @staticmethod
    def first(data: FlightData) -> Noise:
        """Where a fit starts: sensors as their third differences show, the rest as seen on real flights."""
        rotor = data.rotor_speed_noise if np.isfinite(data.rotor_speed_noise) else 10.0
        levels = dict(
            gyro=np.maximum(data.rate_noise, 1e-3),
            rate_walk=np.full(3, 0.3),
            disturbance=np.full(3, 4.0),
            correlation_time=0.3,
            accelerometer=max(data.specific_force_noise[2], 1e-2),
            accelerometer_lag=1e-3,
            force_disturbance=0.5,
            rotor=max(rotor, 1.0),
            rotor_walk=30.0,
            rotor_disturbance=20.0,
            command=2 * UNTIMED,
        )
        # An explicit type: weakly typed numbers would compile every program twice.
        return Noise(**{name: jnp.asarray(level, jnp.result_type(float)) for name, level in levels.items()})
