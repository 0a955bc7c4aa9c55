"""Gymnasium environments of the tasks, for other libraries of reinforcement learning; one drone or many.

    import cfb_mjx.envs.gym  # registers them

    env = gymnasium.make("cfb_mjx/Target-v0", model="cfb")
    envs = gymnasium.make_vec("cfb_mjx/Flip-v0", num_envs=512, autoreset_mode="NextStep")

Needs the extra ``gymnasium``. Actions are 2 u - 1 in [-1, 1]; observations are those of `Layout`. The info of a reset
or step holds what the controller does not see: the true ``position`` (relative to the target), ``velocity``,
``quaternion``, ``body_rate`` and ``rotor_speed`` of the drone, SI, and its ``parameters``, a dictionary of arrays. If
an episode fails in a step, the info also contains the reason (``failure``).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from cfb_mjx.envs.episode import Episode, choose, observe, reset, step
from cfb_mjx.envs.flip import FlipTask
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import Task, with_room
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.randomised import require_possible
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import SPECIFICATIONS

try:
    import gymnasium
    from gymnasium.error import ResetNeeded
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError:
    raise CfbError("Gymnasium is not installed; pip install 'cfb_mjx[gymnasium]'.") from None


class NotReset(CfbError, ResetNeeded):
    """A step at a time when only a reset is possible."""


FAST, DIVERGED = "a limit of speed or body rate is passed", "the state is not finite any more"
"""Values of ``failure``."""

_cut_off = False
"""Whether this process was forked from one that had started JAX, whose threads a fork does not copy."""


def _after_fork() -> None:
    global _cut_off
    started = getattr(sys.modules.get("jax._src.xla_bridge"), "backends_are_initialized", lambda: True)
    _cut_off = _cut_off or started()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _require_jax() -> None:
    if _cut_off:
        raise CfbError(
            "This process was forked from a process that already uses JAX; in it JAX would wait forever. Start it anew "
            '(AsyncVectorEnv with context="spawn"), or fly many drones in one process (TargetVectorEnv).'
        )


def _spaces(task: Task) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    seen = gymnasium.spaces.Box(-np.inf, np.inf, (task.layout.size,), np.float32)
    return seen, gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)


def _truth(episode: Episode) -> dict[str, Any]:
    """Values that the controller does not see, for one episode or many."""
    state, names = episode.state, SPECIFICATIONS
    return {
        "position": state.position - episode.target,
        "velocity": state.velocity,
        "quaternion": state.quaternion,
        "body_rate": state.body_rate,
        "rotor_speed": state.rotor_speed,
        "parameters": {name: getattr(episode.model.parameters, name) for name in names},
    }


@partial(jax.jit, static_argnums=0)
def _draw(task: Task, nominal: Quadrotor, keys: Array) -> tuple[Array, Episode]:
    """New keys, and the next episode of every drone."""
    keys, own = jax.vmap(jax.random.split, out_axes=1)(keys)
    return keys, jax.vmap(partial(reset, task, nominal))(own)


Leaves = list[Array]
"""The arrays of an `Episode`: jax hands over a list in half the time that it needs for the object."""


class _Programs(NamedTuple):
    """Compiled functions of the drones of an environment."""

    fly: Callable[[Leaves, Leaves, np.ndarray, np.ndarray, Any], tuple]
    """Fly actions. Then begin the waiting episodes, as far as they are ready, of drones whose time for it has come: in
    the same step or in the next. Returns the episodes, the outcome, what is seen before that if in the same, and
    what is seen then."""
    begin: Callable[[np.ndarray, Leaves, Leaves], tuple]
    """Begin the waiting episodes of some drones; also returns what is seen of all."""
    redraw: Callable[[Quadrotor, Array, Leaves, np.ndarray, np.ndarray, np.ndarray], tuple]
    """Draw again the waiting episodes of some drones: (nominal drone, keys, waiting episodes, which drones, their
    numbers, each drone's place among the numbers)."""


@lru_cache(maxsize=32)
def _programs(task: Task, mode: AutoresetMode, structure: Any) -> _Programs:
    """Programs for a task, compiled once in a process."""

    def fly(flying, waiting, ready, anew, actions):
        after, outcome = jax.vmap(partial(step, task))(structure.unflatten(flying), 0.5 * (1 + actions))
        begun = after
        if mode != AutoresetMode.DISABLED:
            now = anew if mode == AutoresetMode.NEXT_STEP else (outcome.failed | outcome.timed_out) & ~anew
            begun = choose(now & ready, structure.unflatten(waiting), after)
        shown = _show(task, begun)
        return jax.tree.leaves(begun), outcome, _show(task, after) if mode == AutoresetMode.SAME_STEP else shown, shown

    def begin(which, waiting, flying):
        begun = choose(which, structure.unflatten(waiting), structure.unflatten(flying))
        return jax.tree.leaves(begun), _show(task, begun)

    def redraw(nominal, keys, waiting, which, numbers, places):
        drawn = _draw(task, nominal, keys[numbers])
        drawn = jax.tree.map(lambda x: x[places], drawn)
        keys, waiting = choose(which, drawn, (keys, structure.unflatten(waiting)))
        return keys, jax.tree.leaves(waiting)

    return _Programs(*map(jax.jit, (fly, begin, redraw)))


def _show(task: Task, episodes: Episode) -> tuple[Array, dict[str, Any]]:
    """Observations of the controllers, and the values that they do not see."""
    return jax.vmap(partial(observe, task))(episodes), jax.vmap(_truth)(episodes)


_choose = jax.jit(choose)
_AT_ONCE = 64
"""Waiting episodes that are drawn together."""


class TargetVectorEnv(VectorEnv):
    """Many drones at once with one compiled step for all; every episode has its own drone.

    Under each name the info has an array with one row per drone. If episodes begin again in the step in which they
    end, ``final_obs`` and ``final_info`` hold the last observation and info of the ended ones (masks ``_final_obs``,
    ``_final_info``).

    Args:
        num_envs: number of drones.
        task: task to fly, also a `FlipTask`; default: fly to the target on the nominal drone.
        model: preset or model YAML, or the drone itself.
        autoreset_mode: when ended episodes begin again. Some of Gymnasium's wrappers, e.g. `NormalizeObservation`,
            need ``NEXT_STEP``. With ``DISABLED``, ``reset(options={"reset_mask": ended})`` begins them.

    Raises:
        CfbError: there is no such model or mode, the control step is not a multiple of the drone's, or the ranges allow
            impossible drones.
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
        self._keys: Array | None = None
        self._episodes: Leaves | None = None
        self._over = np.zeros(num_envs, bool)
        # In a forked process raise in reset: Gymnasium reports errors of a reset to the parent, not errors of this.
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
            seed: one seed for all drones (the drones of different seeds share nothing), or a list with one per drone,
                as `TargetEnv` takes it. It determines all later episodes of a drone. With None, drones continue their
                sequence; at the first reset they get random seeds.
            options: ``reset_mask`` selects the episodes to begin, (num_envs,) booleans.

        Returns:
            Observations and info.

        Raises:
            CfbError: invalid seeds or mask, or a first reset that does not begin all episodes.
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
                raise NotReset(f"{who}: the first reset must begin all episodes.")
            seeds = [int(self.np_random.integers(2**32)) if s is None else s for s in seeds]
        given = np.array([s is not None for s in seeds])
        if given.any():
            keys = jax.vmap(jax.random.PRNGKey)(np.array([s or 0 for s in seeds], np.uint32))
            if not each:
                given, keys = np.ones(self.num_envs, bool), jax.random.split(keys[0], self.num_envs)
            if self._keys is None:
                self._keys, episodes = _draw(self.task, self.nominal, keys)
                self._waiting, structure = jax.tree.flatten(episodes)
                self._episodes, self._taken = self._waiting, np.zeros(self.num_envs, bool)
                self._programs = _programs(self.task, self.autoreset_mode, structure)
            else:
                self._keys, self._taken = _choose(given, keys, self._keys), self._taken | given
        seen, truth = self._begin(which)
        return np.asarray(seen, np.float32), _shown(truth, which)

    @property
    def waits(self) -> bool:
        """Whether nothing has begun, or an episode has ended that only `reset` can begin again."""
        return self._episodes is None or (self.autoreset_mode == AutoresetMode.DISABLED and bool(self._over.any()))

    def _begin(self, which: np.ndarray) -> tuple[Array, dict[str, Any]]:
        """Begin the waiting episodes of ``which`` and return what is seen of all drones.

        Waiting episodes that were used are drawn again when one of them is needed, so that each drawing is of many. A
        drone's own key alone determines the sequence of its episodes.
        """
        if (which & self._taken).any():
            self._redraw()
        self._episodes, shown = self._programs.begin(which, self._waiting, not_none(self._episodes))
        self._taken, self._over = self._taken | which, self._over & ~which
        return shown

    def _redraw(self) -> None:
        numbers = np.flatnonzero(self._taken)
        # All of them at once if they are many.
        block = self.num_envs if 2 * len(numbers) > self.num_envs else min(_AT_ONCE, self.num_envs)
        for start in range(0, len(numbers), block):
            some, which = numbers[start : start + block], np.zeros(self.num_envs, bool)
            places = np.zeros(self.num_envs, np.int32)
            which[some], places[some] = True, np.arange(len(some))
            padded = np.concatenate([some, np.full(block - len(some), some[0])])
            self._keys, self._waiting = self._programs.redraw(
                self.nominal, not_none(self._keys), self._waiting, which, padded, places
            )
        self._taken = np.zeros(self.num_envs, bool)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Fly one action per drone.

        Returns:
            Observations, rewards, whether failed, whether timed out, and the info.

        Raises:
            CfbError: there was no reset, or one is due; actions have a wrong shape or are not finite.
        """
        _require_jax()
        who, anew = type(self).__name__, self._over
        if self.waits:
            over = f" ({anew.sum()} episodes are over)" if anew.any() else ""
            raise NotReset(f"{who}: call reset before step{over}.")
        actions = _checked(actions, (self.num_envs, 4), who)
        self._episodes, outcome, before, shown = self._programs.fly(
            not_none(self._episodes), self._waiting, ~self._taken, anew, actions
        )
        # If the last step ended an episode, this one begins the next, and its action is ignored.
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
            final = {"final_obs": np.asarray(before[0], np.float32), "final_info": _shown(before[1], over) | why}
            final |= {f"_{name}": over for name in final}
            why, anew = {}, over
        if (late := anew & self._taken).any():
            shown = self._begin(late)
        self._taken, self._over = self._taken | anew, self._over & ~anew
        info = _shown(shown[1], np.ones(self.num_envs, bool)) | why | final
        return np.asarray(shown[0], np.float32), reward, failed, timed_out, info


def _whole(number: Any) -> bool:
    return isinstance(number, int | np.integer) and not isinstance(number, bool)


def _shown(truth: dict[str, Any], which: np.ndarray) -> dict[str, Any]:
    """Add a mask to each name, as Gymnasium's vector environments do: which environments have it."""
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
        raise CfbError(f"{who}: an action must be {wanted} numbers, 2 u - 1 for each motor, found {found}.")
    if not np.isfinite(numbers).all():
        bad = numbers if numbers.ndim == 1 else numbers[~np.isfinite(numbers).all(axis=1)][0]
        raise CfbError(f"{who}: an action must be finite, found {bad.tolist()}; the policy has diverged.")
    return numbers


class TargetEnv(gymnasium.Env):
    """One drone; arguments as for `TargetVectorEnv`. After an episode has ended, call ``reset``."""

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's interface)

    def __init__(self, task: Task | None = None, model: str | Quadrotor = "cfb-guards"):
        self.many = TargetVectorEnv(1, task, model, AutoresetMode.DISABLED)
        self.observation_space, self.action_space = _spaces(self.many.task)
        self.render_mode = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; the same seed gives the same episodes from then on."""
        super().reset(seed=seed)
        seen, info = self.many.reset(seed=[seed])
        return seen[0], _of_one(info)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Fly one action.

        Returns:
            Observation, reward, whether failed, whether timed out, and the info.

        Raises:
            CfbError: there was no reset, the episode is over, or the action has a wrong shape or is not finite.
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
