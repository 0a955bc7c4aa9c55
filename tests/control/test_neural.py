"""Neural controllers and their files."""

import io
import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.control.neural import Network, NeuralController
from cfb_mjx.control.policy_file import PolicyFile, load_policy, save_policy
from cfb_mjx.envs import Layout, StateEstimate
from cfb_mjx.errors import CfbError

LAYOUT = Layout(past_estimates=2, past_commands=3, integral=True)


def a_policy(**options) -> PolicyFile:
    controller = NeuralController.random(jax.random.PRNGKey(0), LAYOUT, **options)
    return PolicyFile(controller, "target", {"config": {"seed": 0}})


@pytest.mark.parametrize("activation", ["tanh", "relu", "swish"])
def test_the_network_is_plain_matrix_algebra(activation):
    network = Network.random(jax.random.PRNGKey(1), (5, 7, 6, 4), activation)
    x = np.random.default_rng(0).normal(size=5)
    functions = {"tanh": np.tanh, "relu": lambda v: np.maximum(v, 0), "swish": lambda v: v / (1 + np.exp(-v))}
    wanted = x
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        wanted = np.asarray(bias) + np.sum(np.asarray(weight) * wanted[:, None], axis=0)
        wanted = functions[activation](wanted) if i < 2 else wanted
    np.testing.assert_allclose(network(jnp.asarray(x)), wanted, rtol=1e-12)


def test_an_untrained_controller_hovers_blindly_and_stays_in_range():
    controller = NeuralController.random(jax.random.PRNGKey(0), LAYOUT, hover=0.55)
    rest = StateEstimate(jnp.zeros(3), jnp.zeros(3), jnp.array([1.0, 0, 0, 0]), jnp.zeros(3))
    memory, command = controller.command(controller.start(rest, jnp.full(4, 0.55)), rest)
    np.testing.assert_allclose(command, 0.55, atol=0.02)
    np.testing.assert_allclose(memory.commands[0], 2 * command - 1)
    wild = controller.act(1e3 * jnp.ones(LAYOUT.size))
    assert np.all((wild >= 0) & (wild <= 1))


def test_a_policy_survives_its_file(tmp_path):
    policy = a_policy(hidden=(8, 6), activation="swish")
    save_policy(policy, tmp_path / "p.npz")
    again = load_policy(tmp_path / "p.npz")
    assert again.task == "target"
    assert again.training == policy.training
    assert again.card == ""
    save_policy(replace(policy, card="# Mine\n"), tmp_path / "p.npz")
    assert load_policy(tmp_path / "p.npz").card == "# Mine\n"
    assert load_policy(tmp_path / "p.npz").weights_sha256 == policy.weights_sha256
    assert again.controller.layout == LAYOUT
    assert again.weights_sha256 == policy.weights_sha256
    shown = jnp.linspace(-1, 1, LAYOUT.size)
    np.testing.assert_allclose(again.controller.act(shown), policy.controller.act(shown), atol=1e-6)


def test_the_same_policy_is_the_same_file(tmp_path):
    save_policy(a_policy(), tmp_path / "a.npz")
    save_policy(a_policy(), tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def _truncated(path):
    path.write_bytes(path.read_bytes()[:500])


def _an_array():
    file = io.BytesIO()
    np.save(file, np.zeros(3))
    return file.getvalue()


def _with(path, **changes):
    with np.load(path) as archive:
        arrays = dict(archive)
    arrays.update({key: value(arrays[key]) for key, value in changes.items()})
    np.savez(path, **arrays)


DAMAGE = {
    "truncated": _truncated,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("weights"),
    "another archive": lambda path: np.savez(path, x=np.zeros(3)),
    "an array": lambda path: path.write_bytes(_an_array()),
    "a nan": lambda path: _with(path, weight_1=lambda w: np.full_like(w, np.nan)),
    "another shape": lambda path: _with(path, weight_1=lambda w: w[:-1]),
    "another format": lambda path: _with(
        path, about=lambda a: np.frombuffer(json.dumps({**json.loads(a.tobytes()), "format": "9"}).encode(), np.uint8)
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_policies_are_refused_by_name(tmp_path, damage):
    path = tmp_path / "p.npz"
    save_policy(a_policy(), path)
    DAMAGE[damage](path)
    with pytest.raises(CfbError, match=r"p\.npz"):
        load_policy(path)


def test_a_missing_policy_is_refused_by_name(tmp_path):
    with pytest.raises(CfbError, match=r"none\.npz: there is no such file"):
        load_policy(tmp_path / "none.npz")
