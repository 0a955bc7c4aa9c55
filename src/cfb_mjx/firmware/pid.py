"""The Crazyflie firmware's cascaded PID: position and velocity at 100 Hz, attitude and rate at 500 Hz.

Gains, limits, signs and mixing are those of the platform CF21BL (bitcraze/crazyflie-firmware, August 2026:
``platform_defaults_cf21bl.h``, ``position_controller_pid.c``, ``attitude_pid_controller.c``, ``pid.c``,
``power_distribution_quadrotor.c``). As in the firmware, angles are in degrees, pitch is positive with the nose up (the
legacy sign, opposite to a rotation about +y), thrust counts range from 0 to 65535, and the derivative acts on the
unfiltered measurement.

Two things differ. First, the count of a motor is its command, u = count / 65535: the firmware before its battery
compensation, which otherwise treats a count as a thrust. Second, `FirmwarePid.hovering` sets the base thrust to the
count that hovers: the firmware's own 30000 stands for a thrust, and without the compensation the drone hovers only once
the integrator has found the difference.

`update` steps three parallel loops of the firmware's ``pid.c``. `PositionHold` holds positions, for code that flies a
drone with any controller.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cfb_mjx.model.rotors import hover_command
from cfb_mjx.model.state import AnyArray, State
from cfb_mjx.parameters import Parameters


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


COUNTS = 65535.0
DT = 0.002
"""Time between two steps, s: the attitude and rate loops run at 500 Hz."""
DIVIDER = 5
"""Steps per run of the position and velocity loops, which run at 100 Hz."""
_OVERHEAD = 1.1
"""Ratio of the output limits of the position and velocity loops to the velocity and tilt limits."""
_LEGACY = (1.0, -1.0, 1.0)
"""Signs between roll, pitch, yaw and the firmware's convention, in both directions."""
_MIXING = ((-0.5, 0.5, 1.0), (-0.5, -0.5, -1.0), (0.5, -0.5, 1.0), (0.5, 0.5, -1.0))
"""Effect of roll, pitch and yaw counts on M1..M4."""


class FirmwarePid(eqx.Module):
    """Gains and limits. Outputs: position m/s, velocity deg (x, y) and kilocounts (z), attitude deg/s, rate counts."""

    position: Gains = gains(kp=(2, 2, 2), ki=(0, 0, 0.5), output_limit=(_OVERHEAD,) * 3)
    velocity: Gains = gains(kp=(25, 25, 25), ki=(1, 1, 15), output_limit=(20 * _OVERHEAD, 20 * _OVERHEAD, 32.767))
    attitude: Gains = gains(kp=(6, 6, 6), ki=(3, 3, 1), kd=(0, 0, 0.35), integral_limit=(20, 20, 360))
    rate: Gains = gains(
        kp=(200, 200, 120),
        ki=(400, 400, 16.7),
        kd=(2.5, 2.5, 0),
        integral_limit=(33.3, 33.3, 166.7),
        output_limit=(32767.0,) * 3,
    )
    tilt_limit_deg: float = 20.0
    thrust_base: Float[Array, ""] | float = 30000.0
    """Command of every motor at zero vertical velocity error, counts."""
    thrust_min: float = 20000.0
    """Lowest collective thrust of the velocity loop, counts."""
    idle: float = 7000.0
    """Lowest command of every motor, counts."""

    @classmethod
    def hovering(cls, parameters: Parameters) -> FirmwarePid:
        """Return the firmware's gains with the base thrust at which ``parameters`` hover."""
        return cls(thrust_base=COUNTS * jnp.mean(hover_command(parameters)))


class PidState(eqx.Module):
    """Memory of the loops between steps."""

    tick: Int[Array, ""]
    position: Memory
    velocity: Memory
    attitude: Memory
    rate: Memory
    attitude_wanted_deg: Float[Array, "2"]
    """Roll and pitch (firmware's signs) from the last run of the velocity loop, deg."""
    thrust: Float[Array, ""]
    """Collective thrust from the last run of the velocity loop, counts."""


