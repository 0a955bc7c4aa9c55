"""Proximal policy optimisation (Schulman et al. 2017) with Brax's action distribution and advantages.

Brax's own ``train`` returns neither its optimizer nor its environments, so an interrupted run cannot continue. This one
is a page long, and its complete state is one pytree. Brax's loss divides advantages by a standard deviation that a few
failures determine. Here advantages are clipped first and taken relative to copies of the same episode that differ only
in their actions; without this they are mostly errors of the value network. Every reset draws a new episode and a new
drone. The value network sees what the drone cannot: the true state, the rotor speeds and the drawn drone.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cfb_mjx.control.neural import Network, NeuralController
from cfb_mjx.devices import Devices
from cfb_mjx.envs.episode import Episode, choose, observe, privileged, reset, step
from cfb_mjx.envs.task import Task
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.train.algorithm import in_progress, strong
from cfb_mjx.train.brax_compat import parts
from cfb_mjx.train.config import PpoSettings

LEAST_RATE = 1e-3
"""Lowest factor on the policy's learning rate, for policies that change too much with their weights."""


class Actor(eqx.Module):
    """The policy: a Gaussian about the network's output, followed by tanh."""

    network: Network
    raw_std: Float[Array, "4"]
    """Standard deviation before a softplus."""


class PpoState(eqx.Module):
    """Complete state of a training."""

    actor: Actor
    critic: Network
    optimizer: Any
    rate: Float[Array, ""]
    """Factor on the policy's learning rate that keeps the KL divergence of an update small."""
    episodes: tuple[Episode, Bool[Array, " drones"]]
    """One episode per drone, and which drones have failed and wait for their copies."""
    key: PRNGKeyArray
    count: Int[Array, ""]


