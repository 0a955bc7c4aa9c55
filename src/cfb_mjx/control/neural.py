"""A small fully connected network as a controller."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.envs.observation import Estimate, Layout, Memory, observation, remember, start

ACTIVATIONS: dict[str, Callable] = {"tanh": jnp.tanh, "relu": jax.nn.relu, "swish": jax.nn.swish}


class Network(eqx.Module):
    """Weights (inputs, outputs) and biases, first layer first; the activation stands between layers."""

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    activation: str = eqx.field(static=True, default="tanh")

    @classmethod
    def random(cls, key: PRNGKeyArray, sizes: tuple[int, ...], activation: str = "tanh", last: float = 1.0) -> Network:
        """LeCun-uniform weights, zero biases; those of the last layer scaled by ``last``."""
        weights = []
        for i, (inputs, outputs) in enumerate(pairwise(sizes)):
            bound = (3 / inputs) ** 0.5 * (last if i == len(sizes) - 2 else 1.0)
            weights.append(jax.random.uniform(jax.random.fold_in(key, i), (inputs, outputs), float, -bound, bound))
        return cls(tuple(weights), tuple(jnp.zeros(n) for n in sizes[1:]), activation)

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        return self._through(lambda weight, bias, x: x @ weight + bias, x)

    def columns(self, x: Float[Array, "inputs drones"]) -> Float[Array, "outputs drones"]:
        """The same for many whose axis is the last one."""
        # Of an x that was just put together, XLA would otherwise make a product per part, and add those up.
        x = jax.lax.optimization_barrier(x)
        return self._through(lambda weight, bias, x: weight.T @ x + bias[:, None], x)

    def _through(self, layer: Callable, x: Array) -> Array:
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = ACTIVATIONS[self.activation](layer(weight, bias, x))
        return layer(*last, x)


_SUMS_FAIL = jax.__version_info__ >= (0, 11)
"""On jaxlib 0.12 such a sum over at most `_FEW` columns does not compile ("Fusion kind not implemented on CPU")."""
_FEW = 8


class WrittenOut(Network):
    """The same with its products written as sums: for within one compiled function, where XLA has no matrix library."""

    def columns(self, x: Float[Array, "inputs drones"]) -> Float[Array, "outputs drones"]:
        def layer(weight, bias, x):
            if _SUMS_FAIL and x.shape[1] <= _FEW:
                return weight.T @ x + bias[:, None]
            return jnp.sum(weight[:, :, None] * x[:, None, :], axis=0) + bias[:, None]

        return self._through(layer, x)


class NeuralController(eqx.Module):
    """A network that turns observations into commands u = (1 + tanh(output)) / 2.

    `start` and `command` also take many drones whose axis is the last one of every array (`cfb_mjx.envs.observation`).
    """

    network: Network
    layout: Layout = eqx.field(static=True, default_factory=Layout)

    @classmethod
    def random(
        cls,
        key: PRNGKeyArray,
        layout: Layout,
        hidden: tuple[int, ...] = (32, 32, 32, 32),
        activation: str = "tanh",
        hover: float = 0.55,
    ) -> NeuralController:
        """A controller that commands about ``hover`` whatever it sees."""
        network = Network.random(key, (layout.size, *hidden, 4), activation, last=0.01)
        bias = jnp.full(4, jnp.arctanh(2 * hover - 1))
        return cls(eqx.tree_at(lambda n: n.biases[-1], network, bias), layout)

    @property
    def control_dt_s(self) -> float:
        """Time between two commands, s."""
        return self.layout.control_dt_s

    def act(self, shown: Float[Array, " size *drones"]) -> Float[Array, " 4 *drones"]:
        """Command in (0, 1) on an observation."""
        network = self.network if shown.ndim == 1 else self.network.columns
        return 0.5 * (1 + jnp.tanh(network(shown)))

    def written_out(self) -> NeuralController:
        """The same for within one compiled function (`WrittenOut`)."""
        network = self.network
        return NeuralController(WrittenOut(network.weights, network.biases, network.activation), self.layout)

    def start(self, estimate: Estimate, command: Float[Array, " 4 *drones"] | float = 0.55) -> Memory:
        """Memory of a controller that takes over: it has commanded ``command`` on ``estimate`` for long."""
        return start(self.layout, estimate, command)

    def command(
        self, memory: Memory, estimate: Estimate, setpoint: Float[Array, " setpoints *drones"] | None = None
    ) -> tuple[Memory, Float[Array, " 4 *drones"]]:
        """New memory and command; called every ``layout.control_dt_s``. Policies with set-points need them."""
        u = self.act(observation(self.layout, memory, estimate, setpoint))
        return remember(self.layout, memory, estimate, u), u