class Setpoint(eqx.Module):
    """Set-point: a position, a velocity, or an attitude with a given collective. Build it with its class methods."""

    position: Float[Array, "3"]
    yaw: Float[Array, ""]
    roll_pitch: Float[Array, "2"]
    thrust: Float[Array, ""]
    hold_position: Float[Array, ""]
    """1: hold position (or velocity) and yaw; 0: hold roll, pitch, yaw and thrust."""
    velocity: Float[Array, "3"] = eqx.field(default_factory=lambda: jnp.zeros(3))
    hold_velocity: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(0.0))
    """1, with ``hold_position``: hold ``velocity`` instead of the position."""

    @classmethod
    def hover(cls, position: Float[Array, "3"], yaw: Float[Array, ""] | float = 0.0) -> Setpoint:
        """Hold ``position`` [m, world] and ``yaw`` [rad]."""
        position = jnp.asarray(position, jnp.result_type(float))
        return cls(position, jnp.asarray(yaw, position.dtype), jnp.zeros(2), jnp.asarray(0.0), jnp.asarray(1.0))

    @classmethod
    def moving(cls, velocity: Float[Array, "3"], yaw: Float[Array, ""] | float = 0.0) -> Setpoint:
        """Hold ``velocity`` [m/s, world] and ``yaw`` [rad]."""
        velocity = jnp.asarray(velocity, jnp.result_type(float))
        yaw, one = jnp.asarray(yaw, velocity.dtype), jnp.asarray(1.0)
        return cls(jnp.zeros(3), yaw, jnp.zeros(2), jnp.asarray(0.0), one, velocity, one)

    @classmethod
    def tilted(
        cls,
        roll: Float[Array, ""] | float = 0.0,
        pitch: Float[Array, ""] | float = 0.0,
        yaw: Float[Array, ""] | float = 0.0,
        thrust: Float[Array, ""] | float = 0.5,
    ) -> Setpoint:
        """Hold an attitude [rad, about body x, y, z] with a mean command ``thrust`` in [0, 1]."""
        angles = jnp.stack([jnp.asarray(x, jnp.result_type(float)) for x in (roll, pitch, yaw)])
        return cls(jnp.zeros(3), angles[2], angles[:2], jnp.asarray(thrust, angles.dtype), jnp.asarray(0.0))


def init(controller: FirmwarePid, measurement: State) -> PidState:
    """Return a memory with empty integrators, after ``measurement``."""
    position, velocity, angles_deg, rates_deg = _signals(measurement)
    zero = jnp.zeros(3)
    return PidState(
        tick=jnp.asarray(0),
        position=Memory(zero, position),
        velocity=Memory(zero, velocity),
        attitude=Memory(zero, angles_deg),
        rate=Memory(zero, rates_deg),
        attitude_wanted_deg=jnp.zeros(2),
        thrust=jnp.asarray(controller.thrust_base, zero.dtype),
    )


def resume(controller: FirmwarePid, state: PidState, measurement: State) -> PidState:
    """Memory for taking over from another controller: integrators kept, no derivative kick, all loops due."""
    fresh = init(controller, measurement)
    return eqx.tree_at(
        lambda s: [getattr(s, loop).integral for loop in ("position", "velocity", "attitude", "rate")],
        fresh,
        [getattr(state, loop).integral for loop in ("position", "velocity", "attitude", "rate")],
    )


def step(
    controller: FirmwarePid, state: PidState, measurement: State, setpoint: Setpoint
) -> tuple[PidState, Float[Array, "4"]]:
    """One step of `DT` seconds.

    Args:
        controller: gains and limits.
        state: memory.
        measurement: position, velocity and attitude from the estimator, body rate from the gyro, SI; rotor speeds are
            not used.
        setpoint: what to hold.

    Returns:
        The new memory and the command (4,) in [0, 1] of M1..M4.
    """
    position, velocity, angles_deg, rates_deg = _signals(measurement)
    yaw = jnp.radians(angles_deg[2])
    due = (state.tick % DIVIDER == 0) & (setpoint.hold_position > 0)

    slow = DT * DIVIDER
    wanted_position = _heading_frame(setpoint.position, yaw)
    position_memory, wanted_velocity = update(
        controller.position, state.position, wanted_position - position, position, slow
    )
    # As in the firmware, the position loop rests while a velocity is held.
    moving = setpoint.hold_velocity > 0
    position_memory = jax.tree.map(lambda new, old: jnp.where(moving, old, new), position_memory, state.position)
    wanted_velocity = jnp.where(moving, _heading_frame(setpoint.velocity, yaw), wanted_velocity)
    velocity_memory, output = update(controller.velocity, state.velocity, wanted_velocity - velocity, velocity, slow)
    limit = controller.tilt_limit_deg
    # Forward is nose down and left is left side down, both negative in the firmware's signs.
    roll_pitch_deg = jnp.clip(-output[np.array([1, 0])], -limit, limit)
    thrust = jnp.clip(1000.0 * output[2] + controller.thrust_base, controller.thrust_min, COUNTS)
    position_memory, velocity_memory, roll_pitch_deg, thrust = jax.tree.map(
        lambda new, old: jnp.where(due, new, old),
        (position_memory, velocity_memory, roll_pitch_deg, thrust),
        (state.position, state.velocity, state.attitude_wanted_deg, state.thrust),
    )

    held = setpoint.hold_position > 0
    collective = jnp.where(held, thrust, COUNTS * setpoint.thrust)
    tilt_deg = jnp.where(held, roll_pitch_deg, jnp.degrees(setpoint.roll_pitch) * np.array(_LEGACY[:2]))
    wanted_deg = jnp.append(tilt_deg, jnp.degrees(setpoint.yaw))
    yaw_wraps = np.array([False, False, True])
    attitude_memory, wanted_rate_deg = update(
        controller.attitude, state.attitude, wanted_deg - angles_deg, angles_deg, DT, yaw_wraps
    )
    rate_memory, command = rate_step(controller, state.rate, rates_deg, wanted_rate_deg, collective)

    new = PidState(
        state.tick + 1, position_memory, velocity_memory, attitude_memory, rate_memory, roll_pitch_deg, thrust
    )
    return new, command


