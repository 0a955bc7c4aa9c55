"""Time steps of the body: leapfrog with an exactly rotating free body, MuJoCo's semi-implicit Euler, and classical RK4.

All take accelerations as functions of (state, stage), where the stage says at which point of the rotors' path the
loads are evaluated: 0 start, 1 middle, 2 end.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx

from cfb_mjx.model.state import Components
from cfb_mjx.model.vector import Vec, exponential, multiply, renormalise

START, MIDDLE, END = 0, 1, 2
Accelerations = Callable[..., tuple[Vec, Vec]]
"""(state, stage, gyroscopic=True) to linear (world) and angular (body) acceleration. ``gyroscopic`` False leaves out
what the angular velocity of a free body does by itself, -J^-1 (omega x J omega)."""


def leapfrog(accelerations: Accelerations, state: Components, dt, inertia: Vec) -> Components:
    """Half a step of free motion, the loads' kick, half a step of free motion: second order, one evaluation of loads.

    Free rotation is split into rotations about the principal axes, each of which is solved exactly (S. Reich, Momentum
    conserving symplectic integrators, Physica D 76, 1994; A. Dullweber, B. Leimkuhler, R. McLachlan, J. Chem. Phys.
    107, 1997). Rotations are exact in length whatever the rate, so the angular momentum of a free body is kept to
    rounding, its energy errs by a bounded, small amount (docs/accuracy.md), and no rate makes the step unstable.
    The axes are taken in the order x, z, y: with the drone's inertias (z largest) this errs least.

    Forces that depend on velocity see the velocity before the kick.
    """
    half, inverse = 0.5 * dt, inertia.map(lambda x: 1 / x)
    quaternion, momentum = state.quaternion, state.body_rate * inertia
    for axis in _AXES:
        quaternion, momentum = _turned(quaternion, momentum, axis, half * inverse[axis])
    position = state.position + state.velocity * half
    at = Components(
        position, state.velocity, renormalise(quaternion), momentum * inverse, state.rotor_speed, state.memory
    )
    linear, angular = accelerations(at, MIDDLE, gyroscopic=False)
    velocity = state.velocity + linear * dt
    quaternion, momentum = at.quaternion, momentum + angular * inertia * dt
    for axis in reversed(_AXES):
        quaternion, momentum = _turned(quaternion, momentum, axis, half * inverse[axis])
    return Components(
        position + velocity * half,
        velocity,
        renormalise(quaternion),
        momentum * inverse,
        state.rotor_speed,
        state.memory,
    )


_AXES = (0, 2, 1)


def _turned(quaternion: Vec, momentum: Vec, axis: int, step) -> tuple[Vec, Vec]:
    """Free rotation about one principal axis alone for ``step`` = seconds / moment of inertia.

    The quaternion is not normalised: its factor is 1 + tan(angle / 2) e_axis, and the momentum's is the rational form
    of the same rotation. A tangent that is a little off is a little less angle, never a change of length.
    """
    j, k = (axis + 1) % 3, (axis + 2) % 3
    h = momentum[axis] * (0.5 * step)
    square = h * h
    tangent = h * (1 + square * (1 / 3))
    sine = 2 * tangent / (1 + tangent * tangent)
    mj, mk = momentum[j], momentum[k]
    turned = [momentum[axis]] * 3
    turned[j] = mj + sine * (mk - tangent * mj)
    turned[k] = mk - sine * (mj + tangent * mk)
    q = quaternion
    factor = [q[0] - tangent * q[axis + 1]] * 4
    factor[axis + 1] = q[axis + 1] + tangent * q[0]
    factor[j + 1] = q[j + 1] + tangent * q[k + 1]
    factor[k + 1] = q[k + 1] - tangent * q[j + 1]
    return Vec(*factor), Vec(*turned)


def euler(accelerations: Accelerations, state: Components, dt, inertia: Vec) -> Components:
    """Velocities from accelerations at the start, positions from the new velocities: MuJoCo's Euler, first order.

    Its global error in position is about dt/2 x velocity change (docs/accuracy.md has the numbers).
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

    MuJoCo's own RK4 composes rotations without the commutator terms and holds applied forces over the step; this one
    evaluates rotors and effects at every stage.
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
