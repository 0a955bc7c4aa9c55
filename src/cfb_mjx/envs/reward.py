"""Reward of flying to a target, limits that end an episode, and the functions that rewards are made of."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cfb_mjx.model.rotors import TORQUE_SIGNS, thrust
from cfb_mjx.model.state import AnyArray, State
from cfb_mjx.parameters import Parameters


def triangle(error: Float[Array, ""], largest: float) -> Float[Array, ""]:
    """Lambda(e, e_max) = relu(1 - |e / e_max|): one at zero error, zero from ``largest`` on (paper section V)."""
    return jnp.maximum(0.0, 1.0 - jnp.abs(error / largest))


@dataclass(frozen=True)
class TargetReward:
    """Reward per control step with the paper's widths (section V), other weights, and an additional term ``near``.

    `PAPER_REWARD` is the reward as printed. "L u" of the paper is read as the roll and pitch torque of the command once
    the rotors have followed it, L f(K u), because its width is given in N m and u itself has no unit.
    """

    position: float = 10.0
    position_width_m: float = 10.0
    near: float = 3.0
    """Weight of a bell-shaped term, largest at rest at the target:

        1 / (1 + |p / near_width|^2 + |v / near_speed|^2 + |(q - 1) / near_attitude|^2)

    The paper's position term falls by 0.1 per metre, so a decimetre is worth less than a learner's noise. This term
    falls by up to 2.6 x near per metre and has no kink that would reward the largest gain. It also distinguishes a
    swinging drone from one at rest: at half of ``near_speed`` a fifth of it is lost.
    """
    near_width_m: float = 0.25
    near_speed_mps: float = 0.4
    near_attitude: float = 0.5
    velocity: float = 0.05
    velocity_width_mps: float = 10.0
    attitude: float = 0.15
    attitude_width: float = 2.0
    """Width of |q - [1, 0, 0, 0]|, taken with the sign of q that is nearer."""
    body_rate: float = 2.0
    body_rate_width_radps: float = 30.0
    torque: float = 0.1
    torque_width_nm: float = 0.01
    failure: float = 300.0
    """Penalty in the step in which an episode fails."""
    speed_limit_mps: float = 10.0
    rate_limit_radps: float = 30.0

    @property
    def largest(self) -> float:
        """Reward of a step at rest at the target."""
        return self.position + self.near + self.velocity + self.attitude + self.body_rate + self.torque

    def failed(self, state: State) -> Bool[Array, ""]:
        """Whether speed or body rate exceed their limits."""
        return too_fast(state, self.speed_limit_mps, self.rate_limit_radps)

    def __call__(
        self, state: State, target: Float[Array, "3"], command: Float[Array, "4"], parameters: Parameters
    ) -> Float[Array, ""]:
        """Reward of the true ``state`` (not its estimate) after ``command`` [0 to 1]."""
        offset = state.position - target
        turned = 2.0 * jnp.maximum(0.0, 1.0 - jnp.abs(state.quaternion[0]))
        apart = jnp.sum((offset / self.near_width_m) ** 2) + jnp.sum((state.velocity / self.near_speed_mps) ** 2)
        apart += turned / self.near_attitude**2
        reward = (
            self.position * triangle(length(offset), self.position_width_m)
            + self.near / (1.0 + apart)
            + self.velocity * triangle(length(state.velocity), self.velocity_width_mps)
            + self.attitude * triangle(jnp.sqrt(turned + 1e-12), self.attitude_width)
            + self.body_rate * triangle(length(state.body_rate), self.body_rate_width_radps)
            + self.torque * triangle(length(commanded_torque(parameters, command)), self.torque_width_nm)
        )
        return reward - self.failure * self.failed(state)


PAPER_REWARD = TargetReward(position=1.0, near=0.0, body_rate=0.15, body_rate_width_radps=10.0, torque=0.02)


def too_fast(state: State, speed_limit_mps: float, rate_limit_radps: float) -> Bool[Array, ""]:
    """Whether speed or body rate exceed their limits."""
    fast = jnp.sum(state.velocity**2) > speed_limit_mps**2
    return fast | (jnp.sum(state.body_rate**2) > rate_limit_radps**2)


def commanded_torque(parameters: Parameters, command: Float[Array, "4"]) -> Float[Array, "2"]:
    """Roll and pitch torque L f(K u) of rotors that have settled at ``command``, N m (paper eqs. 5, 6 and 8)."""
    settled = thrust(parameters, parameters.motor_gain * command + parameters.motor_speed_offset)
    return parameters.rotor_spacing / 2 * (jnp.asarray(TORQUE_SIGNS[:2], settled.dtype) @ settled)


def length(vector: Float[AnyArray, " n"]) -> Float[Array, ""]:
    """Euclidean norm with a finite derivative at zero."""
    return jnp.sqrt(jnp.sum(vector * vector) + 1e-12)
