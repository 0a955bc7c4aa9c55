"""The task of flying to a target and holding it (paper section V)."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.envs.reward import TargetReward, length
from cfb_mjx.envs.starts import Starts, draw
from cfb_mjx.envs.task import Task
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State
from cfb_mjx.parameters import Parameters


@dataclass(frozen=True)
class TargetTask(Task):
    """The paper's first task: fly to the target. It has no set-points."""

    reward: TargetReward = field(default_factory=TargetReward)
    starts: Starts = field(default_factory=Starts)

    @property
    def largest_reward(self) -> float:
        """Reward of a step at rest at the target."""
        return self.reward.largest

    def draw_start(self, model: Quadrotor, target: Float[Array, "3"], setpoint: Array, key: PRNGKeyArray) -> State:
        """Draw an initial state from ``starts``."""
        return draw(self.starts, model, target, key)

    def judge(
        self, state: State, target: Float[Array, "3"], setpoint: Array, command: Array, parameters: Parameters
    ) -> Float[Array, ""]:
        """Reward of the state from ``reward``."""
        return self.reward(state, target, command, parameters)

    def failed(self, state: State) -> Bool[Array, ""]:
        """Whether speed or body rate exceed their limits."""
        return self.reward.failed(state)

    @property
    def diverged_reward(self) -> float:
        """Reward of the paper for a failure."""
        return -self.reward.failure

    def errors(self, state: State, target: Float[Array, "3"], setpoint: Array) -> Float[Array, "3"]:
        """Errors of position, velocity and body rate."""
        rate = length(state.body_rate) / 10
        return jnp.stack([length(state.position - target), length(state.velocity), rate])
