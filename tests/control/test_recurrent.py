"""Policies with a gated recurrent unit fly, are kept, exported and converted like any other."""

from __future__ import annotations

import json
import shutil

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.cli import main
from cfb_mjx.control import (
    Gru,
    Network,
    NeuralController,
    PolicyFile,
    find_controller,
    foreign_controller,
    load_policy,
    rollout_closed_loop,
    save_policy,
)
from cfb_mjx.control.manoeuvre import Manoeuvre, load_manoeuvre
from cfb_mjx.deploy import compare, compile_policy, cortex, export_policy
from cfb_mjx.deploy.check import random_inputs
from cfb_mjx.deploy.deployment import Deployment
from cfb_mjx.envs import Layout, StateEstimate, TargetTask
from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_model_file
from cfb_mjx.train.flying import hover

LAYOUT = Layout(past_estimates=1, past_commands=2)
COMPILER = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")


def pytorch(seed: int = 0, first: tuple[int, ...] = (9,), size: int = 6, mark: str = "_l0", scale: float = 0.7) -> dict:
    """Names and shapes of a ``state_dict()``: linear layers, a GRU, a linear layer."""
    rng = np.random.default_rng(seed)

    def drawn(*shape):
        return (scale * rng.normal(size=shape)).astype(np.float32)

    found, inputs = {}, LAYOUT.size
    for i, outputs in enumerate(first):
        found |= {f"body.{2 * i}.weight": drawn(outputs, inputs) / 3, f"body.{2 * i}.bias": drawn(outputs)}
        inputs = outputs
    # Sums of about one, whatever there is to sum: beyond, a unit forgets nothing that it rounded.
    found |= {
        f"gru.weight_ih{mark}": drawn(3 * size, inputs) * 3 / max(9, inputs),
        f"gru.weight_hh{mark}": drawn(3 * size, size),
    }
    found |= {f"gru.bias_ih{mark}": drawn(3 * size), f"gru.bias_hh{mark}": drawn(3 * size)}
    return found | {"head.weight": drawn(4, size), "head.bias": drawn(4) / 3}


def by_hand(state: dict, rows: np.ndarray, mark: str = "_l0") -> np.ndarray:
    """A sequence of observations through the layers, gate by gate, as PyTorch's manual writes them."""

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    state = {name: x.astype(float) for name, x in state.items()}
    size = state["head.weight"].shape[1]
    hidden, outputs = np.zeros(size), []
    for x in rows:
        for name in ("body.0", "body.2"):
            if f"{name}.weight" in state:
                x = np.tanh(state[f"{name}.weight"] @ x + state[f"{name}.bias"])
        ir, iz, ic = np.split(state[f"gru.weight_ih{mark}"] @ x + state[f"gru.bias_ih{mark}"], 3)
        hr, hz, hc = np.split(state[f"gru.weight_hh{mark}"] @ hidden + state[f"gru.bias_hh{mark}"], 3)
        r, z = sigmoid(ir + hr), sigmoid(iz + hz)
        hidden = (1 - z) * np.tanh(ic + r * hc) + z * hidden
        outputs.append(np.tanh(state["head.weight"] @ hidden + state["head.bias"]))
    return np.array(outputs)


def advanced(controller: NeuralController, rows: np.ndarray) -> np.ndarray:
    """Outputs of the network, -1 to 1, on a sequence of observations."""
    hidden, found = jnp.zeros(controller.network.gru.size), []
    for x in rows:
        output, hidden = controller.network.advance(jnp.asarray(x), hidden)
        found.append(np.tanh(output))
    return np.array(found)


def steady(seed: int = 2, size: int = 8) -> NeuralController:
    """A shipped policy with a unit in the place of its last layer; it flies, and its state matters."""
    known = load_policy("target").controller
    *first, (last, bias) = zip(known.network.weights, known.network.biases, strict=True)
    rng, more = np.random.default_rng(seed), size - 4
    # Open update gates, and candidates where tanh is nearly straight: four numbers are handed through, others drawn.
    narrow, gates = 0.2, np.concatenate([np.zeros(size), np.full(size, -3.0), np.zeros(size)])
    through = np.concatenate([narrow * np.asarray(last), 0.1 * rng.normal(size=(len(last), more))], axis=1)
    seen = np.concatenate([0.1 * rng.normal(size=(len(last), 2 * size)), through], axis=1)
    gates[-size : -size + 4] = narrow * np.asarray(bias)
    kept = 0.02 * rng.normal(size=(size, 3 * size))
    gru = Gru(*(jnp.asarray(x, jnp.float32) for x in (seen, gates, kept, np.zeros(3 * size))))
    head = np.concatenate([np.eye(4) / narrow, 0.02 * rng.normal(size=(more, 4))])
    weights = *(w for w, _ in first), jnp.asarray(head, jnp.float32)
    biases = *(b for _, b in first), jnp.zeros(4, "float32")
    return NeuralController(Network(weights, biases, known.network.activation, "tanh", gru, len(first)), known.layout)


