"""Tasks for other libraries of reinforcement learning: Gymnasium environments, one drone or many.

Needs the extra ``gymnasium``. Actions are 2 u - 1 in [-1, 1]; observations are those of `Layout`. The info of a reset
or step holds what the controller does not see: the true ``position`` (relative to the target), ``velocity``,
``quaternion``, ``body_rate`` and ``rotor_speed`` of the drone, SI, and its ``parameters``, a dictionary of arrays. Of
the step in which an episode fails it also says why (``failure``).
"""

from __future__ import annotations

import os
import sys
from functools import partial
from typing import Any

import jax
import numpy as np

from cfb_mjx.envs.episode import Episode, Task, choose, observe, reset, step
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.randomised import require_possible
from cfb_mjx.parameters import SPECIFICATIONS

try:
    import gymnasium
    from gymnasium.error import ResetNeeded
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError:
    raise CfbError("Gymnasium is not installed; pip install 'cfb_mjx[gymnasium]'.") from None


class NotReset(CfbError, ResetNeeded):
    """A step where only a reset makes sense."""


FAST, DIVERGED = "a limit of speed or body rate is passed", "the state is not finite any more"
"""What ``failure`` says."""

_cut_off = False
"""Whether this process was forked from one that had started JAX, whose threads a fork does not take along."""


def _after_fork() -> None:
    global _cut_off
    started = getattr(sys.modules.get("jax._src.xla_bridge"), "backends_are_initialized", lambda: True)
    _cut_off = _cut_off or started()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _require_jax() -> None:
    if _cut_off:
        raise CfbError(
            "This process was forked from one that uses JAX already, in which JAX would wait for ever; start it anew, "
            'AsyncVectorEnv with context="spawn", or fly many drones in one process: TargetVectorEnv.'
        )


def _spaces(task: Task) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    seen = gymnasium.spaces.Box(-np.inf, np.inf, (task.layout.size,), np.float32)
    return seen, gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)


def _truth(episode: Episode) -> dict[str, Any]:
    """What the controller does not see, of one episode or of many."""
    state, names = episode.state, SPECIFICATIONS
    return {
        "position": state.position - episode.target,
        "velocity": state.velocity,
        "quaternion": state.quaternion,
        "body_rate": state.body_rate,
        "rotor_speed": state.rotor_speed,
        "parameters": {name: getattr(episode.model.parameters, name) for name in names},
    }


class TargetVectorEnv(VectorEnv):
    """Many drones at once, one compiled step for all. Episodes that end begin anew in the same step, on another drone.

    Info has an array with one row for each drone under each name, and under ``final_obs`` and ``final_info`` what the
    ended episodes came to (masks ``_final_obs`` and ``_final_info``).

    Args:
        num_envs: number of drones.
        task: what to fly, a `FlipTask` too; by default to the target, on the nominal drone.
        model: preset or model YAML, or the drone itself.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 (Gymnasium's interface)

    def __init__(self, num_envs: int = 1, task: Task | None = None, model: str | Quadrotor = "cfb-guards"):
        self.task = TargetTask() if task is None else task
        self.num_envs = num_envs
        self.render_mode = None
        self.single_observation_space, self.single_action_space = _spaces(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._key = self._episodes = None
        # Gymnasium tells the parent of what a reset raises, not of what this does.
        if _cut_off:
            return
        self.nominal = model if isinstance(model, Quadrotor) else Quadrotor.from_file(model)
        self.task.hold(self.nominal)
        if self.task.randomisation is not None:
            require_possible(self.nominal, self.task.randomisation, self.task.magnitude)
        begin = jax.vmap(partial(reset, self.task, self.nominal))
        look, truth = jax.vmap(partial(observe, self.task)), jax.vmap(_truth)

        def begun(key):
            episodes = begin(jax.random.split(key, num_envs))
            return episodes, look(episodes), truth(episodes)

        def fly(episodes, actions, key):
            after, outcome = jax.vmap(partial(step, self.task))(episodes, 0.5 * (1 + actions))
            over = outcome.failed | outcome.timed_out
            kept = choose(over, begin(jax.random.split(key, num_envs)), after)
            return kept, outcome, (look(kept), truth(kept)), (look(after), truth(after))

        self._begin, self._fly = jax.jit(begun), jax.jit(fly)

    def reset(self, *, seed: Any = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin all episodes; the same seed gives the same drones, starts and noise, none gives ones of their own."""
        _require_jax()
        if not (seed is None or isinstance(seed, int | np.integer)):
            raise CfbError(f"{type(self).__name__}: seed must be one whole number for all drones, found {seed!r}.")
        super().reset(seed=seed)
        if seed is not None or self._key is None:
            self._key = jax.random.PRNGKey(int(self.np_random.integers(2**31)))
        self._episodes, seen, truth = self._begin(self._next_key())
        return np.asarray(seen, np.float32), _shown(truth, np.ones(self.num_envs, bool))

    def step(self, actions: Any):
        """Observations, rewards, whether failed, whether timed out, and the info.

        Raises:
            CfbError: no reset came before, or actions of another shape or that are not finite.
        """
        _require_jax()
        if self._episodes is None:
            raise NotReset(f"{type(self).__name__}: call reset before step.")
        actions = _checked(actions, (self.num_envs, 4), type(self).__name__)
        self._episodes, outcome, now, last = self._fly(self._episodes, actions, self._next_key())
        failed, timed_out = np.asarray(outcome.failed), np.asarray(outcome.timed_out)
        over = failed | timed_out
        info = _shown(now[1], np.ones(self.num_envs, bool))
        if over.any():
            ended = _shown(last[1], over)
            if failed.any():
                why = np.where(np.asarray(outcome.diverged), DIVERGED, FAST)
                ended |= {"failure": np.where(failed, why, None), "_failure": failed}
            info |= {"final_obs": np.asarray(last[0], np.float32), "_final_obs": over}
            info |= {"final_info": ended, "_final_info": over}
        return (
            np.asarray(now[0], np.float32),
            np.asarray(outcome.reward, np.float64),
            failed,
            timed_out & ~failed,
            info,
        )

    def _next_key(self):
        self._key, key = jax.random.split(self._key)
        return key


