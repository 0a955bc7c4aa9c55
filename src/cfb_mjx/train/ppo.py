"""Proximal policy optimisation on Brax's loss, networks' interface and action distribution.

Brax's own ``train`` hands out neither its optimizer nor its environments, so a run of it cannot go on where it was
interrupted; this one is a page long, and its whole state is one pytree. Episodes are drawn anew at every reset, drone
included. The value network sees what the drone itself cannot: the true state, rotor speeds and the drawn drone.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cfb_mjx.control.neural import Network, NeuralController
from cfb_mjx.envs.observation import Estimate, frame
from cfb_mjx.envs.reward import length
from cfb_mjx.envs.target import Episode, TargetTask, choose, observe, reset, step
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.parameters.parameters import SPECIFICATIONS
from cfb_mjx.train.algorithm import in_progress, strong
from cfb_mjx.train.brax_compat import parts
from cfb_mjx.train.config import PpoSettings


class Actor(eqx.Module):
    """The policy: Gaussian about the network's output, then tanh."""

    network: Network
    raw_std: Float[Array, "4"]
    """Its softplus is the standard deviation."""


class PpoState(eqx.Module):
    """Everything a training is at one instant."""

    actor: Actor
    critic: Network
    optimizer: Any
    episodes: Episode
    """One per drone."""
    key: PRNGKeyArray
    count: Int[Array, ""]


class Ppo:
    """The algorithm; see `cfb_mjx.train.algorithm.Algorithm`."""

    def __init__(self, settings: PpoSettings, task: TargetTask, nominal: Quadrotor):
        self.settings, self.task, self.nominal = settings, task, nominal
        self.updates = settings.updates
        self.steps_per_update = settings.drones * settings.unroll
        self.brax = parts()
        self.distribution = self.brax.distribution.NormalTanhDistribution(event_size=4)
        gradient_steps = self.updates * settings.epochs * settings.minibatches

        def adam(rate: float) -> optax.GradientTransformation:
            schedule = optax.linear_schedule(rate, settings.last_rate * rate, gradient_steps)
            return optax.chain(optax.clip_by_global_norm(settings.gradient_clip), optax.adam(schedule, eps=1e-5))

        # Clipped apart: the value's gradient is far larger at first and would leave nothing of the policy's.
        self.optimizer = optax.multi_transform(
            {"actor": adam(settings.learning_rate), "critic": adam(settings.value_learning_rate)}, ("actor", "critic")
        )
        # The value of holding the target for ever: what the network has to learn is how much worse it is elsewhere.
        ideal = settings.reward_scaling * task.reward.largest / max(1e-3, 1 - settings.discount)
        self._reset = jax.vmap(partial(reset, task, nominal))
        feed_forward = self.brax.networks.networks.FeedForwardNetwork
        self._loss = partial(
            self.brax.losses.compute_ppo_loss,
            ppo_network=self.brax.networks.PPONetworks(
                policy_network=feed_forward(init=None, apply=lambda _, actor, shown: _logits(actor, shown["seen"])),
                value_network=feed_forward(
                    init=None, apply=lambda _, critic, shown: ideal + critic(shown["hidden"]).squeeze(-1)
                ),
                parametric_action_distribution=self.distribution,
            ),
            entropy_cost=settings.entropy_cost,
            discounting=settings.discount,
            reward_scaling=settings.reward_scaling,
            gae_lambda=settings.gae_lambda,
            clipping_epsilon=settings.clipping,
        )
        self.update = eqx.filter_jit(self._update)

    def begin(self, key: PRNGKeyArray, controller: NeuralController) -> PpoState:
        """Drones in flight, and a value network that knows nothing."""
        of_episodes, of_critic, key = jax.random.split(key, 3)
        episodes = in_progress(self.task, self.nominal, self.settings.drones, of_episodes)
        first = jax.tree.map(lambda x: x[0], episodes)
        inputs = self._show(first)["hidden"].shape[-1]
        critic = Network.random(of_critic, (inputs, *self.settings.value_hidden, 1), "swish")
        raw = jnp.log(jnp.expm1(jnp.full(4, self.settings.first_std)))
        actor = Actor(controller.network, raw)
        return strong(PpoState(actor, critic, self.optimizer.init((actor, critic)), episodes, key, jnp.asarray(0)))

    def controller(self, state: PpoState) -> NeuralController:
        """The mean of the policy."""
        return NeuralController(state.actor.network, self.task.layout)

    def _show(self, episode: Episode) -> dict[str, Array]:
        return {"seen": observe(self.task, episode), "hidden": hidden(self.task, self.nominal, episode)}

    def _update(self, state: PpoState) -> tuple[PpoState, dict]:
        of_flight, of_learning, key = jax.random.split(state.key, 3)
        episodes, data, outcome = self._collect(state.actor, state.episodes, of_flight)
        learnt, losses = jax.lax.scan(
            partial(self._epoch, data),
            (state.actor, state.critic, state.optimizer),
            jax.random.split(of_learning, self.settings.epochs),
        )
        metrics = {
            "reward": jnp.mean(outcome.reward),
            "failing": jnp.mean(outcome.failed),
            "std": jnp.mean(jax.nn.softplus(learnt[0].raw_std)),
            "value_loss": jnp.mean(losses["v_loss"]),
            "loss": jnp.mean(losses["total_loss"]),
        }
        return PpoState(*learnt, episodes, key, state.count + 1), metrics

    def _collect(self, actor: Actor, episodes: Episode, key: PRNGKeyArray):
        """Fly ``unroll`` commands with every drone; data has axes (drones, unroll)."""

        def some(episodes, key):
            of_reset, of_flight = jax.random.split(key)
            fresh = self._reset(jax.random.split(of_reset, self.settings.drones))
            return jax.lax.scan(partial(one, fresh), episodes, jax.random.split(of_flight, each))

        def one(fresh, episodes, of_action):
            shown = jax.vmap(self._show)(episodes)
            logits = _logits(actor, shown["seen"])
            raw = self.distribution.sample_no_postprocessing(logits, of_action)
            action = self.distribution.postprocess(raw)
            after, outcome = jax.vmap(partial(step, self.task))(episodes, 0.5 * (1 + action))
            over = outcome.failed | outcome.timed_out
            kept = self.brax.types.Transition(
                observation=shown,
                action=action,
                reward=jnp.maximum(outcome.reward, self.settings.least_reward),
                discount=1.0 - over,
                next_observation=None,
                extras={
                    "policy_extras": {
                        "log_prob": self.distribution.log_prob(logits, raw),
                        "raw_action": raw,
                        "distribution_params": logits,
                    },
                    "state_extras": {"truncation": 1.0 * (outcome.timed_out & ~outcome.failed)},
                },
            )
            return choose(over, fresh, after), (kept, outcome)

        # Drawing drones and starts costs as much as flying: once per few commands is enough, as no drone fails twice
        # within them.
        each = math.gcd(self.settings.unroll, 8)
        episodes, flown = jax.lax.scan(some, episodes, jax.random.split(key, self.settings.unroll // each))
        data, outcome = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), flown)
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)
        # Brax's loss reads the last of these only.
        last = jax.tree.map(lambda x: x[:, None], jax.vmap(self._show)(episodes))
        return episodes, data._replace(next_observation=last), outcome

    def _epoch(self, data: Any, learnt: tuple, key: PRNGKeyArray) -> tuple[tuple, dict]:
        of_order, of_entropy = jax.random.split(key)
        order = jax.random.permutation(of_order, self.settings.drones)
        count = self.settings.minibatches
        batches = jax.tree.map(lambda x: x[order].reshape(count, -1, *x.shape[1:]), data)

        def one(learnt, batch):
            actor, critic, optimizer = learnt
            data, key = batch

            def loss(both):
                params = self.brax.losses.PPONetworkParams(policy=both[0], value=both[1])
                return self._loss(params, None, data, key)

            gradient, metrics = jax.grad(loss, has_aux=True)((actor, critic))
            changes, optimizer = self.optimizer.update(gradient, optimizer)
            actor, critic = eqx.apply_updates((actor, critic), changes)
            return (actor, critic, optimizer), metrics

        return jax.lax.scan(one, learnt, (batches, jax.random.split(of_entropy, count)))


