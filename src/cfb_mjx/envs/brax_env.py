"""Tasks as environments of Brax, for its trainers and those written for them.

    from brax.training.agents.sac import train as sac

    env = BraxEnv(TargetTask(randomisation=load_randomisation("paper")))
    make_policy, params, _ = sac.train(env, episode_length=env.task.episode_steps, wrap_env_fn=wrap, ...)

Actions are 2 u - 1 in [-1, 1]. Observations are a dictionary with ``state``, what the controller sees (`Layout`), and
``privileged_state``, what a value network may know in addition (`privileged`). Every episode draws its own drone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import jax
import jax.numpy as jnp

from cfb_mjx.envs.episode import Episode, choose, observe, privileged, reset, step
from cfb_mjx.envs.reward import length
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import Task, with_room
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.randomised import require_possible
from cfb_mjx.quiet import quietly

with quietly():
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers import training

EACH = 8
"""Commands between two draws of the next episodes' drones: drawing costs as much as flying, and no drone fails twice
within 64 ms."""


class BraxEnv(Env):
    """One drone on a task, for Brax; its wrappers make a batch of it.

    Args:
        task: task to fly; default: fly to the target on the nominal drone.
        model: preset or model YAML, or the drone itself.
        asymmetric: whether observations are the dictionary. Otherwise they are the array ``state``, for trainers that
            know no other (SAC of Brax 0.14).

    Attributes:
        task: the task, with room for the delayed estimates of all drones that it draws.
        sys: the nominal drone, about which the drones of episodes are drawn; a ``randomization_fn`` of Brax may change
            it.

    Raises:
        CfbError: there is no such model, the control step is not a multiple of the drone's, or the ranges allow
            impossible drones.
    """

    def __init__(self, task: Task | None = None, model: str | Quadrotor = "cfb-guards", *, asymmetric: bool = True):
        self.asymmetric = asymmetric
        self.sys = model if isinstance(model, Quadrotor) else Quadrotor.from_file(model)
        task = TargetTask() if task is None else task
        task.hold(self.sys)
        if task.randomisation is not None:
            require_possible(self.sys, task.randomisation, task.magnitude)
        self.task = with_room(task, self.sys)
        self._nominal = self.sys

    def reset(self, rng: jax.Array) -> State:
        """Begin an episode. ``rng`` determines the drone, the start, the set-point and all noise."""
        episode = reset(self.task, self.sys, rng)
        zero = jnp.zeros((), episode.state.position.dtype)
        # Brax's annotations allow only its own pipelines, here and in `step`.
        flying = cast(Any, episode)
        return State(flying, self._shown(episode), zero, zero, self._metrics(episode, zero), {"time_out": zero})

    def step(self, state: State, action: jax.Array) -> State:
        """Fly one command. ``done`` means that the drone failed; Brax's wrappers report the end of the time."""
        episode, outcome = step(self.task, cast(Episode, state.pipeline_state), 0.5 * (1 + action))
        failed = outcome.failed.astype(state.done.dtype)
        time_out = (outcome.timed_out & ~outcome.failed).astype(state.done.dtype)
        return replace(
            state,
            pipeline_state=episode,
            obs=self._shown(episode),
            reward=outcome.reward.astype(state.reward.dtype),
            done=failed,
            metrics={**state.metrics, **self._metrics(episode, failed)},
            info={**state.info, "time_out": time_out},
        )

    def _shown(self, episode: Episode) -> dict[str, jax.Array] | jax.Array:
        state = observe(self.task, episode)
        if not self.asymmetric:
            return state
        return {"state": state, "privileged_state": privileged(self.task, self._nominal, episode)}

    def _metrics(self, episode: Episode, failed: jax.Array) -> dict[str, jax.Array]:
        """Metrics of one command; Brax's evaluation sums them over the episode."""
        return {"distance_m": length(episode.state.position - episode.target), "failed": failed}

    @property
    def observation_size(self) -> dict[str, int] | int:
        """Number of values in each observation."""
        return jax.tree.map(lambda x: x.shape[-1], jax.eval_shape(self.reset, jax.random.PRNGKey(0)).obs)

    @property
    def action_size(self) -> int:
        """Number of actions, one per motor."""
        return 4

    @property
    def backend(self) -> str:
        """Name of the backend; it is not a pipeline of Brax."""
        return "cfb_mjx"

    @property
    def dt(self) -> float:
        """Time between two commands, s."""
        return self.task.layout.control_dt_s


class RedrawWrapper(Wrapper):
    """Begin a new episode on a new drone when one has ended. States are Brax's or MuJoCo Playground's.

    Use it in place of `AutoResetWrapper`, which always returns to the start and the drone of the first episode.
    """

    def reset(self, rng: jax.Array) -> Any:
        """Begin all episodes, and draw the episodes that follow them."""
        own, waiting, rest = jax.vmap(lambda key: jax.random.split(key, 3), out_axes=1)(rng)
        state = self.env.reset(own)
        next_one = self.env.reset(waiting)
        state.info["waiting"] = {"flying": _flying(next_one), "obs": next_one.obs}
        state.info["redraw"] = {"key": rest, "count": jnp.zeros((), jnp.int32)}
        return state

    def step(self, state: Any, action: jax.Array) -> Any:
        """Step the wrapped environment; the observation after an episode's last command is the next one's start."""
        # The wrapped environment is vmapped and must not see the entries that are kept here.
        info = dict(state.info)
        waiting, redraw = info.pop("waiting"), info.pop("redraw")
        info["steps"] = jnp.where(state.done > 0, 0.0, info["steps"])
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done), info=info), action)
        going = _flying(state), state.obs
        flying, obs = choose(state.done > 0, (waiting["flying"], waiting["obs"]), going)

        def drawn(key):
            key, own = jax.vmap(jax.random.split, out_axes=1)(key)
            fresh = self.env.reset(own)
            return {"flying": _flying(fresh), "obs": fresh.obs}, key

        count = redraw["count"] + 1
        waiting, key = jax.lax.cond(count % EACH == 0, drawn, lambda key: (waiting, key), redraw["key"])
        info = {**state.info, "waiting": waiting, "redraw": {"key": key, "count": count}}
        return state.replace(**{_holds(state): flying}, obs=obs, info=info)


def _holds(state: Any) -> str:
    """Name of the attribute that holds the simulation's state: ``data`` in states of MuJoCo Playground."""
    return "data" if hasattr(state, "data") else "pipeline_state"


def _flying(state: Any) -> Any:
    return getattr(state, _holds(state))


def wrap(
    env: Any, episode_length: int = 1000, action_repeat: int = 1, randomization_fn: Callable | None = None
) -> Wrapper:
    """Like `brax.envs.training.wrap`, but every episode has its own drone; for ``wrap_env_fn`` of Brax's trainers.

    Args:
        env: a `BraxEnv`, or an environment of `cfb_mjx.envs.playground`.
        episode_length: commands per episode.
        action_repeat: number of times that each action is flown.
        randomization_fn: randomisation of the nominal drones, in Brax's way; none by default.

    Returns:
        The wrapped environment.
    """
    batched = training.VmapWrapper(env)
    if randomization_fn is not None:
        batched = training.DomainRandomizationVmapWrapper(env, randomization_fn)
    return RedrawWrapper(training.EpisodeWrapper(batched, episode_length, action_repeat))
