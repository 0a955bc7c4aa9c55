"""Integrators of the body: leapfrog with Euler's equations to order 4, MuJoCo's semi-implicit Euler, classical RK4.

All take the accelerations as a function of (state, stage). The stage selects the point of the rotors' path at which the
loads are evaluated: 0 start, 1 middle, 2 end.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx

from cfb_mjx.model.state import Components
from cfb_mjx.model.vector import Vec, exponential, multiply, renormalise

START, MIDDLE, END = 0, 1, 2
Accelerations = Callable[..., tuple[Vec, Vec]]
"""Function of (state, stage, gyroscopic=True) that returns linear (world) and angular (body) acceleration. With
``gyroscopic`` False the angular acceleration of a free body, -J^-1 (omega x J omega), is left out."""


def leapfrog(accelerations: Accelerations, state: Components, dt, inertia: Vec) -> Components:
    """Half a step of drift, a kick by the loads, half a step of drift; rotation by Euler's equations. Second order.

    The loads are evaluated once, in the middle of the step. Under their torque, constant in body axes, the angular
    velocity follows Euler's equations by a Runge-Kutta method of order 4: the energy error of a free body grows with
    the sixth power of the angle turned per step (docs/accuracy.md). The attitude follows by one rotation, the Magnus
    series to order 4 (A. Iserles, S. P. Norsett, On the solution of linear differential equations in Lie groups, Phil.
    Trans. R. Soc. A 357, 1999).

    Forces that depend on velocity or angular velocity are evaluated with the values before the kick.
    """
    half, omega = 0.5 * dt, state.body_rate
    position = state.position + state.velocity * half
    factor = _factor(omega * (0.5 * half))
    # One Newton step for the length: the square of the factor is 1 + |half angle|^2, and the angle is small.
    middle = multiply(state.quaternion, factor) * (1.5 - 0.5 * factor.dot(factor))
    at = Components(position, state.velocity, middle, omega, state.rotor_speed, state.memory)
    linear, angular = accelerations(at, MIDDLE, gyroscopic=False)
    velocity = state.velocity + linear * dt

    (jx, jy, jz), inverse = inertia, inertia.map(lambda x: 1 / x)
    ratio = Vec(jy - jz, jz - jx, jx - jy) * inverse

    def turning(w: Vec) -> Vec:
        x, y, z = w
        return ratio * Vec(y * z, z * x, x * y) + angular

    first = turning(omega)
    second = turning(omega + first * half)
    third = turning(omega + second * half)
    last = turning(omega + third * dt)
    body_rate = omega + (first + last + 2 * (second + third)) * (dt / 6)
    turned = (omega + (first + second + third) * (dt / 6)) * half + omega.cross(body_rate) * (dt * dt / 24)
    square = turned.dot(turned)
    factor = _factor(turned * (1 + square * (1 / 3 + square * (2 / 15))))
    return Components(
        position + velocity * half,
        velocity,
        renormalise(multiply(state.quaternion, factor)),
        body_rate,
        state.rotor_speed,
        state.memory,
    )


def _factor(tangent: Vec) -> Vec:
    """Quaternion, not normalised, of the rotation whose half angle has this tangent along its axis."""
    return Vec(1.0, *tangent)


def euler(accelerations: Accelerations, state: Components, dt, inertia: Vec) -> Components:
    """Velocities from accelerations at the start, positions from the new velocities (MuJoCo's Euler). First order.

    The global error in position is about dt/2 x velocity change (docs/accuracy.md has the numbers).
    """
    linear, angular = accelerations(state, START)
    velocity = state.velocity + linear * dt
    body_rate = state.body_rate + angular * dt
    return Components(
        position=state.position + velocity * dt,
        velocity=velocity,
        quaternion=renormalise(multiply(state.quaternion, exponential(body_rate * (0.5 * dt)))),
        body_rate=body_rate,
        rotor_speed=state.rotor_speed,
        memory=state.memory,
    )


class _Rates(eqx.Module):
    position: Vec
    velocity: Vec
    quaternion: Vec
    body_rate: Vec


def runge_kutta(accelerations: Accelerations, state: Components, dt, inertia: Vec) -> Components:
    """Classical RK4 on (p, v, q, omega) with q' = q (x) [0, omega] / 2, renormalised once per step; fourth order.

    Rotors and effects are evaluated at every stage. MuJoCo's own RK4 instead composes rotations without the commutator
    terms and holds applied forces over the step.
    """

    def rates(at: Components, stage: int) -> _Rates:
        linear, angular = accelerations(at, stage)
        zero = 0.0 * at.body_rate[0]
        return _Rates(at.velocity, linear, multiply(at.quaternion, Vec(zero, *at.body_rate)) * 0.5, angular)

    def moved(by: _Rates, step) -> Components:
        return Components(
            state.position + by.position * step,
            state.velocity + by.velocity * step,
            state.quaternion + by.quaternion * step,
            state.body_rate + by.body_rate * step,
            state.rotor_speed,
            state.memory,
        )

    k1 = rates(state, START)
    k2 = rates(moved(k1, 0.5 * dt), MIDDLE)
    k3 = rates(moved(k2, 0.5 * dt), MIDDLE)
    k4 = rates(moved(k3, dt), END)

    def combine(name: str) -> Vec:
        a, b, c, d = (getattr(k, name) for k in (k1, k2, k3, k4))
        return getattr(state, name) + (a + 2 * (b + c) + d) * (dt / 6)

    return Components(
        position=combine("position"),
        velocity=combine("velocity"),
        quaternion=renormalise(combine("quaternion")),
        body_rate=combine("body_rate"),
        rotor_speed=state.rotor_speed,
        memory=state.memory,
    )


INTEGRATORS = {"leapfrog": leapfrog, "euler": euler, "rk4": runge_kutta}
