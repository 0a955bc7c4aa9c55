"""Back-propagation through the simulator: the exact gradient of a flight's cost, from all its steps.

Drones fly on from update to update, and only the last ``horizon_s`` is differentiated (truncated back-propagation
through time). A drone that has failed stays where it was, costs ``failure`` for the rest of the horizon, and begins a
new episode after it.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int, PRNGKeyArray

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.devices import Devices
from cfb_mjx.envs.episode import Episode, choose, observe, reset, step
from cfb_mjx.envs.task import Task
from cfb_mjx.model.quadrotor import Quadrotor, prepare
from cfb_mjx.train.algorithm import in_progress, strong
from cfb_mjx.train.config import AnalyticSettings


class AnalyticState(eqx.Module):
    """Complete state of a training."""

    controller: NeuralController
    optimizer: Any
    episodes: Episode
    """One episode per drone."""
    key: PRNGKeyArray
    count: Int[Array, ""]


class Analytic:
    """The algorithm; see `cfb_mjx.train.algorithm.Algorithm`."""

    def __init__(self, settings: AnalyticSettings, task: Task, nominal: Quadrotor, over: Devices | None = None):
        self.settings, self.task, self.nominal = settings, task, nominal
        self.devices = Devices.take() if over is None else over
        self.devices.require(settings.drones, "drones")
        self.updates = settings.updates
        self.horizon = max(1, round(settings.horizon_s / task.layout.control_dt_s))
        self.steps_per_update = settings.drones * self.horizon
        schedule = optax.cosine_decay_schedule(settings.learning_rate, settings.updates)
        self.optimizer = optax.chain(optax.clip_by_global_norm(settings.gradient_clip), optax.adam(schedule))
        self._reset = jax.vmap(partial(reset, task, nominal))
        self.update = eqx.filter_jit(self._update)

    def begin(self, key: PRNGKeyArray, controller: NeuralController) -> AnalyticState:
        """Start the drones in flight, with a fresh optimizer."""
        of_episodes, key = jax.random.split(key)
        episodes = in_progress(self.task, self.nominal, self.settings.drones, of_episodes)
        optimizer = self.optimizer.init(_arrays(controller))
        return strong(AnalyticState(controller, optimizer, episodes, key, jnp.asarray(0)))

    def controller(self, state: AnalyticState) -> NeuralController:
        """Return the present controller."""
        return state.controller

    def _update(self, state: AnalyticState) -> tuple[AnalyticState, dict]:
        differentiated = eqx.filter_value_and_grad(self._loss, has_aux=True)
        (loss, (episodes, alive)), gradient = differentiated(state.controller, state.episodes)
        changes, optimizer = self.optimizer.update(gradient, state.optimizer)
        controller = eqx.apply_updates(state.controller, changes)
        of_episodes, key = jax.random.split(state.key)
        over = ~alive | (episodes.count >= self.task.episode_steps)
        reset = self.devices.divided(self._reset, (0,), 0)
        fresh = reset(jax.random.split(of_episodes, self.settings.drones))
        episodes = choose(over, fresh, episodes)
        metrics = {"loss": loss, "failing": jnp.mean(~alive), "gradient": optax.tree.norm(gradient)}
        return AnalyticState(controller, optimizer, episodes, key, state.count + 1), metrics

    def _loss(self, controller: NeuralController, episodes: Episode):
        fly = self.devices.divided(jax.vmap(self._fly, in_axes=(None, 0)), (None, 0), 0)
        costs, episodes, alive = fly(controller, episodes)
        return jnp.mean(costs), (episodes, alive)

    def _fly(self, controller: NeuralController, episode: Episode):
        prepared = prepare(episode.model)
        cost = self.settings.cost

        def one(carry, _):
            episode, alive = carry
            command = controller.act(observe(self.task, episode))
            after, outcome = step(self.task, episode, command, prepared)
            alive = alive & ~outcome.failed
            last = episode.memory.commands[0] if self.task.layout.past_commands else 2 * command - 1
            relative = self.task.relative(after.state, after.setpoint)
            paid = cost(relative, after.target, after.setpoint, command, (1 + last) / 2)
            # A failed drone stays where it was: later steps must neither count nor overflow.
            after = choose(alive, after, jax.lax.stop_gradient(episode))
            return (after, alive), jnp.where(alive, paid, cost.failure)

        (episode, alive), costs = jax.lax.scan(one, (episode, jnp.asarray(True)), length=self.horizon)
        return jnp.mean(costs), episode, alive


def _arrays(tree: Any) -> Any:
    return eqx.filter(tree, eqx.is_array)
