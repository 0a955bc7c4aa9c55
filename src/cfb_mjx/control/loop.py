"""Three parallel PID loops, as in the Crazyflie firmware (``pid.c``)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cfb_mjx.model.state import AnyArray


class Gains(eqx.Module):
    """Gains and limits of three parallel loops."""

    kp: tuple[float, float, float]
    ki: tuple[float, float, float]
    kd: tuple[float, float, float]
    integral_limit: tuple[float, float, float]
    """Limit of the integral of the error, before ``ki``; error unit times s."""
    output_limit: tuple[float, float, float]


def gains(kp, ki=(0, 0, 0), kd=(0, 0, 0), integral_limit=(5000,) * 3, output_limit=(float("inf"),) * 3) -> Gains:
    """Build `Gains` from numbers; the defaults are the firmware's."""
    return Gains(*map(_three, (kp, ki, kd, integral_limit, output_limit)))


def _three(numbers) -> tuple[float, float, float]:
    x, y, z = map(float, numbers)
    return x, y, z


class Memory(eqx.Module):
    """Integral of the error, and the measurement of the previous step."""

    integral: Float[Array, "3"]
    previous: Float[Array, "3"]


def update(
    gains: Gains,
    memory: Memory,
    error: Float[Array, "3"],
    measured: Float[Array, "3"],
    dt: float,
    wraps: Bool[AnyArray, "3"] | bool = False,
) -> tuple[Memory, Float[Array, "3"]]:
    """One step: proportional and integral of the error, derivative of the measurement.

    The integral enters the output of the same step. It is limited, but does not stop while the output saturates.

    Args:
        gains: gains of the three loops.
        memory: memory of the previous step.
        error: wanted minus measured value.
        measured: measurement, of which the derivative is taken.
        dt: time since the previous step, s.
        wraps: which channels are angles in deg, with differences along the shorter arc.

    Returns:
        The new memory and the output.
    """
    kp, ki, kd, integral_limit, output_limit = (jnp.asarray(x, error.dtype) for x in vars(gains).values())
    error = jnp.where(wraps, _short_way(error), error)
    change = measured - memory.previous
    change = jnp.where(wraps, _short_way(change), change)
    integral = jnp.clip(memory.integral + dt * error, -integral_limit, integral_limit)
    output = kp * error + ki * integral - kd * change / dt
    return Memory(integral, measured), jnp.clip(output, -output_limit, output_limit)


def _short_way(angle_deg):
    # Equal to the angle modulo a full turn; the derivative is one.
    return angle_deg - 360.0 * jnp.round(angle_deg / 360.0)
