"""Networks as controllers: fully connected layers, with a gated recurrent unit among them if wanted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.envs.observation import Layout, Memory, StateEstimate, observation, remember, start
from cfb_mjx.errors import CfbError
from cfb_mjx.optional import not_none

ACTIVATIONS: dict[str, Callable] = {"tanh": jnp.tanh, "relu": jax.nn.relu, "swish": jax.nn.swish}
LIMITS: dict[str, Callable] = {"tanh": jnp.tanh, "clip": lambda x: jnp.clip(x, -1.0, 1.0)}
"""Functions that bring the last layer to -1..1."""
WRITTEN = {"tanh": "tanh(output)", "clip": "clip(output, -1, 1)"}
"""The same, as policy files and contracts write them."""


class Gru(eqx.Module):
    """A gated recurrent unit of n numbers: h = (1 - z) c + z h, with the gates r, z and the candidate c of

        r = sigmoid(x Wr + br + h Ur + dr),  z = sigmoid(x Wz + bz + h Uz + dz),  c = tanh(x Wc + bc + r (h Uc + dc)).

    This is the unit of PyTorch, Flax and cuDNN, with the reset gate r inside the candidate. Every array holds reset,
    update and candidate side by side.
    """

    input_weight: Float[Array, "inputs gates"]
    """[Wr, Wz, Wc], (inputs, 3 n)."""
    input_bias: Float[Array, " gates"]
    """[br, bz, bc], (3 n,)."""
    hidden_weight: Float[Array, "n gates"]
    """[Ur, Uz, Uc], (n, 3 n)."""
    hidden_bias: Float[Array, " gates"]
    """[dr, dz, dc], (3 n,)."""

    @property
    def size(self) -> int:
        """Numbers that are kept from one step to the next, n."""
        return self.hidden_weight.shape[0]

    def __call__(self, x: Float[Array, " inputs *drones"], hidden: Float[Array, " n *drones"]) -> Array:
        """Return the new hidden state, (n, *drones), from -1 to 1 if it began there."""

        def layer(weight, bias, x):
            return x @ weight + bias if x.ndim == 1 else weight.T @ x + bias[:, None]

        seen = jnp.split(layer(self.input_weight, self.input_bias, x), 3)
        kept = jnp.split(layer(self.hidden_weight, self.hidden_bias, hidden), 3)
        reset, update = (jax.nn.sigmoid(a + b) for a, b in zip(seen[:2], kept[:2], strict=True))
        return (1 - update) * jnp.tanh(seen[2] + reset * kept[2]) + update * hidden


class Network(eqx.Module):
    """Weights (inputs, outputs) and biases, first layer first; the activation is applied between layers.

    The limit is applied after the last layer, by the controller. A network with a ``gru`` has that unit after its first
    ``before`` layers; nothing is applied to what the unit gives. Its hidden state is part of the controller's memory.
    """

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    activation: str = eqx.field(static=True, default="tanh")
    limit: str = eqx.field(static=True, default="tanh")
    gru: Gru | None = None
    before: int = eqx.field(static=True, default=0)
    """Number of layers before the recurrent unit."""

    @classmethod
    def random(cls, key: PRNGKeyArray, sizes: tuple[int, ...], activation: str = "tanh", last: float = 1.0) -> Network:
        """Draw LeCun-uniform weights, with zero biases; the weights of the last layer are scaled by ``last``."""
        weights = []
        for i, (inputs, outputs) in enumerate(pairwise(sizes)):
            bound = (3 / inputs) ** 0.5 * (last if i == len(sizes) - 2 else 1.0)
            weights.append(jax.random.uniform(jax.random.fold_in(key, i), (inputs, outputs), float, -bound, bound))
        return cls(tuple(weights), tuple(jnp.zeros(n) for n in sizes[1:]), activation)

    @property
    def parts(self) -> list[Array]:
        """All arrays in the order of the computation: weights and biases of each layer, and of the recurrent unit."""
        found = [[weight, bias] for weight, bias in zip(self.weights, self.biases, strict=True)]
        if (gru := self.gru) is not None:
            found.insert(self.before, [gru.input_weight, gru.input_bias, gru.hidden_weight, gru.hidden_bias])
        return [x for layer in found for x in layer]

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Numbers that each layer, and the recurrent unit, takes and gives, first layer first."""
        found = [(weight.shape[0], weight.shape[1]) for weight in self.weights]
        if self.gru is not None:
            found.insert(self.before, (len(self.gru.input_weight), self.gru.size))
        return found

    def fits(self, inputs: int) -> bool:
        """Whether the arrays fit each other, ``inputs`` inputs and four outputs, and the activation is known."""
        gru, layers = self.gru, list(zip(self.weights, self.biases, strict=True))
        if not layers or self.activation not in ACTIVATIONS or any(x.ndim not in (1, 2) for x in self.parts):
            return False
        if gru is not None:
            layers += [(gru.input_weight, gru.input_bias), (gru.hidden_weight, gru.hidden_bias)]
            gates = 3 * gru.size
            if self.before not in range(len(self.weights)) or {len(gru.input_bias), len(gru.hidden_bias)} != {gates}:
                return False
        if any(weight.ndim != 2 or bias.shape != weight.shape[1:] for weight, bias in layers):
            return False
        return [inputs, *(given for _, given in self.sizes)] == [*(taken for taken, _ in self.sizes), 4]

    @property
    def multiply_accumulates(self) -> int:
        """Multiply-accumulates of one evaluation."""
        return sum(int(x.size) for x in self.parts if x.ndim == 2)

    @property
    def activations(self) -> int:
        """Exponentials of one evaluation, at most: one for every output of a layer, three for each of a GRU's."""
        return sum(len(x) for x in self.biases) + (0 if self.gru is None else 3 * self.gru.size)

    def advance(self, x: Float[Array, " inputs *drones"], hidden: Float[Array, " n *drones"]) -> tuple[Array, Array]:
        """Return outputs and new hidden state of a network with a recurrent unit."""
        ahead, after = self.weights[: self.before], self.weights[self.before :]

        def through(weights, biases, x):
            if not weights:
                return x
            part = Network(weights, biases, self.activation)
            return part(x) if x.ndim == 1 else part.columns(x)

        x = through(ahead, self.biases[: self.before], x)
        x = ACTIVATIONS[self.activation](x) if ahead else x
        hidden = not_none(self.gru)(x, hidden)
        return through(after, self.biases[self.before :], hidden), hidden

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        return self._through(lambda weight, bias, x: x @ weight + bias, x)

    def columns(self, x: Float[Array, "inputs drones"]) -> Float[Array, "outputs drones"]:
        """Evaluate for many inputs along the last axis."""

        def layer(weight, bias, x):
            # XLA's library for matrix products is slow for a single row.
            single = weight.shape[1] == 1
            return (jnp.sum(weight * x, axis=0, keepdims=True) if single else weight.T @ x) + bias[:, None]

        # Without the barrier XLA would split the product into one per part of a concatenated x, and add them up.
        return self._through(layer, jax.lax.optimization_barrier(x))

    def _through(self, layer: Callable, x: Array) -> Array:
        if self.gru is not None:
            raise CfbError("a network with a recurrent unit has no output without its hidden state; use advance.")
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = ACTIVATIONS[self.activation](layer(weight, bias, x))
        return layer(*last, x)


