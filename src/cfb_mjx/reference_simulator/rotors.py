"""Forces of the four rotors and lag of their motors. Arrays are (4, F), body axes, SI units."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from cfb_mjx.optional import not_none
from cfb_mjx.reference_simulator import constants as c

HUB_EFFECTS = frozenset({"inflow", "rotor_drag", "flapping", "ground"})
DISC = np.pi * c.BLADE_RADIUS**2
ESC_SETTLING = 0.002  # s: a rate-limited speed controller's lag for small changes


def motor_rates(p: SimpleNamespace, gain, command, speed, esc, lagged):
    """Derivatives of the rotor speed and, if simulated, of the outputs of speed controller and second lag."""
    esc_rate = lag_rate = None
    if "esc_rate" in p.on:
        limit = np.maximum(p.esc_rate, 1e-6)
        esc_rate = p.esc_rate * np.tanh((command - esc) / (limit * ESC_SETTLING))
        command = np.where(p.esc_rate > 0, esc, command)
    if "second_lag" in p.on:
        has = p.second_lag > 0
        lag_rate = np.where(has, (command - lagged) / np.where(has, p.second_lag, 1.0), 0.0)
        command = np.where(has, lagged, command)
    missing = gain * command - speed
    lag = p.lag
    if "asymmetry" in p.on:
        # Spin-down is slower; the geometric mean of both time constants is the plain one.
        lag = lag * np.exp(-0.5 * p.asymmetry * np.tanh(missing / p.asymmetry_width))
    rate = missing / lag
    if "spin_limit" in p.on:
        has = p.spin_limit > 0
        limit = np.where(has, p.spin_limit, 1.0)
        rate = np.where(has, rate / (1 + (rate / limit) ** 6) ** (1 / 6), rate)
    return rate, esc_rate, lag_rate


def rotor_wrench(p: SimpleNamespace, height, rotation, body_velocity, w, speed, speed_rate):
    """Force (3, F) and moment (3, F) of all rotors about their centre.

    Args:
        p: parameters.
        height: height of the rotors' centre, (F,), m.
        rotation: body to world, (3, 3, F).
        body_velocity: airspeed, (3, F), m/s, body axes.
        w: body rate, (3, F), rad/s.
        speed: rotor speed, (4, F), rad/s.
        speed_rate: derivative of the rotor speed, (4, F), rad/s^2.
    """
    thrust, drag = c.thrust_curve(speed), c.torque_curve(speed)
    if "thrust_scale" in p.on:
        thrust = thrust * (p.thrust_scale + p.thrust_bend * (speed / c.SPEED_SCALE - 0.55))
    if "torque_scale" in p.on:
        drag = drag * p.torque_scale
    if "blades" in p.on:
        thrust, drag = thrust * p.blades[0], drag * p.blades[1]
    across2 = hub = loading = None
    if p.on & HUB_EFFECTS:
        hub = (
            body_velocity[0] - w[2] * c.ROTOR_Y,
            body_velocity[1] + w[2] * c.ROTOR_X,
            body_velocity[2] + w[0] * c.ROTOR_Y - w[1] * c.ROTOR_X,
        )
        across2 = hub[0] ** 2 + hub[1] ** 2
    if "inflow" in p.on:
        thrust = thrust * _inflow(p, thrust, not_none(hub)[2], across2, speed)
    if "ground" in p.on:
        thrust = thrust * _ground(p, height, rotation, across2)
    spin = (c.ROTOR_INERTIA * speed_rate + drag) * c.YAW
    force = np.empty((3, thrust.shape[1]))
    moment = np.empty_like(force)
    force[:2] = 0.0
    force[2] = thrust.sum(0)
    moment[0] = (c.ROTOR_Y * thrust).sum(0)
    moment[1] = -(c.ROTOR_X * thrust).sum(0)
    moment[2] = spin.sum(0)
    if "tilt" in p.on:
        side_x, side_y = p.tilt[0] * thrust, p.tilt[1] * thrust
        force[0] += side_x.sum(0)
        force[1] += side_y.sum(0)
        moment[2] += (c.ROTOR_X * side_y - c.ROTOR_Y * side_x).sum(0)
        moment[0] += (p.tilt[0] * spin).sum(0)
        moment[1] += (p.tilt[1] * spin).sum(0)
    if p.on & {"rotor_drag", "flapping"}:
        loading = np.sqrt(thrust / c.HOVER_THRUST)
    if "rotor_drag" in p.on:
        hub, across2, loading = not_none(hub), not_none(across2), not_none(loading)
        size = loading / np.sqrt(1 + across2 / p.rotor_drag_speed**2)
        side_x, side_y = -p.rotor_drag[0] * size * hub[0], -p.rotor_drag[1] * size * hub[1]
        force[0] += side_x.sum(0)
        force[1] += side_y.sum(0)
        moment[2] += (c.ROTOR_X * side_y - c.ROTOR_Y * side_x).sum(0)
    if "flapping" in p.on:
        # The disc tilts back, away from the motion. The component perpendicular to the motion has the sign of the
        # rotor's sense of rotation and nearly cancels over the four rotors.
        hub, across2, loading = not_none(hub), not_none(across2), not_none(loading)
        size = 0.25 * p.flapping * loading**2 / np.sqrt(1 + across2 / 49.0)
        size = size * (1 - p.flapping_climb * np.tanh(hub[2] / 2.0))
        turn = p.flapping_cross * c.YAW
        moment[0] += (size * (hub[1] + turn * hub[0])).sum(0)
        moment[1] += (size * (turn * hub[1] - hub[0])).sum(0)
    if "gyro_inertia" in p.on:
        momentum = -p.gyro_inertia * (c.YAW * speed).sum(0)  # a rotor turns against its reaction torque on the body
        moment[0] -= w[1] * momentum
        moment[1] += w[0] * momentum
    return force, moment


def _inflow(p, thrust, climb, across2, speed):
    """Thrust ratio of a rotor that moves along its axis (momentum theory) and, with less effect, across it."""
    hover2 = thrust / (2 * c.AIR_DENSITY * DISC)
    hover = np.sqrt(hover2)
    through = 0.5 * climb + np.sqrt(0.25 * climb**2 + hover2 / np.sqrt(1 + 0.04 * across2 / (hover2 + 1.0)))
    tip = c.BLADE_RADIUS * np.maximum(speed, 500.0)
    return 1 - 0.3 * np.tanh(p.inflow * (through - hover) / (0.3 * tip))


def _ground(p, height, rotation, across2):
    """Thrust ratio near the floor: an image rotor, saturated near the floor, weaker with tilt and lateral speed."""
    level = height + rotation[2, 0] * c.ROTOR_X + rotation[2, 1] * c.ROTOR_Y
    level = np.maximum(level, 0.0)
    image = p.ground / (level**2 + p.ground_core**2)
    image = image * rotation[2, 2] ** 2 / (1 + across2 / p.ground_wash**2)
    return 1 + image / (1 - 0.6 * np.minimum(image, 1.0))
