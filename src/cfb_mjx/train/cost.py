"""Costs for back-propagation: the aims of the paper's rewards, with a slope that does not vanish near the optimum.

In all of them s(x, w) = sqrt(|x|^2 + w^2) - w, a norm rounded within w. All costs are per control step.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.envs.flip import deviations
from cfb_mjx.envs.observation import rotation_matrix
from cfb_mjx.model.state import AnyArray, State


@dataclass(frozen=True)
class SmoothCost:
    """Cost of flying to a target.

    ``position`` s(p, width) + ``velocity`` s(v, width) + ``heading`` (1 - R_xx) + ``body_rate`` |omega|^2 +
    ``command_change`` |u_k - u_(k-1)|^2; a failed drone costs ``failure`` per step. Summed over a flight, s(v, w) is
    nearly the length of the path: it does not penalise a fast approach, but it does penalise swinging about the target.
    """

    position: float = 1.0
    position_width_m: float = 0.05
    velocity: float = 0.1
    velocity_width_mps: float = 0.1
    heading: float = 0.2
    body_rate: float = 0.002
    command_change: float = 20.0
    failure: float = 5.0

    def __call__(
        self,
        state: State,
        target: Float[Array, "3"],
        setpoint: Float[Array, " setpoints"],
        command: Float[Array, "4"],
        last: Float[Array, "4"],
    ) -> Float[Array, ""]:
        """Cost of a control step that ended in ``state`` after ``command``; ``last`` is the command before it.

        For a moving target the velocity of ``state`` is relative to the target's.
        """
        attitude = rotation_matrix(state.quaternion)
        return (
            self.position * rounded(state.position - target, self.position_width_m)
            + self.velocity * rounded(state.velocity, self.velocity_width_mps)
            + self.heading * (1 - attitude[0, 0])
            + self.body_rate * jnp.sum(state.body_rate**2)
            + self.command_change * jnp.sum((command - last) ** 2)
        )


@dataclass(frozen=True)
class FlipCost:
    """Cost of a flip: the slopes of the paper's reward, with rounded kinks.

    ``velocity`` s(R^T v - [0, 0, v_target], width) + ``axis`` s(R e_x - e_x, width) + ``body_rate`` s(omega -
    [rate_target, 0, 0], width) + ``command_change`` |u_k - u_(k-1)|^2; a failed drone costs ``failure`` per step.
    """

    velocity: float = 0.03
    velocity_width_mps: float = 0.5
    axis: float = 0.05
    axis_width: float = 0.1
    body_rate: float = 0.05
    body_rate_width_radps: float = 0.5
    command_change: float = 0.2
    failure: float = 5.0

    def __call__(
        self,
        state: State,
        target: Float[Array, "3"],
        setpoint: Float[Array, "2"],
        command: Float[Array, "4"],
        last: Float[Array, "4"],
    ) -> Float[Array, ""]:
        """Cost of a control step that ended in ``state`` after ``command``; ``last`` is the command before it."""
        velocity, axis, body_rate = deviations(state, setpoint)
        return (
            self.velocity * rounded(velocity, self.velocity_width_mps)
            + self.axis * rounded(axis, self.axis_width)
            + self.body_rate * rounded(body_rate, self.body_rate_width_radps)
            + self.command_change * jnp.sum((command - last) ** 2)
        )


def rounded(x: Float[AnyArray, "3"], width: float) -> Float[Array, ""]:
    """s(x, width): a norm rounded within ``width``."""
    return jnp.sqrt(jnp.sum(x**2) + width**2) - width
