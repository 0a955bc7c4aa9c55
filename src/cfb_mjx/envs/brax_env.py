"""Tasks as environments of Brax, for its trainers and those written for them.

    from brax.training.agents.sac import train as sac

    env = BraxEnv(TargetTask(randomisation=load_randomisation("paper")))
    make_policy, params, _ = sac.train(env, episode_length=env.task.episode_steps, wrap_env_fn=wrap, ...)

Actions are 2 u - 1 in [-1, 1]. Observations are a dictionary: ``state``, what the controller sees (`Layout`), and
``privileged_state``, what a value network may know beside it (`privileged`). Every episode draws its own drone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.control.neural import ACTIVATIONS, Network, NeuralController
from cfb_mjx.envs.episode import Episode, Task, choose, observe, privileged, reset, step, with_room
from cfb_mjx.envs.observation import Layout
from cfb_mjx.envs.reward import length
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.randomised import require_possible
from cfb_mjx.quiet import quietly

with quietly():
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers import training

EACH = 8
"""Commands between two draws of the drones that wait for episodes to end: drawing costs as much as flying, and none
fails twice within 64 ms."""


class BraxEnv(Env):
    """One drone on a task; Brax's wrappers make many of it.

    Args:
        task: what to fly; by default to the target, on the nominal drone.
        model: preset or model YAML, or the drone itself.
        asymmetric: whether observations are the dictionary; else they are the array ``state``, for trainers that know
            no other (SAC of Brax 0.14).

    Attributes:
        task: with room for the latest estimates of any drone it draws.
        sys: the drone about which those of the episodes are drawn; a ``randomization_fn`` of Brax's may change it.

    Raises:
        CfbError: no such model, a control step that is no multiple of the drone's, or ranges that allow drones that
            cannot be.
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
        """Begin an episode, which ``rng`` decides: the drone, the start, what is asked for, and all noise."""
        episode = reset(self.task, self.sys, rng)
        zero = jnp.zeros((), episode.state.position.dtype)
        # Brax's annotations know no pipelines but its own, here and in `step`.
        flying = cast(Any, episode)
        return State(flying, self._shown(episode), zero, zero, self._metrics(episode, zero), {"time_out": zero})

    def step(self, state: State, action: jax.Array) -> State:
        """Fly one command. ``done`` says that the drone failed; that the time is up, Brax's wrappers say."""
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
        """Of one command; an evaluation of Brax's adds them up over the episode."""
        return {"distance_m": length(episode.state.position - episode.target), "failed": failed}

    @property
    def observation_size(self) -> dict[str, int] | int:
        """Numbers in each observation."""
        return jax.tree.map(lambda x: x.shape[-1], jax.eval_shape(self.reset, jax.random.PRNGKey(0)).obs)

    @property
    def action_size(self) -> int:
        """One number for each motor."""
        return 4

    @property
    def backend(self) -> str:
        """Of no pipeline of Brax's: the drone's body is told by its model."""
        return "cfb_mjx"

    @property
    def dt(self) -> float:
        """Time between two commands, s."""
        return self.task.layout.control_dt_s


class RedrawWrapper(Wrapper):
    """Where an episode has ended another begins, on another drone: in place of `AutoResetWrapper`, which goes back to
    the first episode's start and drone for ever. States are Brax's or MuJoCo Playground's."""

    def reset(self, rng: jax.Array) -> Any:
        """Begin all episodes, and draw what comes after them."""
        own, waiting, rest = jax.vmap(lambda key: jax.random.split(key, 3), out_axes=1)(rng)
        state = self.env.reset(own)
        next_one = self.env.reset(waiting)
        state.info["waiting"] = {"flying": _flying(next_one), "obs": next_one.obs}
        state.info["redraw"] = {"key": rest, "count": jnp.zeros((), jnp.int32)}
        return state

    def step(self, state: Any, action: jax.Array) -> Any:
        """As the wrapped environment's; what is seen after the last command of an episode is the next one's start."""
        # What is wrapped is vmapped, and knows nothing of what is kept here.
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
    """Where what flies is kept: in ``data`` in states of MuJoCo Playground."""
    return "data" if hasattr(state, "data") else "pipeline_state"


def _flying(state: Any) -> Any:
    return getattr(state, _holds(state))


def wrap(
    env: Any, episode_length: int = 1000, action_repeat: int = 1, randomization_fn: Callable | None = None
) -> Wrapper:
    """For ``wrap_env_fn`` of Brax's trainers: as `brax.envs.training.wrap`, but every episode on a drone of its own.

    Args:
        env: a `BraxEnv`, or one of `cfb_mjx.envs.playground`.
        episode_length: commands in an episode.
        action_repeat: times that each action is flown.
        randomization_fn: of drones about which the episodes' are drawn, in Brax's way; none by default.
    """
    batched = training.VmapWrapper(env)
    if randomization_fn is not None:
        batched = training.DomainRandomizationVmapWrapper(env, randomization_fn)
    return RedrawWrapper(training.EpisodeWrapper(batched, episode_length, action_repeat))


def controller_of(
    params: Any, layout: Layout, *, normalized: bool, activation: str = "tanh", obs_key: str = "state"
) -> NeuralController:
    """The controller that a policy of Brax's PPO or SAC is when it acts deterministically.

    Args:
        params: what the trainer returned: normaliser, policy, and whatever follows.
        layout: of the task it was trained on.
        normalized: whether it was trained with ``normalize_observations``; that goes into the first layer then. Brax
            returns the statistics in any case.
        activation: of its hidden layers, ``tanh``, ``relu`` or ``swish``.
        obs_key: which observation it sees.

    Raises:
        CfbError: a network of another kind, or of another observation.
    """
    statistics, policy = params[0], params[1]["params"]
    layers = [policy.get(f"hidden_{i}") for i in range(len(policy))]
    if activation not in ACTIVATIONS or None in layers:
        raise CfbError("controller_of: only fully connected policies with tanh, relu or swish can become controllers.")
    weights, biases = ([np.asarray(layer[part]) for layer in layers] for part in ("kernel", "bias"))
    if normalized:
        mean, std = (np.asarray(x[obs_key] if isinstance(x, dict) else x) for x in (statistics.mean, statistics.std))
        biases[0] = biases[0] - (mean / std) @ weights[0]
        weights[0] = weights[0] / std[:, None]
    if weights[0].shape[0] != layout.size:
        raise CfbError(f"controller_of: the policy sees {weights[0].shape[0]} numbers, the layout has {layout.size}.")
    # The second half of the last layer is the spread.
    weights[-1], biases[-1] = weights[-1][:, :4], biases[-1][:4]
    return NeuralController(
        Network(tuple(map(jnp.asarray, weights)), tuple(map(jnp.asarray, biases)), activation), layout
    )
