"""Noise model of a flight: measurement noise of the sensors, and disturbances that the model does not describe."""

from __future__ import annotations

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.sysid.identification.flight_data import FlightData
from cfb_mjx.sysid.identification.solver import Bounds, bounded_one

_SHORTEST, _LONGEST = 0.03, 3.0  # correlation time of the disturbance, s
_MIDDLE = math.sqrt(_SHORTEST * _LONGEST)

UNTIMED = 0.3
"""Lower bound of `Noise.command`: a step may occur at any moment between two rows (1 / sqrt(12) of it), however smooth
the other commands are. Otherwise, steps in phase with the rows would dominate the estimate of the command hold."""
_FLOORS = np.array([1e-4] * 6 + [1e-3] * 3 + [1e-3, 1e-5, 1e-3, 1e-2, 1e-2, 1e-2, UNTIMED])
"""Lower bound of every level, in the order of `Noise` without the correlation time."""


class Noise(eqx.Module):
    """Noise levels (standard deviations, one per axis where there are axes) and the two time constants."""

    gyro: Float[Array, "3"]
    """White measurement noise of the gyro per row, rad/s."""
    rate_walk: Float[Array, "3"]
    """White angular acceleration, rad/s per square root of a second."""
    disturbance: Float[Array, "3"]
    """Slowly varying angular acceleration, rad/s^2."""
    correlation_time: Float[Array, ""]
    """Correlation time of the slowly varying angular acceleration, s."""
    accelerometer: Float[Array, ""]
    """White measurement noise of the z accelerometer per row, m/s^2."""
    accelerometer_lag: Float[Array, ""]
    """Time constant of the accelerometer's low-pass filter, s."""
    force_disturbance: Float[Array, ""]
    """Slowly varying specific force along z, m/s^2."""
    rotor: Float[Array, ""]
    """White measurement noise of the rotor speed per row, rad/s."""
    rotor_walk: Float[Array, ""]
    """White rotor acceleration, for errors of the motor model, rad/s per square root of a second."""
    rotor_disturbance: Float[Array, ""]
    """Slowly varying error of the steady rotor speed, rad/s."""

    command: Float[Array, ""]
    """Error of the mean command between two rows due to commands not logged, as a share of `Segments.doubt`."""

    def to_vector(self) -> Float[Array, "17"]:
        """Vector for optimisation, within `bounds`."""
        time = jnp.log(self.correlation_time / _MIDDLE)
        levels = (self.gyro, self.rate_walk, self.disturbance, self.accelerometer, self.accelerometer_lag)
        levels = (*levels, self.force_disturbance, self.rotor, self.rotor_walk, self.rotor_disturbance, self.command)
        levels = jnp.concatenate([jnp.atleast_1d(level) for level in levels])
        # A level at its bound is placed slightly above it, so that its logarithm stays finite.
        logs = jnp.log(jnp.maximum(levels - _FLOORS, 1e-3 * _FLOORS))
        return jnp.concatenate([logs[:9], time[None], logs[9:]])

    @staticmethod
    def from_vector(vector: Float[Array, "17"]) -> Noise:
        """Inverse of `to_vector`; lower bounds on the levels avoid the flat likelihood where a level vanishes."""
        x = jnp.exp(jnp.concatenate([vector[:9], vector[10:]])) + _FLOORS
        return Noise(
            gyro=x[0:3],
            rate_walk=x[3:6],
            disturbance=x[6:9],
            correlation_time=_MIDDLE * jnp.exp(vector[9]),
            accelerometer=x[9],
            accelerometer_lag=x[10],
            force_disturbance=x[11],
            rotor=x[12],
            rotor_walk=x[13],
            rotor_disturbance=x[14],
            command=x[15],
        )

    @staticmethod
    def bounds() -> Bounds:
        """Smallest and largest vector: only the correlation time is bounded, to what a flight's segments can tell."""
        return bounded_one(17, 9, *(math.log(time / _MIDDLE) for time in (_SHORTEST, _LONGEST)))

    @staticmethod
    def first(data: FlightData) -> Noise:
        """Initial noise levels of a fit: sensor noise from third differences, the rest as typical of real flights."""
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
        # Explicit dtype: with weakly typed numbers every program would be compiled twice.
        return Noise(**{name: jnp.asarray(level, jnp.result_type(float)) for name, level in levels.items()})
