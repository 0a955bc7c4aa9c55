"""Tasks for other libraries of reinforcement learning: Gymnasium environments, one drone or many.

    import cfb_mjx.envs.gym  # registers them

    env = gymnasium.make("cfb_mjx/Target-v0", model="cfb")
    envs = gymnasium.make_vec("cfb_mjx/Flip-v0", num_envs=512, autoreset_mode="NextStep")

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
from jaxtyping import Array

from cfb_mjx.envs.episode import Episode, Outcome, Task, choose, observe, reset, step, with_room
from cfb_mjx.envs.flip import FlipTask
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


# Compiled once for all environments of a task, however many a process has.
@partial(jax.jit, static_argnums=0)
def _draw(task: Task, nominal: Quadrotor, keys: Array) -> tuple[Array, Episode]:
    """Keys of what comes after, and the next episode of every drone."""
    keys, own = jax.vmap(jax.random.split, out_axes=1)(keys)
    return keys, jax.vmap(partial(reset, task, nominal))(own)


@partial(jax.jit, static_argnums=0)
def _fly(task: Task, episodes: Episode, actions: Array) -> tuple[Episode, Outcome, tuple[Array, dict[str, Any]]]:
    after, outcome = jax.vmap(partial(step, task))(episodes, 0.5 * (1 + actions))
    return after, outcome, _show(task, after)


@partial(jax.jit, static_argnums=0)
def _begin(task: Task, which: Array, waiting: Episode, episodes: Episode) -> tuple[Episode, tuple[Array, dict]]:
    """Begin the episodes that wait."""
    begun = choose(which, waiting, episodes)
    return begun, _show(task, begun)


def _show(task: Task, episodes: Episode) -> tuple[Array, dict[str, Any]]:
    """What the controllers see, and what they do not."""
    return jax.vmap(partial(observe, task))(episodes), jax.vmap(_truth)(episodes)


_choose = jax.jit(choose)


class TargetVectorEnv(VectorEnv):
    """Many drones at once, one compiled step for all; every episode is on another drone.

    Info has an array with one row for each drone under each name. Where episodes begin anew in the step in which they
    end, ``final_obs`` and ``final_info`` hold what the ended ones came to (masks ``_final_obs``, ``_final_info``).

    Args:
        num_envs: number of drones.
        task: what to fly, a `FlipTask` too; by default to the target, on the nominal drone.
        model: preset or model YAML, or the drone itself.
        autoreset_mode: when ended episodes begin anew. Some of Gymnasium's wrappers, `NormalizeObservation` for
            one, need ``NEXT_STEP``. With ``DISABLED``, ``reset(options={"reset_mask": ended})`` begins them.

    Raises:
        CfbError: no such model or mode, a control step that is no multiple of the drone's, or ranges that allow drones
            that cannot be.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: Task | None = None,
        model: str | Quadrotor = "cfb-guards",
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ):
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(mode.value for mode in AutoresetMode)
            raise CfbError(f"autoreset_mode must be one of {modes}, found {autoreset_mode!r}.") from None
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.task = TargetTask() if task is None else task
        self.num_envs = num_envs
        self.render_mode = None
        self.single_observation_space, self.single_action_space = _spaces(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._keys = self._episodes = None
        self._over = np.zeros(num_envs, bool)
        # Gymnasium tells the parent of what a reset raises, not of what this does.
        if _cut_off:
            return
        self.nominal = model if isinstance(model, Quadrotor) else Quadrotor.from_file(model)
        self.task.hold(self.nominal)
        if self.task.randomisation is not None:
            require_possible(self.nominal, self.task.randomisation, self.task.magnitude)
        self.task = with_room(self.task, self.nominal)

    def reset(self, *, seed: Any = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin all episodes, or those of a mask.

        Args:
            seed: one for all drones (others share nothing with it), or a list with one for each, as `TargetEnv` takes
                it. It decides all episodes of a drone from then on. Without one (None) drones go on; the first time
                they get one of their own.
            options: ``reset_mask`` says which to begin, (num_envs,) booleans.

        Raises:
            CfbError: seeds or a mask that are something else, or nothing has begun yet and not all are to.
        """
        _require_jax()
        who = type(self).__name__
        which = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if which.dtype != bool or which.shape != (self.num_envs,):
            raise CfbError(f"{who}: reset_mask must be {self.num_envs} booleans.")
        each = isinstance(seed, list | tuple)
        seeds = list(seed) if each else [seed]
        fine = all(s is None or (_whole(s) and 0 <= s < 2**32) for s in seeds)
        if not fine or (each and len(seeds) != self.num_envs):
            raise CfbError(
                f"{who}: seed must be one whole number from 0 to 2**32 - 1, or a list with one for each of the "
                f"{self.num_envs} drones, found {seed!r}."
            )
        super().reset(seed=next((int(s) for s in seeds if s is not None), None))
        if self._keys is None:
            if not which.all():
                raise NotReset(f"{who}: the first reset has to begin all episodes.")
            seeds = [int(self.np_random.integers(2**32)) if s is None else s for s in seeds]
        given = np.array([s is not None for s in seeds])
        if given.any():
            keys = jax.vmap(jax.random.PRNGKey)(np.array([s or 0 for s in seeds], np.uint32))
            if not each:
                given, keys = np.ones(self.num_envs, bool), jax.random.split(keys[0], self.num_envs)
            if self._keys is None:
                self._keys, self._waiting = _draw(self.task, self.nominal, keys)
                self._episodes, self._taken = self._waiting, np.zeros(self.num_envs, bool)
            else:
                self._keys, self._taken = _choose(given, keys, self._keys), self._taken | given
        seen, truth = self._begin(which)
        return np.asarray(seen, np.float32), _shown(truth, which)

    @property
    def waits(self) -> bool:
        """Whether nothing has begun, or an episode has ended that only `reset` begins anew."""
        return self._episodes is None or (self.autoreset_mode == AutoresetMode.DISABLED and bool(self._over.any()))

    def _begin(self, which: np.ndarray) -> tuple[Array, dict[str, Any]]:
        """Begin the episodes that wait; what is seen of all. Drawing costs as much as flying: all that are taken are
        drawn anew at once, when one of them is needed again. Which episodes a drone flies, its own key alone decides.
        """
        if (which & self._taken).any():
            drawn = _draw(self.task, self.nominal, self._keys)
            self._keys, self._waiting = _choose(self._taken, drawn, (self._keys, self._waiting))
            self._taken = np.zeros(self.num_envs, bool)
        self._episodes, shown = _begin(self.task, which, self._waiting, self._episodes)
        self._taken, self._over = self._taken | which, self._over & ~which
        return shown

    def step(self, actions: Any):
        """Observations, rewards, whether failed, whether timed out, and the info.

        Raises:
            CfbError: no reset came before, or is due; actions of another shape or that are not finite.
        """
        _require_jax()
        who, anew = type(self).__name__, self._over
        if self.waits:
            over = f" ({anew.sum()} episodes are over)" if anew.any() else ""
            raise NotReset(f"{who}: call reset before step{over}.")
        actions = _checked(actions, (self.num_envs, 4), who)
        self._episodes, outcome, shown = _fly(self.task, self._episodes, actions)
        # Where the last step ended an episode, this one begins the next: the action there counts for nothing.
        failed = np.asarray(outcome.failed) & ~anew
        timed_out = np.asarray(outcome.timed_out) & ~anew & ~failed
        reward = np.where(anew, 0.0, np.asarray(outcome.reward, np.float64))
        why = {}
        if failed.any():
            reasons = np.where(np.asarray(outcome.diverged), DIVERGED, FAST)
            why = {"failure": np.where(failed, reasons, np.array(None, object)), "_failure": failed}
        over = failed | timed_out
        self._over, final = over, {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and over.any():
            final = {"final_obs": np.asarray(shown[0], np.float32), "final_info": _shown(shown[1], over) | why}
            final |= {f"_{name}": over for name in final}
            why, anew = {}, over
        if anew.any():
            shown = self._begin(anew)
        info = _shown(shown[1], np.ones(self.num_envs, bool)) | why | final
        return np.asarray(shown[0], np.float32), reward, failed, timed_out, info


def _whole(number: Any) -> bool:
    return isinstance(number, int | np.integer) and not isinstance(number, bool)


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
        self.many = TargetVectorEnv(1, task, model, AutoresetMode.DISABLED)
        self.observation_space, self.action_space = _spaces(self.many.task)
        self.render_mode = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; the same seed gives the same ones from then on."""
        super().reset(seed=seed)
        seen, info = self.many.reset(seed=[seed])
        return seen[0], _of_one(info)

    def step(self, action: Any):
        """Observation, reward, whether failed, whether timed out, info.

        Raises:
            CfbError: no reset came before or the episode is over, or an action of another shape or not finite.
        """
        if self.many.waits:
            raise NotReset("TargetEnv: the episode is over, or none has begun; call reset before step.")
        action = _checked(action, (4,), "TargetEnv")
        seen, reward, failed, timed_out, info = self.many.step(action[None])
        return seen[0], float(reward[0]), bool(failed[0]), bool(timed_out[0]), _of_one(info)


def _of_one(info: dict[str, Any]) -> dict[str, Any]:
    return {name: _of_one(x) if isinstance(x, dict) else x[0] for name, x in info.items() if not name.startswith("_")}


for _name, _task in (("Target", TargetTask()), ("Flip", FlipTask())):
    gymnasium.register(
        f"cfb_mjx/{_name}-v0",
        entry_point="cfb_mjx.envs.gym:TargetEnv",
        vector_entry_point="cfb_mjx.envs.gym:TargetVectorEnv",
        kwargs={"task": _task},
    )
