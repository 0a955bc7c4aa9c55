"""Motors and rotors: exact first-order speed, cubic thrust and torque, reactive torque (paper eqs. 5-10).

The command is constant within a step, so each rotor speed is an exponential in closed form. A `RotorPath` holds what
the body needs of it: speeds and accelerations at the start, middle and end, and the mean thrust and torque over the
step. Nothing here depends on the body that carries the rotors.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.state import AnyArray
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Parameters

YAW_SIGNS = (-1.0, 1.0, -1.0, 1.0)
"""Sign of each rotor's reaction on the body about +z (paper eq. 7)."""
POSITION_SIGNS_X = (1.0, -1.0, -1.0, 1.0)
POSITION_SIGNS_Y = (-1.0, -1.0, 1.0, 1.0)
"""Rotor positions in units of l/2: front-right, back-right, back-left, front-left."""
TORQUE_SIGNS = (POSITION_SIGNS_Y, tuple(-x for x in POSITION_SIGNS_X), YAW_SIGNS)
"""Sign of the torque about +x, +y and +z when a rotor turns faster (paper eqs. 6-7), one row per axis."""


class RotorLoads(eqx.Module):
    """Loads of the four rotors on the body."""

    thrust: Vec
    """Along body +z, N."""
    torque: Vec
    """Aerodynamic torque magnitude, N m (the body feels it with `YAW_SIGNS`)."""
    rate: Vec
    """Derivative of the rotor speed, Omega', rad/s^2; times J_m it is the reactive torque."""


class RotorPath(eqx.Module):
    """Rotor speeds and their rates over one step (start, middle, end), and the step's mean loads."""

    start: Vec
    middle: Vec
    end: Vec
    rate_start: Vec
    rate_middle: Vec
    rate_end: Vec
    mean: RotorLoads


class RotorConstants(eqx.Module):
    """Constants of all steps of one length, computed once outside the time loop."""

    decay: Vec
    decay_half: Vec
    mean1: Vec
    mean2: Vec
    mean3: Vec
    """(1/dt) * integral of exp(-n t / T) over the step, n = 1, 2, 3."""
    inverse_dt: Array
    inverse_time_constant: Vec
    gain: Vec
    offset: Vec
    thrust: Polynomial
    torque: Polynomial


class Polynomial(eqx.Module):
    """c3 x^3 + c2 x^2 + c1 x of each rotor's speed x [rad/s]; includes sigma and the rotor's own factor."""

    c3: Vec
    c2: Vec
    c1: Vec

    def __call__(self, x: Vec) -> Vec:
        return x * (self.c1 + x * (self.c2 + x * self.c3))

    def mean(self, a: Vec, b: Vec, constants: RotorConstants) -> Vec:
        """Mean over the step along x = a + b exp(-t/T), exact: the Taylor series about a ends after three terms."""
        first = self.c1 + a * (2 * self.c2 + a * (3 * self.c3))
        second = self.c2 + 3 * (a * self.c3)
        return self(a) + b * (
            constants.mean1 * first + b * (constants.mean2 * second + b * (constants.mean3 * self.c3))
        )


def polynomial(coefficients: AnyArray | Vec, scale: AnyArray | Vec, sigma: Array) -> Polynomial:
    """Polynomial in rotor speed from the coefficients of s^3, s^2, s with s = Omega / sigma."""
    c3, c2, c1 = Vec.unstack(coefficients)
    scale = Vec.unstack(scale)
    return Polynomial(scale * (c3 / sigma**3), scale * (c2 / sigma**2), scale * (c1 / sigma))


def prepare(parameters: Parameters, dt: Float[Array, ""] | float) -> RotorConstants:
    """Constants of the exact zero-order-hold solution of eq. (5) over ``dt`` seconds (``dt`` = 0 is allowed)."""
    time_constant = Vec.unstack(parameters.motor_time_constant)
    dt = jnp.asarray(dt, time_constant[0].dtype)
    return RotorConstants(
        **_lag(time_constant, dt),
        inverse_dt=jnp.where(dt > 0, 1 / jnp.where(dt > 0, dt, 1.0), 0.0),
        gain=Vec.unstack(parameters.motor_gain),
        offset=Vec.unstack(parameters.motor_speed_offset),
        thrust=polynomial(parameters.thrust_polynomial, parameters.thrust_scale, parameters.reference_rotor_speed),
        torque=polynomial(parameters.torque_polynomial, parameters.torque_scale, parameters.reference_rotor_speed),
    )


