"""The one time constant that stands for a motor with two of them and a dead time.

Fitted directly, a model without dead time would explain it by its noise levels and bend its constants. So the full
motor is fitted, and the single lag whose response to the recorded commands is nearest to the full motor's is taken.
Both responses follow from the commands alone: no noise and no feedback is left to bias this least-squares step.
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
    """Time constant and its standard deviation, s.

    Args:
        full: a fit with spin-up and spin-down constants, dead time, or both.
        data: the recordings it was fitted to.
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
    # How the nearest lag follows the constants of the full motor, to first order; the gain moves both alike.
    moved = np.einsum("sn,snk->k", slope, full_slope) / np.sum(slope**2) @ full.directions
    level = [i for i, name in enumerate(full.names) if name in ("motor_gain", "motor_speed_offset")]
    moved[level] = 0.0
    std = float(np.sqrt(moved @ full.uncertainty.covariance @ moved))
    lag = float(np.exp(vector[2]))
    return lag, std * lag
