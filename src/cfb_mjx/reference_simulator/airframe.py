"""Equations of motion of many drones at once: states of F lanes (drones), (ROWS, F). SI units, world z up."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator.rotors import motor_rates, rotor_wrench

P, V, Q, W, SPEED = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13), slice(13, 17)
PLAIN_ROWS = 17
# Simulated only if a lane needs them: speed controller, second lag, bob (relative position; velocity), flex.
ESC, LAGGED, BOB, BOB_V, FLEX = slice(17, 21), slice(21, 25), slice(25, 28), slice(28, 31), slice(31, 33)
ROWS = 33
STRING_RATE, STRING_DAMPING = 75.0, 0.25  # rad/s, and damping ratio of the stretching string
WAKE_BEGINS = 0.05  # m below the other drone
LONGEST_WAKE = 1.0  # s
WAKE_MOMENTUM = 0.8047  # of the profile, over that of a uniform jet of half its width
WORLD_EFFECTS = frozenset({"wind", "tether", "wall", "bob_mass"})


def rotation_of(q: np.ndarray) -> np.ndarray:
    """Body-to-world matrices (3, 3, F) of quaternions (4, F)."""
    s = 2.0 * q[:, None] * q[None]
    r = np.empty((3, 3, q.shape[1]))
    r[0, 0] = 1 - s[2, 2] - s[3, 3]
    r[1, 1] = 1 - s[1, 1] - s[3, 3]
    r[2, 2] = 1 - s[1, 1] - s[2, 2]
    r[0, 1], r[1, 0] = s[1, 2] - s[0, 3], s[1, 2] + s[0, 3]
    r[0, 2], r[2, 0] = s[1, 3] + s[0, 2], s[1, 3] - s[0, 2]
    r[1, 2], r[2, 1] = s[2, 3] - s[0, 1], s[2, 3] + s[0, 1]
    return r


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (3, F)."""
    out = np.empty_like(b)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


def turn(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate vectors (3, F) by matrices (3, 3, F)."""
    return matrix[:, 0] * vector[0] + matrix[:, 1] * vector[1] + matrix[:, 2] * vector[2]


def turn_back(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate vectors (3, F) by the transposes of matrices (3, 3, F)."""
    return matrix[0] * vector[0] + matrix[1] * vector[1] + matrix[2] * vector[2]


def derivative(p: SimpleNamespace, x: np.ndarray, command: np.ndarray, held: SimpleNamespace, time: float):
    """Time derivative of the state, and the reading of the accelerometer.

    Args:
        p: parameters, as `physics.stack` gives them.
        x: state, (R, F).
        command: commands that the speed controllers receive, (4, F).
        held: inputs that are constant over a tick: ``gain`` (4, F) rad/s; the unexplained accelerations ``push``
            (3, F) m/s^2, world axes, and ``twist`` (3, F) rad/s^2; ``gust`` (2, F) N; ``phase`` (F,) of the rotating
            load at time 0, rad; ``past``, a function of an age (F,) in s that returns where the other drones were:
            position (3, F), thrust axis (3, F) and thrust (F,).
        time: s.

    Returns:
        Derivatives (R, F), and the specific force (3, F) at the rotors' centre, body axes.
    """
    q, w, speed = x[Q], x[W], x[SPEED]
    rotation = rotation_of(q)
    body_velocity = turn_back(rotation, x[V])
    if "convergence" in p.on:  # the airspeed
        body_velocity = body_velocity + turn_back(rotation, p.convergence * x[P] * np.array([[1.0], [1.0], [0.0]]))
    extra = len(x) > PLAIN_ROWS
    speed_rate, esc_rate, lag_rate = motor_rates(
        p, held.gain, command, speed, x[ESC] if extra else None, x[LAGGED] if extra else None
    )
    force, moment = rotor_wrench(p, x[2], rotation, body_velocity, w, speed, speed_rate)
    if "wake" in p.on:
        _add_wake(p, x[P], rotation, held.past, force, moment)
    rates = np.zeros_like(x)
    if "body_drag" in p.on:
        square = (body_velocity**2).sum(0)
        size = np.sqrt(square + 1e-12)
        force -= p.body_drag * body_velocity * (size + p.body_drag_cross * body_velocity[2] ** 2 / (size + 0.1))
    if "wash" in p.on:
        force_free = p.wash * w[2] / (1 + (body_velocity[0] ** 2 + body_velocity[1] ** 2) / 16.0)
        moment[0] += force_free * body_velocity[0]
        moment[1] += force_free * body_velocity[1]
    if "pairs" in p.on:
        moment[0] += p.pairs[0] * (speed[0] - speed[2]) ** 2
        moment[1] += p.pairs[1] * (speed[1] - speed[3]) ** 2
    if "spin_torque" in p.on:
        angle = p.spin_frequency * time + held.phase
        moment[0] += p.spin_torque * np.cos(angle)
        moment[1] += p.spin_torque * np.sin(angle)
    if "flex" in p.on:
        bend, bend_rate = x[FLEX]
        pull = p.flex_frequency**2 * bend + 2 * p.flex_damping * p.flex_frequency * bend_rate
        moment[1] += p.flex * pull
        rates[31], rates[32] = bend_rate, -pull
    world = held.push * p.mass
    if p.on & WORLD_EFFECTS:
        world = world + _world_force(p, x, held, rates)
    force += turn_back(rotation, world)
    has_cog = "cog" in p.on
    if has_cog:
        moment -= cross(p.cog, force)
    rate = turn(p.inverse_inertia, moment - cross(w, turn(p.inertia, w))) + held.twist
    specific = force * p.inverse_mass
    if has_cog:
        specific -= cross(rate, p.cog) + cross(w, cross(w, p.cog))
    rates[P] = x[V]
    rates[V] = turn(rotation, specific)
    rates[5] -= c.GRAVITY
    rates[6] = -0.5 * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2])
    rates[7:10] = 0.5 * (q[0] * w + cross(q[1:], w))
    rates[W], rates[SPEED] = rate, speed_rate
    if extra:
        if esc_rate is not None:
            rates[ESC] = esc_rate
        if lag_rate is not None:
            rates[LAGGED] = lag_rate
        if "flex" in p.on:
            rates[32] -= rate[1]
    return rates, specific