def with_time_constant(constants: RotorConstants, time_constant: Vec, dt) -> RotorConstants:
    """Replace the time constants, s."""
    changed = _lag(time_constant, dt)
    return eqx.tree_at(lambda c: tuple(getattr(c, name) for name in changed), constants, tuple(changed.values()))


def _lag(time_constant: Vec, dt) -> dict[str, Vec]:
    """Constants that depend on the time constants, per rotor."""
    x = dt / time_constant.stack()
    safe = jnp.where(x > 0, x, 1.0)

    def mean_of_exponential(n: int) -> Vec:
        return Vec.unstack(jnp.where(x > 0, -jnp.expm1(-n * safe) / (n * safe), 1.0))

    return {
        "decay": Vec.unstack(jnp.exp(-x)),
        "decay_half": Vec.unstack(jnp.exp(-x / 2)),
        "mean1": mean_of_exponential(1),
        "mean2": mean_of_exponential(2),
        "mean3": mean_of_exponential(3),
        "inverse_time_constant": time_constant.map(lambda t: 1 / t),
    }


def steady_speed(constants: RotorConstants, command: Vec) -> Vec:
    """Rotor speed for a command that is held forever, rad/s: K u plus the offset of an affine map."""
    return constants.gain * command + constants.offset


def path_to(constants: RotorConstants, speed: Vec, target: Vec) -> RotorPath:
    """Exact path of eq. (5) from ``speed`` towards the steady speed ``target``, both rad/s."""
    away = speed - target
    end = target + away * constants.decay
    rate = -(away * constants.inverse_time_constant)
    return RotorPath(
        start=speed,
        middle=target + away * constants.decay_half,
        end=end,
        rate_start=rate,
        rate_middle=rate * constants.decay_half,
        rate_end=rate * constants.decay,
        # The clamp acts on the mean; in a step in which a rotor crosses 229 rad/s this errs by less than 0.8 mN.
        mean=RotorLoads(
            constants.thrust.mean(target, away, constants).map(_at_least_zero),
            constants.torque.mean(target, away, constants),
            (end - speed) * constants.inverse_dt,
        ),
    )


def path_between(constants: RotorConstants, start: Vec, end: Vec) -> RotorPath:
    """Linear path between two measured rotor speeds, rad/s."""
    middle = 0.5 * (start + end)
    slope = (end - start) * constants.inverse_dt

    def simpson(curve: Polynomial) -> Vec:
        # Exact: along a linear path the loads are cubic in time.
        return (curve(start) + 4 * curve(middle) + curve(end)) / 6

    mean = RotorLoads(simpson(constants.thrust).map(_at_least_zero), simpson(constants.torque), slope)
    return RotorPath(start, middle, end, slope, slope, slope, mean)


def loads_at(constants: RotorConstants, speed: Vec, rate: Vec) -> RotorLoads:
    """Loads at one instant, from rotor speeds [rad/s] and their rates [rad/s^2]."""
    return RotorLoads(constants.thrust(speed).map(_at_least_zero), constants.torque(speed), rate)


