"""Single time constant equivalent to a motor with two time constants and a dead time.

A direct fit of a model without dead time would explain the dead time by noise and bias the constants. Instead, the full
motor is fitted first. Then the single lag is chosen whose response to the recorded commands is closest to that of the
full motor. Both responses are simulated from the commands alone, so neither noise nor feedback biases this
least-squares step.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.sysid.rotors.motor_filter import Motor, simulate
from cfb_mjx.sysid.rotors.motor_likelihood import Optimum
from cfb_mjx.sysid.rotors.motor_tracks import MotorData, Tracks


@eqx.filter_jit
def _response(vector, tracks: Tracks):
    def speed(x):
        found = simulate(Motor.from_vector(x), tracks) * tracks.judged
        return found, found

    slope, found = jax.jacfwd(speed, has_aux=True)(vector)
    return found, slope


def common_lag(full: Optimum, data: MotorData) -> tuple[float, float]:
    """Time constant of the closest single lag, and its standard deviation, s.

    Args:
        full: fit with spin-up and spin-down constants, a dead time, or both.
        data: recordings to which it was fitted.
    """
    tracks = jax.tree.map(jnp.asarray, data.tracks)
    goal, full_slope = (np.asarray(x) for x in _response(jnp.asarray(full.vector), tracks))
    vector = np.array(full.vector)
    motor = full.motor
    vector[2:4], vector[4] = np.log(max(0.5 * (motor.spin_up + motor.spin_down) + motor.dead_time, 2e-3)), 0.0
    slope = np.zeros_like(goal)
    for _ in range(12):
        found, slope = (np.asarray(x) for x in _response(jnp.asarray(vector), tracks))
        slope = slope[..., 2] + slope[..., 3]
        change = np.sum(slope * (goal - found)) / np.sum(slope**2)
        vector[2:4] += np.clip(change, -0.5, 0.5)
        if abs(change) < 1e-8:
            break
    # Derivative of the closest lag with respect to the constants of the full motor; gain and offset affect both alike.
    moved = np.einsum("sn,snk->k", slope, full_slope) / np.sum(slope**2) @ full.directions
    level = [i for i, name in enumerate(full.names) if name in ("motor_gain", "motor_speed_offset")]
    moved[level] = 0.0
    std = float(np.sqrt(moved @ full.uncertainty.covariance @ moved))
    lag = float(np.exp(vector[2]))
    return lag, std * lag
