"""Networks of other libraries fly as in their own library."""

from __future__ import annotations

import shutil
from collections import OrderedDict

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.control import PolicyFile, foreign_controller, load_policy, save_policy
from cfb_mjx.deploy import compare, compile_policy, export_policy
from cfb_mjx.deploy.deployment import Deployment
from cfb_mjx.envs import Layout
from cfb_mjx.errors import CfbError

LAYOUT = Layout(past_estimates=1, past_commands=2)
SHOWN = np.random.default_rng(0).normal(size=(200, LAYOUT.size))


class Policy(nn.Module):
    """Eleven hidden layers, so that the order of their names is not that of the alphabet."""

    @nn.compact
    def __call__(self, x):
        for _ in range(11):
            x = nn.swish(nn.Dense(7)(x))
        return jnp.tanh(nn.Dense(4)(x))


def sb3(seed: int = 0, hidden: int = 9) -> OrderedDict:
    """The names and shapes of ``PPO("MlpPolicy", ...).policy.state_dict()``."""
    rng = np.random.default_rng(seed)

    def linear(name, outputs, inputs):
        return {
            f"{name}.weight": 0.4 * rng.normal(size=(outputs, inputs)),
            f"{name}.bias": 0.4 * rng.normal(size=outputs),
        }

    layers = {"log_std": rng.normal(size=4)}
    for net in ("policy_net", "value_net"):
        layers |= linear(f"mlp_extractor.{net}.0", hidden, LAYOUT.size) | linear(
            f"mlp_extractor.{net}.2", hidden, hidden
        )
    return OrderedDict(layers | linear("action_net", 4, hidden) | linear("value_net", 1, hidden))


def by_hand(state: OrderedDict, x: np.ndarray) -> np.ndarray:
    """PyTorch's ``Linear`` is ``x W^T + b``; SB3 clips the mean action to the action space."""
    for name in ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2"):
        x = np.tanh(x @ state[f"{name}.weight"].T + state[f"{name}.bias"])
    return np.clip(x @ state["action_net.weight"].T + state["action_net.bias"], -1.0, 1.0)


def test_a_flax_module_flies_as_flax_applies_it():
    module = Policy()
    variables = module.init(jax.random.key(1), jnp.asarray(SHOWN))
    grown = jax.tree.map(lambda w: 1.7 * w, variables)
    controller = foreign_controller(grown["params"], LAYOUT, activation="swish", limit="tanh")
    expected = 0.5 * (1 + module.apply(grown, jnp.asarray(SHOWN)))
    assert np.std(expected) > 1e-3
    np.testing.assert_allclose(jax.vmap(controller.act)(jnp.asarray(SHOWN)), expected, atol=1e-6)


@pytest.mark.parametrize("normalised", [False, True])
def test_a_policy_of_stable_baselines_flies_as_its_layers_say(normalised, tmp_path):
    state = sb3()
    mean, std = np.random.default_rng(1).normal(size=LAYOUT.size), np.full(LAYOUT.size, 2.5)
    given = {"mean": mean, "std": std} if normalised else {}
    controller = foreign_controller(state, LAYOUT, activation="tanh", limit="clip", **given)
    expected = 0.5 * (1 + by_hand(state, (SHOWN - mean) / std if normalised else SHOWN))
    assert {0.0, 1.0} < set(expected.ravel()), "the clip is reached"
    np.testing.assert_allclose(jax.vmap(controller.act)(jnp.asarray(SHOWN)), expected, atol=1e-10)
    save_policy(PolicyFile(controller, "target"), tmp_path / "policy.npz")
    read = load_policy(tmp_path / "policy.npz").controller
    assert read.network.limit == "clip"
    np.testing.assert_allclose(jax.vmap(read.act)(jnp.asarray(SHOWN)), expected, atol=1e-5)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")
def test_it_computes_the_same_in_c(tmp_path):
    controller = foreign_controller(sb3(), LAYOUT, activation="tanh", limit="clip")
    save_policy(PolicyFile(controller, "target"), tmp_path / "policy.npz")
    deployment = Deployment("sb3", load_policy(tmp_path / "policy.npz"))
    exported = export_policy(deployment, tmp_path)
    assert '"u = (1 + clip(output, -1, 1)) / 2"' in (tmp_path / "contract.json").read_text()
    assert compare(deployment, compile_policy(exported), sequences=500).largest < 1e-5


def test_what_does_not_fit_is_named():
    def convert(state, **more):
        return foreign_controller(state, LAYOUT, **{"activation": "tanh", "limit": "clip"} | more)

    with pytest.raises(CfbError, match="activation must be one of tanh, relu, swish"):
        convert(sb3(), activation="elu")
    with pytest.raises(CfbError, match="both mean and std"):
        convert(sb3(), mean=np.zeros(LAYOUT.size))
    with pytest.raises(CfbError, match="found none"):
        convert({"log_std": np.zeros(4)})
    for more in ("mlp_extractor.policy_net.1.weight", "norm.scale"):  # a LayerNorm, which would be left out
        with pytest.raises(CfbError, match=r"fully connected layers; .* of shape \(9,\) is not of one"):
            convert(sb3() | {more: np.ones(9)})
    eight = sb3() | {"action_net.weight": np.zeros((8, 9)), "action_net.bias": np.zeros(8)}
    with pytest.raises(CfbError, match=r"to 4 outputs.*9 x 8"):
        convert(eight)
    wrong = sb3()
    del wrong["mlp_extractor.policy_net.2.weight"]
    wrong["mlp_extractor.policy_net.0.weight"] = np.zeros((9, 3))
    with pytest.raises(CfbError, match=rf"from {LAYOUT.size} inputs, the layout's, to 4 outputs.*found 3 x 9, 9 x 4"):
        convert(wrong)
