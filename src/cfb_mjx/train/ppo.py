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
from cfb_mjx.engine.draws import normal
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
        learn = self.devices.divided(self._learn, (None,) * 5, None)
        learnt = state.actor, state.critic, state.optimizer, state.rate
        (actor, critic, optimizer, rate), losses = learn(learnt, weights, data, last, of_learning)
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
            loc, scale = actor.network(shown["seen"]), self._std(actor)
            raw = loc + scale * noise
            action = self.distribution.postprocess(raw)
            after, outcome = jax.vmap(partial(step, self.task))(episodes, 0.5 * (1 + action))
            failed, timed_out = outcome.failed | lost, outcome.timed_out & ~lost
            over = jnp.all(failed.reshape(-1, copies), axis=1) | jnp.any(timed_out.reshape(-1, copies), axis=1)
            over = jnp.repeat(over, copies)
            kept = shown | {
                "raw": raw,
                "log_prob": _log_prob(loc.T, scale[:, None], raw.T),
                "reward": self.settings.reward_scaling * jnp.maximum(outcome.reward, self.settings.least_reward),
                "failed": 1.0 * failed,
                "cut": 1.0 * (over & ~failed),
                "flown": 1.0 * ~lost,
            }
            after = choose(over, fresh, choose(failed, episodes, after))
            return (after, failed & ~over), (kept, outcome)

        return jax.lax.scan(some, episodes, (of_reset, noise))

    def _learn(
        self, learnt: tuple, weights: tuple[Array, Array], data: dict[str, Array], last: Array, key: PRNGKeyArray
    ) -> tuple[tuple, dict[str, Array]]:
        """Learn from the flights of all drones; every device takes its share of each batch, and all learn the same."""
        count, copies = self.settings.minibatches, self.settings.copies

        def epoch(learnt, key):
            of_order, of_entropy = jax.random.split(key)
            # A batch consists of the whole flights of some drones.
            order = jax.random.permutation(of_order, self.settings.drones // copies)
            order = (copies * order[:, None] + jnp.arange(copies)).reshape(count, -1)
            return jax.lax.scan(one, learnt, (order, jax.random.split(of_entropy, count)))

        def one(learnt, batch):
            actor, critic, optimizer, rate = learnt
            drones, keys = self.devices.own(batch[0]), self.devices.own(jax.random.split(batch[1], len(batch[0])))
            flights = {name: x[:, drones] for name, x in data.items()}
            loss = jax.grad(self._loss, has_aux=True)
            gradient, metrics = self.devices.total(loss((actor, critic), weights, flights, last[drones], keys))
            spread = metrics.pop("squares") - metrics.pop("returns") ** 2
            metrics["value_explained"] = 1 - 4 * metrics["value_loss"] / spread
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

        learnt, metrics = jax.lax.scan(epoch, learnt, jax.random.split(key, self.settings.epochs))
        return learnt, jax.tree.map(jnp.mean, metrics)

    def _loss(
        self,
        both: tuple[Actor, Network],
        weights: tuple[Array, Array],
        flights: dict[str, Array],
        last: Float[Array, "drones hidden"],
        keys: PRNGKeyArray,
    ) -> tuple[Array, dict[str, Array]]:
        """Loss of a batch, and metrics: this device's addends, which `cfb_mjx.devices.Devices.total` adds up.

        Args:
            both: policy and value network.
            weights: of what the policy learns, and of the entropy.
            flights: this device's share of the batch: values of `_fly`, (unroll, drones, ...).
            last: what the value network sees after the flights.
            keys: a key per drone.
        """
        (actor, critic), settings, total, flown = both, self.settings, self.devices.total, flights["flown"]
        seen, hidden, raw = (_columns(flights[name]) for name in ("seen", "hidden", "raw"))
        values = self._value(critic, hidden).reshape(flown.shape)
        # Computed again for every batch, because the value network learns from the same flights.
        returns, advantage = self.brax.losses.compute_gae(
            truncation=flights["cut"],
            termination=flights["failed"],
            rewards=flights["reward"],
            values=values,
            bootstrap_value=self._value(critic, last.T),
            lambda_=settings.gae_lambda,
            discount=settings.discount,
        )
        # Change from one command to the next of the same flight.
        follows = (flown * (1 - flights["failed"]) * (1 - flights["cut"]))[:-1] * flown[1:]
        advantage = beside_copies(advantage, flown, settings.copies)
        commands, pairs, size = total((jnp.sum(flown), jnp.sum(follows), jnp.sum(flown * jnp.abs(advantage))))
        most = settings.advantage_limit * size / commands
        advantage = jnp.clip(advantage, -most, most)
        sums = total((jnp.sum(flown * advantage), jnp.sum(flown * advantage**2)))
        mean, square = (x / commands for x in sums)
        advantage = (advantage - mean) / (jnp.sqrt(jnp.maximum(square - mean**2, 0.0)) + 1e-8)

        raw = raw.reshape(4, *flown.shape)
        loc, scale = actor.network.columns(seen).reshape(raw.shape), self._std(actor)[:, None, None]
        log_ratio = _log_prob(loc, scale, raw) - flights["log_prob"]
        ratio = jnp.exp(log_ratio)
        near = settings.clipping
        gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - near, 1 + near) * advantage)
        noise = jnp.moveaxis(jax.vmap(lambda key: normal(key, (4, len(flown)), raw.dtype))(keys), 0, -1)
        # Of the Gaussian in closed form; what the tanh takes of it, at random commands.
        entropy = jnp.sum(
            0.5 * math.log(2 * math.pi * math.e) + jnp.log(scale) + _log_slope(loc + scale * noise), axis=0
        )
        change = jnp.sum(jnp.diff(jnp.tanh(loc), axis=1) ** 2, axis=0)

        def mean_of(x):
            return jnp.sum(flown * x) / commands

        metrics = {
            "value_loss": mean_of((returns - values) ** 2) / 4,
            "entropy": mean_of(entropy),
            "change": jnp.sum(follows * change) / jnp.maximum(pairs, 1.0),
            # The low-variance estimator (Schulman, Approximating KL divergence, 2020).
            "kl": mean_of(ratio - 1 - log_ratio),
            "clipped": mean_of(jnp.abs(ratio - 1) > near),
            # Relative to the value of the best flight, which is large beside their spread.
            "returns": mean_of(returns - self.ideal),
            "squares": mean_of((returns - self.ideal) ** 2),
        }
        learning = weights[0] * (mean_of(gain) - settings.smoothness * metrics["change"])
        loss = metrics["value_loss"] - learning - weights[1] * metrics["entropy"]
        return loss, metrics | {"loss": loss}

    def _value(self, critic: Network, shown: Float[Array, "hidden n"]) -> Float[Array, " n"]:
        return self.ideal + critic.columns(shown)[0]

    def _std(self, actor: Actor) -> Float[Array, "4"]:
        """Standard deviations of the Gaussian before the tanh."""
        return self.distribution.create_dist(jnp.concatenate([actor.raw_std, actor.raw_std])).scale


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


def _columns(x: Float[Array, "n drones size"]) -> Float[Array, "size m"]:
    """All commands of all drones side by side, which is how XLA multiplies matrices fastest on CPUs."""
    return jax.lax.optimization_barrier(x.reshape(-1, x.shape[-1]).T)


def _log_prob(
    loc: Float[Array, "4 ..."], scale: Float[Array, "4 ..."], raw: Float[Array, "4 ..."]
) -> Float[Array, "..."]:
    """Logarithm of the density of commands before the tanh, which changes all densities by the same factor."""
    return -jnp.sum(0.5 * ((raw - loc) / scale) ** 2 + jnp.log(scale) + 0.5 * math.log(2 * math.pi), axis=0)


def _log_slope(raw: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Logarithm of the derivative of tanh."""
    return 2 * (math.log(2.0) - raw - jax.nn.softplus(-2 * raw))