def _add_wake(p, position, rotation, past, force, moment):
    """Add the push of the other drone's wake on each hub, a turbulent jet with the momentum of that drone's thrust.

    The profile is that measured by Bauersfeld et al. (2025).
    """
    early, late = np.zeros(position.shape[1]), np.full(position.shape[1], LONGEST_WAKE)
    there, axis, thrust = past(early)
    for _ in range(9):  # bisection: the age of the air that is here now, which slows down as the wake widens
        age = 0.5 * (early + late)
        there, axis, thrust = past(age)
        below = np.maximum(-((position - there) * axis).sum(0), 0.0)
        pace = p.wake_pace * np.maximum(_flow(thrust), 1e-3)
        older = below * (p.wake_width + 0.5 * p.wake_growth * below) > pace * age
        early, late = np.where(older, age, early), np.where(older, late, age)
    for rotor in range(4):
        x, y = c.ROTOR_X[rotor], c.ROTOR_Y[rotor]
        away = position + rotation[:, 0] * x + rotation[:, 1] * y - there
        below = np.maximum(-(away * axis).sum(0), 0.0)
        beside2 = (away**2).sum(0) - (away * axis).sum(0) ** 2
        half = p.wake_width + p.wake_growth * below
        speed = _flow(thrust) / half / (1 + 0.4142 * beside2 / half**2) ** 2 * (1 - np.exp(-below / WAKE_BEGINS))
        push = turn_back(rotation, -axis * (0.25 * p.wake * speed**2))
        force += push
        moment[0] += y * push[2]
        moment[1] -= x * push[2]
        moment[2] += x * push[1] - y * push[0]


def _flow(thrust):
    """Speed on the axis of a jet with this thrust, times its half width, m^2/s."""
    return np.sqrt(thrust / (c.AIR_DENSITY * np.pi * WAKE_MOMENTUM))


def _world_force(p, x, held, rates):
    """Forces in world axes (3, F), N; writes the derivatives of the bob into ``rates``."""
    force = np.zeros((3, x.shape[1]))
    if "wind" in p.on:
        profile = np.maximum(x[2], 0.02) ** p.shear  # slower near the floor
        force[:2] += profile * (p.wind + held.gust)
    if "tether" in p.on:
        away = x[P] - p.tether_point
        force -= p.tether * away / np.sqrt(1 + (away**2).sum(0) / 16.0)
    if "wall" in p.on:
        # Attraction to a wall in front; grows towards the wall and saturates at it.
        gap = np.logaddexp(0.0, 4.0 * (p.wall_x - x[0])) / 4.0
        force[0] += p.wall * np.exp(-gap / p.wall_depth)
    if "bob_mass" in p.on:
        has = p.bob_mass > 0
        mass = np.where(has, p.bob_mass, 1.0)
        length = np.sqrt((x[BOB] ** 2).sum(0))
        along = x[BOB] / length
        relative = x[BOB_V] - x[V]
        reduced = mass * p.mass / (mass + p.mass)
        stretch = length - p.bob_length
        pull = reduced * (STRING_RATE**2 * stretch + 2 * STRING_DAMPING * STRING_RATE * (along * relative).sum(0))
        pull = np.where(has, np.maximum(pull, 0.0), 0.0)  # a string cannot push
        force += pull * along
        rates[BOB] = relative * has
        rates[BOB_V] = (-(pull / mass) * along - 0.1 * x[BOB_V]) * has
        rates[30] -= c.GRAVITY * has
    return force


def advance(p: SimpleNamespace, x: np.ndarray, command: np.ndarray, held: SimpleNamespace, time: float, step: float):
    """Take one classical RK4 step; return the new state and the accelerometer reading at the start of the step."""
    k1, specific = derivative(p, x, command, held, time)
    k2, _ = derivative(p, x + 0.5 * step * k1, command, held, time + 0.5 * step)
    k3, _ = derivative(p, x + 0.5 * step * k2, command, held, time + 0.5 * step)
    k4, _ = derivative(p, x + step * k3, command, held, time + step)
    k2 += k3
    k1 += k4
    k1 += 2 * k2
    x = x + step / 6 * k1
    x[Q] /= np.sqrt((x[Q] ** 2).sum(0))
    return x, specific
