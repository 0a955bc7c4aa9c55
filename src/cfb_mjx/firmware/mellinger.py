"""The Crazyflie firmware's Mellinger controller: position and attitude in one loop at 500 Hz.

Equations of Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors" (ICRA 2011), with the
additions of the firmware (integrals, a derivative of the rate error), its gains and its limits
(bitcraze/crazyflie-firmware, August 2026: ``controller_mellinger.c``, the defaults for this platform). As in the
firmware, forces are multiplied by a fixed number of counts per newton, and moments are counts.

The firmware's counts per newton were never scaled for this drone and do not fit it (crazyflie-firmware issues 832 and
1625): if counts are commands, u = count / 65535, a drone of 44 g hovers 7 to 10 cm too high. Use `Mellinger.hovering`
for a drone that is to hold its height.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.firmware.pid import COUNTS, DT, mix
from cfb_mjx.model.rotors import hover_command
from cfb_mjx.model.state import AnyArray, State
from cfb_mjx.model.vector import Vec
from cfb_mjx.model.vector import rotate as rotated
from cfb_mjx.parameters import Parameters

GRAVITY = 9.81


class Mellinger(eqx.Module):
    """Gains and limits; forces in N, moments in counts."""

    mass: Float[Array, ""] | float = 0.0393
    """Mass of the platform as configured in the firmware, kg."""
    mass_thrust: Float[Array, ""] | float = 132000.0
    """Counts per newton of thrust."""
    kp: tuple[float, float, float] = (0.4, 0.4, 1.25)
    """Position gain, N/m."""
    kd: tuple[float, float, float] = (0.2, 0.2, 0.4)
    """Velocity gain, N s/m."""
    ki: tuple[float, float, float] = (0.05, 0.05, 0.05)
    """Gain of the integral of the position error, N/(m s)."""
    integral_limit: tuple[float, float, float] = (2.0, 2.0, 0.4)
    """Limit of that integral, m s."""
    attitude: tuple[float, float, float] = (70000.0, 70000.0, 60000.0)
    """Attitude gain k_R, counts."""
    rate: tuple[float, float, float] = (20000.0, 20000.0, 12000.0)
    """Rate gain k_omega, counts s/rad."""
    attitude_integral: tuple[float, float, float] = (0.0, 0.0, 500.0)
    """Gain k_i of the integral of the attitude error, counts/s."""
    attitude_integral_limit: tuple[float, float, float] = (1.0, 1.0, 1500.0)
    """Limit of that integral, s."""
    rate_derivative: float = 200.0
    """Gain of the derivative of the rate error in roll and pitch, counts s^2/rad."""
    moment_limit: float = 32000.0
    idle: float = 7000.0
    """Lowest command of every motor, counts."""

    @classmethod
    def hovering(cls, parameters: Parameters) -> Mellinger:
        """Return the firmware's gains with the mass and the counts per newton at which ``parameters`` hover."""
        # The thrust that `step` asks for at rest, wherever the drone flies.
        asked = parameters.mass * GRAVITY
        return cls(mass=parameters.mass, mass_thrust=COUNTS * jnp.mean(hover_command(parameters)) / asked)


class MellingerState(eqx.Module):
    """Memory between steps."""

    position: Float[Array, "3"]
    """Integral of the position error, m s."""
    attitude: Float[Array, "3"]
    """Integral of the attitude error, s."""
    body_rate: Float[AnyArray, "3"]
    """Body rate of the previous step, rad/s."""


def init(measurement: State) -> MellingerState:
    """Return a memory with empty integrals, after ``measurement``."""
    zero = jnp.zeros(3)
    return MellingerState(zero, zero, jnp.asarray(measurement.body_rate, zero.dtype))


def attitude_error(quaternion: Float[AnyArray, "4"], wanted: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """(R_des^T R - R^T R_des) as a vector, without the factor 1/2 of the article, as in the firmware.

    Args:
        quaternion: measured attitude, body to world.
        wanted: R_des; its columns are the wanted body axes in the world.
    """
    q = Vec.unstack(quaternion)
    axes = jnp.stack([rotated(q, Vec(*row)).stack() for row in jnp.eye(3)], axis=1)
    product = wanted.T @ axes
    skew = product - product.T
    return jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])


def step(
    controller: Mellinger,
    state: MellingerState,
    measurement: State,
    position: Float[Array, "3"],
    yaw: Float[Array, ""] | float = 0.0,
    velocity: Float[Array, "3"] | float = 0.0,
    acceleration: Float[Array, "3"] | float = 0.0,
) -> tuple[MellingerState, Float[Array, "4"]]:
    """One step of `cfb_mjx.firmware.pid.DT` seconds.

    Args:
        controller: gains and limits.
        state: memory.
        measurement: position, velocity, attitude and body rate, SI; rotor speeds are not used.
        position: wanted position, world, m.
        yaw: wanted yaw, rad.
        velocity: wanted velocity, world, m/s.
        acceleration: wanted acceleration, world, m/s^2.

    Returns:
        The new memory and the command (4,) in [0, 1] of M1..M4.
    """
    k = jax.tree.map(lambda x: jnp.asarray(x, measurement.position.dtype), controller)
    triple = {name: jnp.stack(value) for name, value in vars(k).items() if isinstance(value, tuple)}
    error = position - measurement.position
    limit = triple["integral_limit"]
    integral = jnp.clip(state.position + DT * error, -limit, limit)
    force = (
        k.mass * (acceleration + jnp.array([0.0, 0.0, GRAVITY]))
        + triple["kp"] * error
        + triple["kd"] * (velocity - measurement.velocity)
        + triple["ki"] * integral
    )
    up = rotated(Vec.unstack(measurement.quaternion), Vec(0.0, 0.0, 1.0)).stack()
    thrust = k.mass_thrust * (force @ up)

    z = force / jnp.linalg.norm(force)
    heading = jnp.stack([jnp.cos(jnp.asarray(yaw)), jnp.sin(jnp.asarray(yaw)), jnp.zeros(())])
    y = jnp.cross(z, heading)
    y = y / jnp.linalg.norm(y)
    turned = attitude_error(measurement.quaternion, jnp.stack([jnp.cross(y, z), y, z], axis=1))
    limit = triple["attitude_integral_limit"]
    turned_integral = jnp.clip(state.attitude - DT * turned, -limit, limit)
    slowing = (state.body_rate - measurement.body_rate) / DT * jnp.array([1.0, 1.0, 0.0])
    moment = (
        -triple["attitude"] * turned
        - triple["rate"] * measurement.body_rate
        + triple["attitude_integral"] * turned_integral
        + k.rate_derivative * slowing
    )
    # The mixing expects pitch in the firmware's sign: nose up.
    moment = jnp.clip(moment, -k.moment_limit, k.moment_limit) * jnp.array([1.0, -1.0, 1.0])
    flying = thrust > 0
    zero = jnp.zeros(3, moment.dtype)
    new = MellingerState(
        jnp.where(flying, integral, zero), jnp.where(flying, turned_integral, zero), measurement.body_rate
    )
    return new, mix(jnp.where(flying, thrust, 0.0), jnp.where(flying, moment, zero), controller.idle)