def rate_step(
    controller: FirmwarePid,
    memory: Memory,
    rates_deg: Float[Array, "3"],
    wanted_deg: Float[Array, "3"],
    thrust: Float[Array, ""],
) -> tuple[Memory, Float[Array, "4"]]:
    """One step of the rate loop alone, `DT` seconds.

    Args:
        controller: gains and limits.
        memory: memory of the rate loop.
        rates_deg: measured roll, pitch and yaw rates, deg/s, pitch positive with the nose up (`firmware_rates`).
        wanted_deg: wanted rates, likewise.
        thrust: collective thrust, counts.

    Returns:
        The new memory and the command (4,) in [0, 1] of M1..M4.
    """
    memory, torque = update(controller.rate, memory, wanted_deg - rates_deg, rates_deg, DT)
    return memory, mix(thrust, torque, controller.idle)


def firmware_rates(body_rate: Float[AnyArray, "3"]) -> Float[Array, "3"]:
    """Body rates [rad/s, about x, y, z] as the firmware's loops take them: deg/s, pitch positive with the nose up."""
    return jnp.degrees(body_rate) * np.array(_LEGACY)


def mix(thrust: Float[Array, ""], torque: Float[Array, "3"], idle: Float[Array, ""] | float = 0.0) -> Float[Array, "4"]:
    """Mix collective thrust and roll, pitch, yaw torques (counts) to commands in [0, 1] ("legacy" mixing).

    Positive counts ask for roll about +x, nose up (legacy sign), and yaw about +z. If a motor would exceed full power,
    all are lowered by the same amount, as in the firmware: attitude has priority over height.
    """
    # The firmware inverts the sign of the yaw output before mixing.
    counts = thrust + np.array(_MIXING) @ (torque * np.array([1.0, 1.0, -1.0]))
    counts = counts - jnp.maximum(jnp.max(counts) - COUNTS, 0.0)
    return jnp.clip(counts, idle, COUNTS) / COUNTS


def _signals(measurement: State):
    """Position and velocity along the heading (m, m/s); roll, pitch, yaw (deg) and rates (deg/s) in legacy signs."""
    w, x, y, z = measurement.quaternion
    # Clipped just inside the range, because the derivative of arcsin is infinite at the poles.
    sine = jnp.clip(2 * (w * y - z * x), -1 + 1e-9, 1 - 1e-9)
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    angles = jnp.stack([jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), jnp.arcsin(sine), yaw])
    return (
        _heading_frame(measurement.position, yaw),
        _heading_frame(measurement.velocity, yaw),
        jnp.degrees(angles) * np.array(_LEGACY),
        firmware_rates(measurement.body_rate),
    )


def _heading_frame(vector: Float[AnyArray, "3"], yaw: Float[Array, ""]) -> Float[Array, "3"]:
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([c * vector[0] + s * vector[1], c * vector[1] - s * vector[0], vector[2]])


class PositionHold(eqx.Module):
    """Hold positions with a `FirmwarePid`."""

    pid: FirmwarePid

    def start(self, measurement: State) -> PidState:
        """Return the memory at the first measurement."""
        return init(self.pid, measurement)

    def resume(self, memory: PidState, measurement: State) -> PidState:
        """Return the memory for taking over again."""
        return resume(self.pid, memory, measurement)

    def command(
        self, memory: PidState, measurement: State, position: Float[Array, "3"], yaw: Float[Array, ""] | float = 0.0
    ) -> tuple[PidState, Float[Array, "4"]]:
        """New memory and command to hold ``position`` [m, world] and ``yaw`` [rad]; call it every `pid.DT` seconds."""
        return step(self.pid, memory, measurement, Setpoint.hover(position, yaw))