_SUMS_FAIL = jax.__version_info__ >= (0, 11)
"""jaxlib 0.12 cannot compile such a sum over at most `_FEW` columns ("Fusion kind not implemented on CPU")."""
_FEW = 8


class WrittenOut(Network):
    """A network with its products written as sums, for one compiled function, in which XLA has no matrix library."""

    def columns(self, x: Float[Array, "inputs drones"]) -> Float[Array, "outputs drones"]:
        def layer(weight, bias, x):
            if _SUMS_FAIL and x.shape[1] <= _FEW:
                return weight.T @ x + bias[:, None]
            return jnp.sum(weight[:, :, None] * x[:, None, :], axis=0) + bias[:, None]

        return self._through(layer, x)


class NeuralController(eqx.Module):
    """A network that turns observations into commands u = (1 + tanh(output)) / 2, or with a clip for the tanh.

    The memory of one with a recurrent unit (`recurrent`) holds the unit's state too, which is zero at the start.
    `start` and `command` also accept many drones along the last axis of every array (`cfb_mjx.envs.observation`).
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
        """Draw a random controller that commands about ``hover`` whatever it sees."""
        network = Network.random(key, (layout.size, *hidden, 4), activation, last=0.01)
        bias = jnp.full(4, jnp.arctanh(2 * hover - 1))
        return cls(eqx.tree_at(lambda n: n.biases[-1], network, bias), layout)

    @property
    def control_dt_s(self) -> float:
        """Time between two commands, s."""
        return self.layout.control_dt_s

    @property
    def recurrent(self) -> bool:
        """Whether the network has a state of its own, which observations alone do not determine."""
        return self.network.gru is not None

    def act(self, shown: Float[Array, " size *drones"]) -> Float[Array, " 4 *drones"]:
        """Return the command, 0 to 1, for an observation.

        Raises:
            CfbError: the network is recurrent; only ``command`` has its state.
        """
        network = self.network if shown.ndim == 1 else self.network.columns
        return self._limited(network(shown))

    def _limited(self, output: Array) -> Array:
        return 0.5 * (1 + LIMITS[self.network.limit](output))

    def written_out(self) -> NeuralController:
        """Return the same controller for use within one compiled function (`WrittenOut`)."""
        network = self.network
        written = WrittenOut(network.weights, network.biases, network.activation, network.limit)
        return NeuralController(written, self.layout)

    def start(self, estimate: StateEstimate, command: Float[Array, " 4 *drones"] | float = 0.55) -> Memory:
        """Return the memory of a controller that has commanded ``command`` on ``estimate`` for long."""
        memory = start(self.layout, estimate, command)
        if (gru := self.network.gru) is None:
            return memory
        like = memory.integral
        nothing = jnp.zeros((gru.size, *like.shape[1:]), jnp.result_type(like, gru.hidden_weight))
        return replace(memory, hidden=nothing)

    def command(
        self, memory: Memory, estimate: StateEstimate, setpoint: Float[Array, " setpoints *drones"] | None = None
    ) -> tuple[Memory, Float[Array, " 4 *drones"]]:
        """New memory and command; call it every ``layout.control_dt_s``. Policies with set-points need ``setpoint``."""
        shown = observation(self.layout, memory, estimate, setpoint)
        if not self.recurrent:
            u = self.act(shown)
            return remember(self.layout, memory, estimate, u), u
        output, hidden = self.network.advance(shown, not_none(memory.hidden))
        u = self._limited(output)
        return replace(remember(self.layout, memory, estimate, u), hidden=hidden), u