@pytest.mark.parametrize(("mark", "first"), [("_l0", (9,)), ("", (7, 8)), ("_l0", ())])
def test_a_gru_of_pytorch_is_the_one_its_manual_writes(mark, first):
    state, rows = pytorch(first=first, mark=mark), np.random.default_rng(1).normal(size=(12, LAYOUT.size))
    controller = foreign_controller(state, LAYOUT, activation="tanh", limit="tanh")
    np.testing.assert_allclose(advanced(controller, rows), by_hand(state, rows, mark), atol=1e-6)
    assert np.abs(advanced(controller, rows[:, ::1])[-1] - advanced(controller, rows[-1:])[-1]).max() > 1e-3
    mean, std = np.full(LAYOUT.size, 0.3), np.full(LAYOUT.size, 1.7)
    folded = foreign_controller(state, LAYOUT, activation="tanh", limit="tanh", mean=mean, std=std)
    np.testing.assert_allclose(advanced(folded, rows), by_hand(state, (rows - mean) / std, mark), atol=1e-5)


class Policy(nn.Module):
    """Two layers of one width, so that sizes alone do not say where the unit is."""

    same: bool

    @nn.compact
    def __call__(self, hidden, x):
        x = nn.relu(nn.Dense(6 if self.same else 7)(x))
        hidden, x = nn.GRUCell(6)(hidden, x)
        x = nn.relu(nn.Dense(6)(x)) if self.same else x
        return hidden, jnp.tanh(nn.Dense(4)(x))


@pytest.mark.parametrize("same", [False, True])
def test_a_flax_cell_flies_as_flax_applies_it(same):
    module, rows = Policy(same), np.random.default_rng(1).normal(size=(12, LAYOUT.size))
    hidden = jnp.zeros(6)
    variables = module.init(jax.random.key(3), hidden, jnp.asarray(rows[0]))
    grown = jax.tree.map(lambda x: 1.5 * x + 0.1, variables)
    if same:
        with pytest.raises(CfbError, match="gru_after"):
            foreign_controller(grown["params"], LAYOUT, activation="relu", limit="tanh")
    given = {"gru_after": 1} if same else {}
    controller = foreign_controller(grown["params"], LAYOUT, activation="relu", limit="tanh", **given)
    expected = []
    for x in rows:
        hidden, u = module.apply(grown, hidden, jnp.asarray(x))
        expected.append(u)
    np.testing.assert_allclose(advanced(controller, rows), np.array(expected), atol=1e-6)


def test_other_recurrent_layers_are_refused_in_one_sentence():
    def convert(state, **more):
        return foreign_controller(state, LAYOUT, **{"activation": "tanh", "limit": "tanh"} | more)

    state = pytorch()
    for mark in ("_l1", "_l0_reverse"):
        more = {name.replace("_l0", mark): x for name, x in state.items() if "gru" in name}
        with pytest.raises(CfbError, match=r"a GRU of one layer and one direction; gru has more"):
            convert(state | more)
    lstm = state | {"gru.weight_ih_l0": np.zeros((24, 9)), "gru.weight_hh_l0": np.zeros((24, 6))}
    with pytest.raises(CfbError, match=r"gru is another kind, an LSTM for instance\.$"):
        convert(lstm)
    cell = nn.OptimizedLSTMCell(6)
    carry = cell.initialize_carry(jax.random.key(0), (9,))
    params = cell.init(jax.random.key(0), carry, jnp.zeros(9))["params"]
    with pytest.raises(CfbError, match="cell is another kind"):
        convert({"cell": params, "last": {"kernel": np.zeros((6, 4)), "bias": np.zeros(4)}})
    with pytest.raises(CfbError, match="found 2"):
        convert(state | {name.replace("gru", "other"): x for name, x in state.items() if "gru" in name})
    with pytest.raises(CfbError, match="gru_after must be from 0 to 1"):
        convert(state, gru_after=2)
    with pytest.raises(CfbError, match=rf"found {LAYOUT.size} x 9, 8 x 6, 6 x 4"):
        convert(state | {"gru.weight_ih_l0": np.zeros((18, 8))})