class Ppo:
    """The algorithm; see `cfb_mjx.train.algorithm.Algorithm`.

    ``trained`` says that the initial policy can already fly. The value network then learns that policy's value first.
    """

    def __init__(
        self,
        settings: PpoSettings,
        task: Task,
        nominal: Quadrotor,
        over: Devices | None = None,
        trained: bool = False,
    ):
        self.settings, self.task, self.nominal = settings, task, nominal
        self.warm_up, self.first_std = (settings.warm_up, settings.warm_std) if trained else (0, settings.first_std)
        self.first_rate = LEAST_RATE if trained else 1.0
        self.devices = Devices.take() if over is None else over
        self.devices.require(settings.drones // settings.minibatches // settings.copies, "starts of a minibatch")
        self.updates = settings.updates
        self.steps_per_update = settings.drones * settings.unroll
        self.brax = parts()
        self.distribution = self.brax.distribution.NormalTanhDistribution(event_size=4)
        gradient_steps = self.updates * settings.epochs * settings.minibatches

        def adam(rate: float) -> optax.GradientTransformation:
            schedule = optax.linear_schedule(rate, settings.last_rate * rate, gradient_steps)
            return optax.chain(optax.clip_by_global_norm(settings.gradient_clip), optax.adam(schedule, eps=1e-5))

        # Separate clipping: the value network's gradient is far larger at first and would suppress the policy's.
        self.optimizer = optax.multi_transform(
            {"actor": adam(settings.learning_rate), "critic": adam(settings.value_learning_rate)}, ("actor", "critic")
        )
        # Value of the best reward forever; the network learns how much lower the value is.
        self.ideal = settings.reward_scaling * task.largest_reward / max(1e-3, 1 - settings.discount)
        self._reset = jax.vmap(partial(reset, task, nominal))
        self.update = eqx.filter_jit(self._update)

    def begin(self, key: PRNGKeyArray, controller: NeuralController) -> PpoState:
        """Start the drones in flight, with an untrained value network."""
        of_episodes, of_critic, key = jax.random.split(key, 3)
        episodes = in_progress(self.task, self.nominal, self.settings.drones // self.settings.copies, of_episodes)
        episodes = self._copied(episodes)
        first = jax.tree.map(lambda x: x[0], episodes)
        inputs = self._show(first)["hidden"].shape[-1]
        critic = Network.random(of_critic, (inputs, *self.settings.value_hidden, 1), "swish")
        raw = jnp.log(jnp.expm1(jnp.full(4, self.first_std)))
        actor = Actor(controller.network, raw)
        # Optax's type annotation does not include modules of equinox.
        optimizer = self.optimizer.init(cast(Any, (actor, critic)))
        rate = jnp.asarray(self.first_rate, raw.dtype)
        episodes = episodes, jnp.zeros(self.settings.drones, bool)
        return strong(PpoState(actor, critic, optimizer, rate, episodes, key, jnp.asarray(0)))

    def controller(self, state: PpoState) -> NeuralController:
        """Return the mean of the policy as a controller."""
        return NeuralController(state.actor.network, self.task.layout)

    def _copied(self, one_of_each):
        """Repeat every drone ``copies`` times."""
        return jax.tree.map(lambda x: jnp.repeat(x, self.settings.copies, axis=0), one_of_each)

    def _show(self, episode: Episode) -> dict[str, Array]:
        return {"seen": observe(self.task, episode), "hidden": privileged(self.task, self.nominal, episode)}

    def _update(self, state: PpoState) -> tuple[PpoState, dict]:
        of_flight, of_learning, key = jax.random.split(state.key, 3)
        episodes, data, outcome = self._collect(state.actor, state.episodes, of_flight)
        show = self.devices.divided(jax.vmap(self._show), (0,), 0)
        # Every device needs the data of all drones, because batches are drawn from all of them.
        data, last = self.devices.whole((data, show(episodes[0])["hidden"]))
        learning = jnp.where(state.count < self.warm_up, 0.0, 1.0)
        left = 1 - (1 - self.settings.last_entropy) * state.count / self.updates
        weights = learning, learning * self.settings.entropy_cost * left
        (actor, critic, optimizer, rate), losses = jax.lax.scan(
            partial(self._epoch, weights, data, last),
            (state.actor, state.critic, state.optimizer, state.rate),
            jax.random.split(of_learning, self.settings.epochs),
        )
        losses = jax.tree.map(jnp.mean, losses)
        # The rate falls within an update and rises between updates: the first batches have no divergence yet.
        calm = (learning > 0) & (losses["kl"] < self.settings.largest_kl / 4)
        rate = jnp.minimum(jnp.where(calm, 1.5 * rate, rate), 1.0)
        metrics = {
            "reward": jnp.sum(outcome.reward * data["flown"]) / jnp.sum(data["flown"]),
            "failing": jnp.mean(data["failed"] * data["flown"]),
            "std": jnp.mean(jax.nn.softplus(actor.raw_std)),
            "rate": rate,
            **losses,
        }
        return PpoState(actor, critic, optimizer, rate, episodes, key, state.count + 1), metrics

    def _collect(self, actor: Actor, episodes: tuple[Episode, Array], key: PRNGKeyArray):
        """Fly ``unroll`` commands with every drone; the data has axes (unroll, drones)."""
        # Drawing drones and starts costs as much as flying, so draw once per few commands; no drone fails twice within
        # them.
        each = math.gcd(self.settings.unroll, 8)

        def drawn(key):
            of_reset, of_flight = jax.random.split(key)
            noise = jax.vmap(lambda key: jax.random.normal(key, (self.settings.drones, 4)))
            of_reset = jax.random.split(of_reset, self.settings.drones // self.settings.copies)
            return self._copied(of_reset), noise(jax.random.split(of_flight, each))

        # Drawn for all drones at once, so that the draws do not depend on which device flies a drone.
        of_reset, noise = jax.vmap(drawn)(jax.random.split(key, self.settings.unroll // each))
        fly = self.devices.divided(self._fly, (None, 0, 1, 2), (0, 2))
        episodes, flown = fly(actor, episodes, of_reset, noise)
        data, outcome = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), flown)
        return episodes, data, outcome

    def _fly(
        self,
        actor: Actor,
        episodes: tuple[Episode, Array],
        of_reset: PRNGKeyArray,
        noise: Float[Array, "n each drones 4"],
    ):
        """Fly a block of drones. A failed drone waits until all its copies have failed or their time is up. Then a new
        episode begins, drawn once per ``each`` commands.

        If the first failure ended all copies, the others, which may be about to fail, would not learn from it.
        """
        copies = self.settings.copies

        def some(episodes, given):
            of_reset, noise = given
            return jax.lax.scan(partial(one, self._reset(of_reset)), episodes, noise)

        def one(fresh, episodes, noise):
            episodes, lost = episodes
            shown = jax.vmap(self._show)(episodes)
            logits = _logits(actor, shown["seen"])
            normal = self.distribution.create_dist(logits)
            raw = normal.loc + normal.scale * noise
            action = self.distribution.postprocess(raw)
            after, outcome = jax.vmap(partial(step, self.task))(episodes, 0.5 * (1 + action))
            failed, timed_out = outcome.failed | lost, outcome.timed_out & ~lost
            over = jnp.all(failed.reshape(-1, copies), axis=1) | jnp.any(timed_out.reshape(-1, copies), axis=1)
            over = jnp.repeat(over, copies)
            kept = shown | {
                "raw": raw,
                "log_prob": self.distribution.log_prob(logits, raw),
                "reward": self.settings.reward_scaling * jnp.maximum(outcome.reward, self.settings.least_reward),
                "failed": 1.0 * failed,
                "cut": 1.0 * (over & ~failed),
                "flown": 1.0 * ~lost,
            }
            after = choose(over, fresh, choose(failed, episodes, after))
            return (after, failed & ~over), (kept, outcome)

        return jax.lax.scan(some, episodes, (of_reset, noise))

    def _epoch(self, weights, data: dict[str, Array], last: Array, learnt: tuple, key: PRNGKeyArray):
        of_order, of_entropy = jax.random.split(key)
        count = self.settings.minibatches
        # A batch consists of the whole flights of some drones; every device takes its share of it.
        copies = self.settings.copies
        order = jax.random.permutation(of_order, self.settings.drones // copies)
        order = (copies * order[:, None] + jnp.arange(copies)).reshape(count, -1)
        order = self.devices.along(order, 1)
        batches = jax.tree.map(lambda x: self.devices.along(jnp.moveaxis(x[:, order], 1, 0), 2), data)
        batches = batches, self.devices.along(last[order], 1), jax.random.split(of_entropy, count)

        def one(learnt, batch):
            actor, critic, optimizer, rate = learnt
            gradient, metrics = jax.grad(self._loss, has_aux=True)((actor, critic), weights, *batch)
            changes, optimizer = self.optimizer.update(gradient, optimizer)
            changes = cast(tuple[Actor, Network], changes)
            if most := self.settings.largest_kl:
                # Divergence that the previous steps of this update have caused.
                kl = metrics["kl"]
                step = jnp.where(kl > 2 * most, 0.0, rate)
                # A policy from a file may have another precision than its standard deviation and this factor.
                changes = jax.tree.map(lambda x: step.astype(x.dtype) * x, changes[0]), changes[1]
                rate = jnp.maximum(jnp.where(kl > most, rate / 1.5, rate), LEAST_RATE)
            actor, critic = eqx.apply_updates((actor, critic), changes)
            return (actor, critic, optimizer, rate), metrics

        return jax.lax.scan(one, learnt, batches)

    def _loss(
        self, both: tuple[Actor, Network], weights: tuple[Array, Array], data: dict, last: Array, key: PRNGKeyArray
    ) -> tuple[Array, dict]:
        logits = _logits(both[0], data["seen"])
        values = self._value(both[1], data["hidden"])
        # Computed again for every batch, because the value network learns from the same flights.
        returns, advantage = self.brax.losses.compute_gae(
            truncation=data["cut"],
            termination=data["failed"],
            rewards=data["reward"],
            values=values,
            bootstrap_value=self._value(both[1], last),
            lambda_=self.settings.gae_lambda,
            discount=self.settings.discount,
        )
        flown = data["flown"]

        def mean(x):
            return jnp.sum(flown * x) / jnp.sum(flown)

        advantage = beside_copies(advantage, flown, self.settings.copies)
        most = self.settings.advantage_limit * mean(jnp.abs(advantage))
        advantage = jnp.clip(advantage, -most, most)
        advantage -= mean(advantage)
        advantage /= jnp.sqrt(mean(advantage**2)) + 1e-8
        log_ratio = self.distribution.log_prob(logits, data["raw"]) - data["log_prob"]
        ratio = jnp.exp(log_ratio)
        near = self.settings.clipping
        gain = mean(jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - near, 1 + near) * advantage))
        value_loss = mean((returns - values) ** 2) / 4
        entropy = mean(self.distribution.entropy(logits, key))
        # Change from one command to the next of the same flight.
        follows = (flown * (1 - data["failed"]) * (1 - data["cut"]))[:-1] * flown[1:]
        change = jnp.sum(jnp.diff(jnp.tanh(logits[..., :4]), axis=0) ** 2, axis=-1)
        change = jnp.sum(follows * change) / jnp.maximum(jnp.sum(follows), 1.0)
        loss = value_loss - weights[0] * (gain - self.settings.smoothness * change) - weights[1] * entropy
        return loss, {
            "loss": loss,
            "value_loss": value_loss,
            "value_explained": 1 - 4 * value_loss / mean((returns - mean(returns)) ** 2),
            "entropy": entropy,
            "change": change,
            # The low-variance estimator (Schulman, Approximating KL divergence, 2020).
            "kl": mean(ratio - 1 - log_ratio),
            "clipped": mean(jnp.abs(ratio - 1) > near),
        }

    def _value(self, critic: Network, shown: Array) -> Array:
        return self.ideal + critic(shown)[..., 0]


def beside_copies(
    advantage: Float[Array, "n drones"], flown: Float[Array, "n drones"], copies: int
) -> Float[Array, "n drones"]:
    """Advantages minus the mean over the drone's copies at the same command.

    Copies start alike and see the same noise, so the error of the value network is nearly the same in all of them; the
    difference is due to their own actions. A copy's command does not depend on the advantages of the others, so the
    gradient stays unbiased up to the factor (copies - 1) / copies.

    Args:
        advantage: generalised advantages (Schulman et al. 2016); copies are adjacent.
        flown: one for commands that were flown, zero for those of a copy that has failed.
        copies: number of copies of every drone; with 1 the advantages are unchanged.
    """
    if copies == 1:
        return advantage
    of_each, flown = (x.reshape(len(x), -1, copies) for x in (advantage, flown))
    mean = jnp.sum(flown * of_each, axis=-1, keepdims=True) / jnp.maximum(jnp.sum(flown, axis=-1, keepdims=True), 1.0)
    return (of_each - mean).reshape(advantage.shape)


def _logits(actor: Actor, seen: Array) -> Array:
    loc = actor.network(seen)
    return jnp.concatenate([loc, jnp.broadcast_to(actor.raw_std, loc.shape)], axis=-1)
