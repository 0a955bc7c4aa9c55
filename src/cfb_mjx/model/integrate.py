"""Time steps of the body: MuJoCo's semi-implicit Euler, and classical Runge-Kutta of order 4.

Both take accelerations as functions of (state, stage), where the stage says at which point of the rotors' path the
loads are evaluated: 0 start, 1 middle, 2 end.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx

from cfb_mjx.model.state import Components
from cfb_mjx.model.vector import Vec, exponential, multiply, renormalise

START, MIDDLE, END = 0, 1, 2
Accelerations = Callable[[Components, int], tuple[Vec, Vec]]


def euler(accelerations: Accelerations, state: Components, dt) -> Components:
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


def runge_kutta(accelerations: Accelerations, state: Components, dt) -> Components:
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


INTEGRATORS = {"euler": euler, "rk4": runge_kutta}