def test_the_network_alone_does_not_command():
    controller = foreign_controller(pytorch(), LAYOUT, activation="tanh", limit="tanh")
    with pytest.raises(CfbError, match="recurrent"):
        controller.act(jnp.zeros(LAYOUT.size))


def test_many_drones_along_the_last_axis_are_each_alone():
    controller = foreign_controller(pytorch(), LAYOUT, activation="tanh", limit="clip")
    rng = np.random.default_rng(4)
    q = rng.normal(size=(4, 3))
    seen = StateEstimate(
        *(jnp.asarray(x) for x in (rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), q, rng.normal(size=(3, 3))))
    )
    memory, us = controller.start(seen, 0.5), []
    for _ in range(3):
        memory, u = controller.command(memory, seen)
        us.append(u)
    for i in range(3):
        alone = jax.tree.map(lambda x, i=i: x[..., i], seen)
        single = controller.start(alone, 0.5)
        for u in us:
            single, mine = controller.command(single, alone)
            np.testing.assert_allclose(u[:, i], mine, atol=1e-12)


def test_it_hovers_and_survives_its_file(tmp_path):
    controller = steady()
    save_policy(PolicyFile(controller, "target"), tmp_path / "gru.npz")
    read = load_policy(tmp_path / "gru.npz")
    about = json.loads(np.load(tmp_path / "gru.npz")["about"].tobytes())
    assert about["format"] == "cfb_mjx policy 1"
    assert about["gru"]["size"] == controller.network.gru.size
    assert about["weights_sha256"] == read.weights_sha256 == PolicyFile(controller, "target").weights_sha256
    other = steady(seed=3)
    assert PolicyFile(other, "target").weights_sha256 != read.weights_sha256, "the unit is hashed too"
    drone = Quadrotor.from_file(load_model_file("cfb-guards"))
    found = find_controller(tmp_path / "gru.npz", drone)
    np.testing.assert_array_equal(found.network.gru.hidden_weight, controller.network.gru.hidden_weight)
    measured, _ = hover(found, TargetTask(layout=found.layout), drone, jax.random.split(jax.random.key(0), 3))
    assert not measured.failed.any()
    assert measured.mean_distance_m.max() < 0.2


@pytest.mark.parametrize("drones", [1, 3, 40])
def test_closed_loops_of_many_are_those_of_one(drones):
    controller, drone = steady(), Quadrotor.from_file(load_model_file("cfb-guards"))
    starts = [drone.hover_state((0.1 * i, -0.2, 0.3)) for i in range(drones)]
    many = jax.tree.map(lambda *x: jnp.stack(x), *starts)
    flown = jax.vmap(lambda state: rollout_closed_loop(drone, controller, state, 50, every=25))(many)
    alone = rollout_closed_loop(drone, controller, starts[-1], 50, every=25)
    np.testing.assert_allclose(flown.command[-1], alone.command, atol=1e-9)
    np.testing.assert_allclose(flown.memory.hidden[-1], alone.memory.hidden, atol=1e-9)
    assert np.abs(alone.memory.hidden).max() > 1e-4
    # Continued from its memory, the flight is the same.
    half = rollout_closed_loop(drone, controller, starts[-1], 25)
    state = jax.tree.map(lambda x: x[-1], half.state)
    rest = rollout_closed_loop(drone, controller, state, 25, memory=half.memory)
    np.testing.assert_allclose(rest.command[-1], alone.command[-1], atol=1e-9)


