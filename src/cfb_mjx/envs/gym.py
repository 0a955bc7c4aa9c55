"""Tasks for other libraries of reinforcement learning: Gymnasium environments, one drone or many.

Needs the extra ``gymnasium``. Actions are 2 u - 1 in [-1, 1]; observations are those of `Layout`; the info of a step
holds what the controller does not see. Episodes that end begin anew in the same step, on a drone drawn anew.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.envs.episode import Task, choose, observe, reset, step
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.parameters import require_possible

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError:
    raise CfbError("Gymnasium is not installed; pip install 'cfb_mjx[gymnasium]'.") from None


def _spaces(task: Task) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    seen = gymnasium.spaces.Box(-np.inf, np.inf, (task.layout.size,), np.float32)
    return seen, gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)


class TargetVectorEnv(VectorEnv):
    """Many drones at once, one compiled step for all.

    Args:
        num_envs: number of drones.
        task: what to fly, a `FlipTask` too; by default to the target, on the nominal drone.
        model: preset or model YAML, or the drone itself.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 (Gymnasium's interface)

    def __init__(self, num_envs: int = 1, task: Task | None = None, model: str | Quadrotor = "cfb-guards"):
        self.task = TargetTask() if task is None else task
        self.nominal = model if isinstance(model, Quadrotor) else Quadrotor.from_file(model)
        self.task.hold(self.nominal)
        if self.task.randomisation is not None:
            require_possible(self.nominal.parameters, self.task.randomisation, self.task.magnitude)
        self.num_envs = num_envs
        self.render_mode = None
        self.single_observation_space, self.single_action_space = _spaces(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        begin = jax.vmap(partial(reset, self.task, self.nominal))
        look = jax.vmap(partial(observe, self.task))

        def fly(episodes, actions, key):
            after, outcome = jax.vmap(partial(step, self.task))(episodes, 0.5 * (1 + actions))
            over = outcome.failed | outcome.timed_out
            fresh = begin(jax.random.split(key, num_envs))
            kept = choose(over, fresh, after)
            return kept, look(kept), look(after), outcome

        self._begin = jax.jit(lambda key: (lambda e: (e, look(e)))(begin(jax.random.split(key, num_envs))))
        self._fly = jax.jit(fly)
        self._key = jax.random.PRNGKey(0)
        self._episodes = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin all episodes; the same seed gives the same drones, starts and noise."""
        super().reset(seed=seed)
        if seed is not None:
            self._key = jax.random.PRNGKey(seed)
        self._episodes, seen = self._begin(self._next_key())
        return np.asarray(seen, np.float32), {}

    def step(self, actions: np.ndarray):
        """Observations, rewards, whether failed, whether timed out, and the last observations of those that ended."""
        if self._episodes is None:
            raise CfbError("TargetVectorEnv: call reset before step.")
        actions = jnp.asarray(actions)
        self._episodes, seen, last, outcome = self._fly(self._episodes, actions, self._next_key())
        failed, timed_out = np.asarray(outcome.failed), np.asarray(outcome.timed_out)
        over = failed | timed_out
        info = {}
        if over.any():
            info = {"final_obs": np.asarray(last, np.float32), "_final_obs": over}
        return (
            np.asarray(seen, np.float32),
            np.asarray(outcome.reward, np.float64),
            failed,
            timed_out & ~failed,
            info,
        )

    def _next_key(self):
        self._key, key = jax.random.split(self._key)
        return key


class TargetEnv(gymnasium.Env):
    """One drone; arguments as `TargetVectorEnv`. Episodes that end wait for ``reset``."""

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's interface)

    def __init__(self, task: Task | None = None, model: str | Quadrotor = "cfb-guards"):
        self.many = TargetVectorEnv(1, task, model)
        self.observation_space, self.action_space = _spaces(self.many.task)
        self.render_mode = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        seen, info = self.many.reset(seed=seed)
        return seen[0], info

    def step(self, action: np.ndarray):
        """Observation, reward, whether failed, whether timed out, info."""
        seen, reward, failed, timed_out, info = self.many.step(np.asarray(action)[None])
        seen = info["final_obs"] if info else seen
        return seen[0], float(reward[0]), bool(failed[0]), bool(timed_out[0]), {}