def hidden(task: TargetTask, nominal: Quadrotor, episode: Episode) -> Float[Array, "n"]:
    """What the value network is shown: true frame, rotor speeds, integral, how the drone differs, and three lengths.

    The reward falls with lengths, whose tips at zero a small network is slow to form by itself.
    """
    state, parameters = episode.state, episode.model.parameters
    position = state.position - episode.target
    true = frame(task.layout, Estimate(position, state.velocity, state.quaternion, state.body_rate))
    lengths = jnp.stack([length(position), length(state.velocity), length(state.body_rate) / 10])
    parts = [true, lengths, jnp.sqrt(lengths), state.rotor_speed / parameters.reference_rotor_speed]
    parts.append(episode.memory.integral / task.layout.integral_limit_ms)
    if task.randomisation is not None:
        for name, spread in task.randomisation.ranges:
            drawn, mean = getattr(parameters, name), getattr(nominal.parameters, name)
            width = jnp.asarray(spread.half_width if len(spread.half_width) > 1 else spread.half_width[0])
            change = (drawn - mean) / (jnp.where(spread.relative, mean, 1.0) * width)
            parts.append(jnp.atleast_1d(change[0] if spread.shared and SPECIFICATIONS[name].shape else change))
    return jnp.concatenate(parts)


def _logits(actor: Actor, seen: Array) -> Array:
    loc = actor.network(seen)
    return jnp.concatenate([loc, jnp.broadcast_to(actor.raw_std, loc.shape)], axis=-1)