def _shown(truth: dict[str, Any], which: np.ndarray) -> dict[str, Any]:
    """As Gymnasium's vector environments do: beside each name a mask of the environments that have it."""
    shown = {name: _shown(x, which) if isinstance(x, dict) else np.asarray(x) for name, x in truth.items()}
    return shown | {f"_{name}": which for name in truth}


def _checked(actions: Any, shape: tuple[int, ...], who: str) -> np.ndarray:
    try:
        numbers = np.asarray(actions, float)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or numbers.shape != shape:
        found = "something else" if numbers is None else f"the shape {numbers.shape}"
        wanted = " x ".join(map(str, shape))
        raise CfbError(f"{who}: an action must be {wanted} numbers, 2 u - 1 of each motor, found {found}.")
    if not np.isfinite(numbers).all():
        bad = numbers if numbers.ndim == 1 else numbers[~np.isfinite(numbers).all(axis=1)][0]
        raise CfbError(f"{who}: an action must be finite, found {bad.tolist()}; what computed it has diverged.")
    return numbers


class TargetEnv(gymnasium.Env):
    """One drone; arguments as `TargetVectorEnv`. Episodes that end wait for ``reset``."""

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's interface)

    def __init__(self, task: Task | None = None, model: str | Quadrotor = "cfb-guards"):
        self.many = TargetVectorEnv(1, task, model)
        self.observation_space, self.action_space = _spaces(self.many.task)
        self.render_mode = None
        self._flying = False

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; the same seed gives the same ones from then on."""
        super().reset(seed=seed)
        seen, info = self.many.reset(seed=int(self.np_random.integers(2**31)))
        self._flying = True
        return seen[0], _of_one(info)

    def step(self, action: Any):
        """Observation, reward, whether failed, whether timed out, info.

        Raises:
            CfbError: no reset came before or the episode is over, or an action of another shape or not finite.
        """
        if not self._flying:
            raise NotReset("TargetEnv: the episode is over, or none has begun; call reset before step.")
        action = _checked(action, (4,), "TargetEnv")
        seen, reward, failed, timed_out, info = self.many.step(action[None])
        self._flying = not (failed[0] or timed_out[0])
        if not self._flying:
            seen, info = info["final_obs"], info["final_info"]
        return seen[0], float(reward[0]), bool(failed[0]), bool(timed_out[0]), _of_one(info)


def _of_one(info: dict[str, Any]) -> dict[str, Any]:
    return {name: _of_one(x) if isinstance(x, dict) else x[0] for name, x in info.items() if not name.startswith("_")}
