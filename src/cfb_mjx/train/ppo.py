"""Proximal policy optimisation (Schulman et al. 2017) on Brax's action distribution and advantages.

Brax's own ``train`` hands out neither its optimizer nor its environments, so a run of it cannot go on where it was
interrupted; this one is a page long, and its whole state is one pytree. Brax's loss divides advantages by a spread that
a few failures decide; here they are limited first, and counted from those of copies that differ by their actions
alone, without which they are mostly what the value network errs by. Episodes are drawn anew at every reset, drone
included. The value network sees what the drone itself cannot: the true state, rotor speeds and the drawn drone.
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
from cfb_mjx.envs.episode import Episode, Task, choose, observe, privileged, reset, step
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.train.algorithm import in_progress, strong
from cfb_mjx.train.brax_compat import parts
from cfb_mjx.train.config import PpoSettings

LEAST_RATE = 1e-3
"""Of the policy's learning rate that is left where the policy changes too much with its weights."""


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
    rate: Float[Array, ""]
    """Factor on the policy's learning rate that keeps the KL divergence of an update small."""
    episodes: tuple[Episode, Bool[Array, " drones"]]
    """One per drone, and who is lost and waits for its copies."""
    key: PRNGKeyArray
    count: Int[Array, ""]


class Ppo:
    """The algorithm; see `cfb_mjx.train.algorithm.Algorithm`.

    ``trained`` says that the policy it begins with can fly: its value network has to learn first what that is worth.
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

        # Clipped apart: the value's gradient is far larger at first and would leave nothing of the policy's.
        self.optimizer = optax.multi_transform(
            {"actor": adam(settings.learning_rate), "critic": adam(settings.value_learning_rate)}, ("actor", "critic")
        )
        # The value of the best step for ever: what the network has to learn is how much worse it is elsewhere.
        self.ideal = settings.reward_scaling * task.largest_reward / max(1e-3, 1 - settings.discount)
        self._reset = jax.vmap(partial(reset, task, nominal))
        self.update = eqx.filter_jit(self._update)

    def begin(self, key: PRNGKeyArray, controller: NeuralController) -> PpoState:
        """Drones in flight, and a value network that knows nothing."""
        of_episodes, of_critic, key = jax.random.split(key, 3)
        episodes = in_progress(self.task, self.nominal, self.settings.drones // self.settings.copies, of_episodes)
        episodes = self._copied(episodes)
        first = jax.tree.map(lambda x: x[0], episodes)
        inputs = self._show(first)["hidden"].shape[-1]
        critic = Network.random(of_critic, (inputs, *self.settings.value_hidden, 1), "swish")
        raw = jnp.log(jnp.expm1(jnp.full(4, self.first_std)))
        actor = Actor(controller.network, raw)
        # Optax's annotation knows no modules of equinox.
        optimizer = self.optimizer.init(cast(Any, (actor, critic)))
        rate = jnp.asarray(self.first_rate, raw.dtype)
        episodes = episodes, jnp.zeros(self.settings.drones, bool)
        return strong(PpoState(actor, critic, optimizer, rate, episodes, key, jnp.asarray(0)))

    def controller(self, state: PpoState) -> NeuralController:
        """The mean of the policy."""
        return NeuralController(state.actor.network, self.task.layout)

    def _copied(self, one_of_each):
        """Every drone ``copies`` times."""
        return jax.tree.map(lambda x: jnp.repeat(x, self.settings.copies, axis=0), one_of_each)

    def _show(self, episode: Episode) -> dict[str, Array]:
        return {"seen": observe(self.task, episode), "hidden": privileged(self.task, self.nominal, episode)}

    def _update(self, state: PpoState) -> tuple[PpoState, dict]:
        of_flight, of_learning, key = jax.random.split(state.key, 3)
        episodes, data, outcome = self._collect(state.actor, state.episodes, of_flight)
        show = self.devices.divided(jax.vmap(self._show), (0,), 0)
        # Every device needs what all drones saw: a batch is drawn from all of them.
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
        # It falls within an update, and rises from one to the next: the first batches of each have no divergence yet.
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
        """Fly ``unroll`` commands with every drone; data has axes (unroll, drones)."""
        # Drawing drones and starts costs as much as flying: once per few commands is enough, as no drone fails twice
        # within them.
        each = math.gcd(self.settings.unroll, 8)

        def drawn(key):
            of_reset, of_flight = jax.random.split(key)
            noise = jax.vmap(lambda key: jax.random.normal(key, (self.settings.drones, 4)))
            of_reset = jax.random.split(of_reset, self.settings.drones // self.settings.copies)
            return self._copied(of_reset), noise(jax.random.split(of_flight, each))

        # For all drones at once, so that what a drone is given does not depend on which device flies it.
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
        """Fly so many drones. Who fails waits until its copies have failed too, or their time is over; then another
        begins, drawn anew once per ``each`` commands.

        Were all copies ended by the first that fails, the others, a moment from failing, would not learn of it.
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
        # Whole flights of some of the drones make a batch, of which every device takes its share.
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
                # How far the steps before this one have led.
                kl = metrics["kl"]
                step = jnp.where(kl > 2 * most, 0.0, rate)
                # A policy from a file may be of another precision than its spread and this factor.
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
        # Anew for every batch: the value network learns from the very same flights.
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
        # From one command to the next of the same flight.
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
            # The estimate of least variance (Schulman, Approximating KL divergence, 2020).
            "kl": mean(ratio - 1 - log_ratio),
            "clipped": mean(jnp.abs(ratio - 1) > near),
        }

    def _value(self, critic: Network, shown: Array) -> Array:
        return self.ideal + critic(shown)[..., 0]


def beside_copies(
    advantage: Float[Array, "n drones"], flown: Float[Array, "n drones"], copies: int
) -> Float[Array, "n drones"]:
    """Advantages less the mean of the drone's copies at the same command.

    Copies began alike and see the same noise, so what the value network errs by is nearly the same in all of them; what
    is left is what their own actions made of it. A copy's command does not depend on the others' advantages, so the
    gradient stays unbiased, but for the factor (copies - 1) / copies.

    Args:
        advantage: generalised advantages (Schulman et al. 2016); copies beside each other.
        flown: one for commands that were flown, zero for those of a copy that is lost.
        copies: of every drone; 1: nothing is changed.
    """
    if copies == 1:
        return advantage
    of_each, flown = (x.reshape(len(x), -1, copies) for x in (advantage, flown))
    mean = jnp.sum(flown * of_each, axis=-1, keepdims=True) / jnp.maximum(jnp.sum(flown, axis=-1, keepdims=True), 1.0)
    return (of_each - mean).reshape(advantage.shape)


def _logits(actor: Actor, seen: Array) -> Array:
    loc = actor.network(seen)
    return jnp.concatenate([loc, jnp.broadcast_to(actor.raw_std, loc.shape)], axis=-1)