def thrust(parameters: Parameters, speed: Float[AnyArray, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Thrust of each rotor [eq. 8], N, clamped at zero: below 229 rad/s the cubic is negative, a fit artefact."""
    curve = polynomial(parameters.thrust_polynomial, parameters.thrust_scale, parameters.reference_rotor_speed)
    return curve(Vec.unstack(speed)).map(_at_least_zero).stack()


def torque(parameters: Parameters, speed: Float[AnyArray, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Aerodynamic torque magnitude of each rotor [eq. 9], N m."""
    curve = polynomial(parameters.torque_polynomial, parameters.torque_scale, parameters.reference_rotor_speed)
    return curve(Vec.unstack(speed)).stack()


def _at_least_zero(x):
    # Not maximum: for a rotor at rest its derivative would be half the negative slope of the cubic.
    return jnp.where(x > 0, x, 0.0)


def hover_rotor_speed(parameters: Parameters) -> Float[Array, "4"]:
    """Rotor speeds whose thrusts carry the weight without roll or pitch torque, rad/s.

    An offset of the centre of gravity shifts load between the rotors. Solved by Newton's method on the cubic from full
    speed, which converges without a bracket because the thrust curve is convex where it matters; differentiable.
    """
    half = parameters.rotor_spacing / 2
    cog = jnp.asarray(parameters.center_of_gravity)
    x, y = (jnp.array(signs, cog.dtype) for signs in (POSITION_SIGNS_X, POSITION_SIGNS_Y))
    share = 0.25 * (1 + cog[0] * x / half + cog[1] * y / half)
    wanted = parameters.mass * parameters.gravity * share / parameters.thrust_scale
    c3, c2, c1 = parameters.thrust_polynomial

    def newton(_, s):
        return s - (((c3 * s + c2) * s + c1) * s - wanted) / ((3 * c3 * s + 2 * c2) * s + c1)

    s = jax.lax.fori_loop(0, 12, newton, jnp.full(4, 0.8, wanted.dtype))
    # Beyond the cubic's maximum Newton's method wanders and may return into the range; that is not a hover.
    residual = jnp.abs(((c3 * s + c2) * s + c1) * s - wanted)
    return jnp.where(residual <= 1e-5 * wanted, s, jnp.inf) * parameters.reference_rotor_speed


def hover_command(parameters: Parameters) -> Float[Array, "4"]:
    """Commands that hold the hover of `hover_rotor_speed`; outside [0, 1] if the drone cannot hover."""
    return steady_command(parameters, hover_rotor_speed(parameters))


def balanced_thrust_to_weight(parameters: Parameters) -> Float[Array, ""]:
    """Largest total thrust with balanced roll, pitch and yaw torques, over the weight.

    Below 1 the drone cannot hold its height without turning. Three balanced torques of four rotors leave one free
    number, the level of the thrusts, until the first rotor reaches full command. The ratio of torque to thrust of each
    rotor is taken at full command.
    """
    full = parameters.motor_gain + parameters.motor_speed_offset
    most = thrust(parameters, full)
    half, cog = parameters.rotor_spacing / 2, jnp.asarray(parameters.center_of_gravity)
    x, y, spin = (jnp.array(signs, most.dtype) for signs in (POSITION_SIGNS_X, POSITION_SIGNS_Y, YAW_SIGNS))
    arms = jnp.stack([half * y - cog[1], half * x - cog[0], spin * torque(parameters, full) / most])
    # The generalised cross product: what all three rows are orthogonal to.
    shares = jnp.stack([(-1) ** i * jnp.linalg.det(jnp.delete(arms, i, axis=1)) for i in range(4)])
    shares = shares / jnp.sum(shares)
    level = jnp.min(jnp.where(shares > 0, most / jnp.maximum(shares, 1e-12), 0.0))
    return level / (parameters.mass * parameters.gravity)


def steady_command(parameters: Parameters, speed: Float[AnyArray, "4"]) -> Float[Array, "4"]:
    """Commands for which the rotors settle at ``speed`` [rad/s]."""
    return (jnp.asarray(speed) - parameters.motor_speed_offset) / parameters.motor_gain


def rotor_speed_history(
    parameters: Parameters, times: Float[Array, " n"], commands: Float[Array, "n 4"]
) -> Float[Array, "n 4"]:
    """Rotor speeds at ``times`` [s] from logged commands, rad/s.

    The commands are held between rows, and the rotors are assumed steady at the first row. This estimates the rotor
    speed of a log that does not contain it (``docs/evaluation.md``).

    Args:
        parameters: constants of the drone.
        times: time of each row, s.
        commands: command of each row, 0 to 1.
    """
    targets = parameters.motor_gain * jnp.clip(commands, 0.0, 1.0) + parameters.motor_speed_offset

    def advance(speed, row):
        dt, target = row
        speed = target + (speed - target) * jnp.exp(-dt / parameters.motor_time_constant)
        return speed, speed

    _, later = jax.lax.scan(advance, targets[0], (jnp.diff(times), targets[:-1]))
    return jnp.concatenate([targets[:1], later])