DAMAGE = {
    "no array": lambda arrays: arrays.pop("gru_hidden_bias"),
    "a nan": lambda arrays: arrays["gru_input_weight"].fill(np.nan),
    "another shape": lambda arrays: arrays.update(gru_hidden_weight=arrays["gru_hidden_weight"][:-1]),
    "a row too many": lambda arrays: arrays.update(gru_input_weight=np.ones((99, 18))),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_refused_by_name(tmp_path, damage):
    controller = foreign_controller(pytorch(), LAYOUT, activation="tanh", limit="tanh")
    save_policy(PolicyFile(controller, "target"), tmp_path / "gru.npz")
    arrays = dict(np.load(tmp_path / "gru.npz"))
    DAMAGE[damage](arrays)
    np.savez(tmp_path / "gru.npz", **arrays)
    with pytest.raises(CfbError, match=r"gru\.npz"):
        load_policy(tmp_path / "gru.npz")


@COMPILER
@pytest.mark.parametrize(("first", "activation"), [((9,), "relu"), ((7, 8), "swish"), ((), "tanh")])
def test_it_computes_the_same_in_c(tmp_path, first, activation):
    controller = foreign_controller(pytorch(first=first), LAYOUT, activation=activation, limit="clip")
    deployment = Deployment("gru", PolicyFile(controller, "target"))
    exported = export_policy(deployment, tmp_path)
    strict = ("-pedantic", "-Wconversion", "-Wdouble-promotion", "-Wshadow")
    found = compare(deployment, compile_policy(exported, strict), sequences=500, steps=40)
    assert found.largest < 1e-5, found
    contract = json.loads((tmp_path / "contract.json").read_text())["policies"]["holder"]
    assert contract["gru"]["after_layers"] == len(first)
    assert contract["layers"] == [LAYOUT.size, *first, 6, 4]
    assert contract["multiply_accumulates"] == cortex.multiply_accumulates(deployment)


@COMPILER
def test_a_state_that_moves_on_is_seen_by_the_check(tmp_path):
    """With another state the comparison fails: the sequences are long enough to tell."""
    state = pytorch()
    right = foreign_controller(state, LAYOUT, activation="tanh", limit="tanh")
    wrong = foreign_controller(
        state | {"gru.weight_hh_l0": 0 * state["gru.weight_hh_l0"]}, LAYOUT, activation="tanh", limit="tanh"
    )
    exported = export_policy(Deployment("gru", PolicyFile(right, "target")), tmp_path)
    against = Deployment("gru", PolicyFile(wrong, "target"))
    assert compare(against, compile_policy(exported), sequences=20).largest > 0.01


@COMPILER
def test_bad_estimates_do_not_move_the_state_and_a_reset_empties_it(tmp_path):
    controller = foreign_controller(pytorch(), LAYOUT, activation="tanh", limit="tanh")
    compiled = compile_policy(export_policy(Deployment("gru", PolicyFile(controller, "target")), tmp_path))
    rows = random_inputs(np.random.default_rng(6), 1, 8)[0]
    compiled.reset()
    whole = compiled.steps(rows)
    compiled.reset()
    first = compiled.steps(rows[:4])
    compiled.steps(np.full((2, 16), np.nan))
    assert compiled.fault == 1
    np.testing.assert_array_equal(np.concatenate([first, compiled.steps(rows[4:])]), whole)
    assert np.abs(compiled.steps(rows[:1]) - whole[:1]).max() > 1e-3


@COMPILER
def test_the_command_checks_it_in_closed_loop_and_on_the_emulated_processor(tmp_path, capfd):
    save_policy(PolicyFile(steady(), "target"), tmp_path / "gru.npz")
    assert main(["export", str(tmp_path / "gru.npz"), "-o", str(tmp_path / "c"), "--check"]) == 0, capfd.readouterr()
    found = json.loads((tmp_path / "c" / "check.json").read_text())
    assert found["passed"]
    assert found["parity"]["largest"] < 1e-5
    if cortex.has_emulator():
        assert found["cortex_m4"]["emulated_command_difference"] < 1e-6


@COMPILER
@pytest.mark.skipif(not cortex.has_emulator(), reason="qemu-system-arm is not installed")
def test_the_estimate_of_the_instructions_is_above_what_is_counted(tmp_path):
    controller = foreign_controller(pytorch(size=32), LAYOUT, activation="tanh", limit="tanh")
    deployment = Deployment("gru", PolicyFile(controller, "target"))
    run = cortex.emulate(export_policy(deployment, tmp_path), random_inputs(np.random.default_rng(2), 48, 1)[:, 0])
    assert run.instructions.max() < cortex.estimated_instructions(deployment)
    assert run.instructions.min() > 4 * cortex.multiply_accumulates(deployment)


def test_a_fully_connected_policy_is_exported_as_before(tmp_path):
    export_policy(Deployment("target", load_policy("target")), tmp_path)
    assert not any("gru" in path.read_text() or "hidden" in path.read_text() for path in tmp_path.glob("cfb_*.[ch]"))


def test_flips_and_trainings_refuse_it(tmp_path):
    gru = foreign_controller(pytorch(), LAYOUT, activation="tanh", limit="tanh")
    with pytest.raises(CfbError, match="recurrent"):
        Manoeuvre(gru, load_policy("flip").controller, load_manoeuvre("flip").knobs)
    save_policy(PolicyFile(gru, "target"), tmp_path / "gru.npz")
    with pytest.raises(CfbError, match="has a GRU"):
        _prepared(tmp_path / "gru.npz")


def _prepared(start):
    from cfb_mjx.train.config import load_config
    from cfb_mjx.train.run import Training

    return Training.prepare(load_config("quick"), {}, start)
