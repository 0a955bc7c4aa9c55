"""Policies as ONNX models: what runtimes compute from them, and models of other libraries as policies."""

from __future__ import annotations

import json
import shutil
import sys
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.cli import main
from cfb_mjx.control import PolicyFile, load_policy, read_onnx, save_policy, write_onnx
from cfb_mjx.control.neural import Gru, Network, NeuralController
from cfb_mjx.envs import Layout
from cfb_mjx.errors import CfbError

onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")

LAYOUT = Layout(past_estimates=1, past_commands=2)
SHOWN = np.random.default_rng(0).normal(size=(50, LAYOUT.size)).astype(np.float32)


def drawn(*shape, seed: int = 0) -> np.ndarray:
    return (np.random.default_rng([seed, *shape]).normal(size=shape) / shape[0] ** 0.5).astype(np.float32)


def policy(activation="tanh", limit="tanh", hidden=(9, 8), unit: int | None = None, before: int = 1) -> PolicyFile:
    """A fully connected policy, or one with a GRU after some of its layers."""
    sizes, gru = [LAYOUT.size, *hidden, 4], None
    pairs = list(pairwise(sizes))
    if unit is not None:
        inputs = sizes[before]
        gru = Gru(
            *map(
                jnp.asarray,
                (drawn(inputs, 3 * unit), drawn(3 * unit), drawn(unit, 3 * unit), drawn(3 * unit, seed=1)),
            )
        )
        pairs[before] = unit, pairs[before][1]
    weights, biases = zip(*((jnp.asarray(2 * drawn(a, b)), jnp.asarray(drawn(b))) for a, b in pairs), strict=True)
    network = Network(weights, biases, activation, limit, gru, 0 if gru is None else before)
    return PolicyFile(NeuralController(network, LAYOUT), "target", {"config": {"seed": 3}}, "# Drawn\n")


def computed(path, shown=SHOWN, hidden: int = 0) -> np.ndarray:
    """Commands of the runtime on a sequence of observations."""
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    state, found = np.zeros((1, hidden), np.float32), []
    for x in shown:
        given = {"observation": x[None]} | ({"hidden": state} if hidden else {})
        command, *state = session.run(None, given)
        state = state[0] if state else None
        found.append(command[0])
    return np.array(found)


def commanded(controller: NeuralController, shown=SHOWN) -> np.ndarray:
    if not controller.recurrent:
        return np.asarray(jax.vmap(controller.act)(jnp.asarray(shown)))
    hidden, found = jnp.zeros(controller.network.gru.size), []
    limits = {"tanh": np.tanh, "clip": lambda x: np.clip(x, -1, 1)}
    for x in shown:
        output, hidden = controller.network.advance(jnp.asarray(x), hidden)
        found.append(0.5 * (1 + limits[controller.network.limit](np.asarray(output))))
    return np.array(found)


POLICIES = {
    "tanh": {},
    "relu, clipped": {"activation": "relu", "limit": "clip"},
    "swish": {"activation": "swish"},
    "one layer": {"hidden": ()},
    "gru": {"unit": 6},
    "gru first": {"unit": 5, "before": 0, "activation": "swish", "limit": "clip"},
    "gru last": {"unit": 7, "before": 2, "activation": "relu"},
}


@pytest.mark.parametrize("name", POLICIES)
def test_a_runtime_commands_what_the_policy_commands_and_the_file_is_the_policy(name, tmp_path):
    mine, path = policy(**POLICIES[name]), tmp_path / "mine.onnx"
    write_onnx(mine, path)
    hidden = POLICIES[name].get("unit", 0)
    expected = commanded(mine.controller)
    assert expected.std() > 0.05
    np.testing.assert_allclose(computed(path, hidden=hidden), expected, atol=1e-6)
    read = load_policy(path)
    assert (read.task, read.training, read.card, read.controller.layout) == ("target", mine.training, mine.card, LAYOUT)
    assert read.weights_sha256 == mine.weights_sha256, "bit for bit"
    assert jax.tree.structure(read.controller) == jax.tree.structure(mine.controller)
    np.testing.assert_array_equal(commanded(read.controller), expected)
    write_onnx(mine, tmp_path / "again.onnx")
    assert (tmp_path / "again.onnx").read_bytes() == path.read_bytes()
    model = onnx.load(path)
    shapes = {x.name: [d.dim_value for d in x.type.tensor_type.shape.dim] for x in model.graph.input}
    assert shapes == {"observation": [1, LAYOUT.size]} | ({"hidden": [1, hidden]} if hidden else {})
    assert [x.name for x in model.graph.output] == ["command"] + (["next_hidden"] if hidden else [])


def test_a_shipped_policy_as_a_model_is_flown_and_exported(tmp_path, capfd):
    path = tmp_path / "target.onnx"
    assert main(["export", "target", "-o", str(tmp_path / "c"), "--onnx", str(path)]) == 0
    assert f"ONNX model: {path}" in capfd.readouterr().out
    assert load_policy(path).weights_sha256 == load_policy("target").weights_sha256
    shown = np.random.default_rng(1).normal(size=(9, load_policy("target").controller.layout.size)).astype(np.float32)
    np.testing.assert_allclose(computed(path, shown), commanded(load_policy("target").controller, shown), atol=1e-6)
    assert main(["export", str(path), "-o", str(tmp_path / "again")]) == 0
    here, again = (json.loads((tmp_path / name / "contract.json").read_text()) for name in ("c", "again"))
    assert here["policies"] == again["policies"]
    assert main(["fly", str(path), "--task", "hover", "--json", str(tmp_path / "flown.json")]) == 0
    if shutil.which("cc"):
        assert main(["export", str(path), "-o", str(tmp_path / "again"), "--check"]) == 0


def model(nodes, arrays=(), inputs=("x",), outputs=("y",), shape=(1, LAYOUT.size)):
    """A model as other libraries write it: nodes as (operator, inputs, outputs, settings)."""
    make, kind = onnx.helper, onnx.TensorProto.FLOAT
    graph = make.make_graph(
        [make.make_node(operator, given, [to], **more) for operator, given, to, more in nodes],
        "main",
        [make.make_tensor_value_info(name, kind, shape) for name in inputs],
        [make.make_tensor_value_info(name, kind, None) for name in outputs],
        [onnx.numpy_helper.from_array(x, name) for name, x in dict(arrays).items()],
    )
    return make.make_model(graph, opset_imports=[make.make_opsetid("", 17)], ir_version=8)


W = {"a": drawn(7, LAYOUT.size), "b": drawn(7), "c": drawn(4, 7), "d": drawn(4)}
GEMM = {"alpha": 1.0, "beta": 1.0, "transB": 1}


def ppo(last: str = "Reshape"):
    """The operators that torch writes for the policy of Stable-Baselines3's PPO, with some for the value."""
    nodes = [
        ("Cast", ["x"], "cast", {"to": 1}),
        ("Flatten", ["cast"], "flat", {"axis": 1}),
        ("Gemm", ["flat", "a", "b"], "one", GEMM),
        ("Tanh", ["one"], "two", {}),
        ("Gemm", ["two", "c", "d"], "mean", GEMM),
        ("Exp", ["mean"], "value", {}),
        ("Shape", ["value"], "shape", {}),
        ("Expand", ["mean", "shape"], "wide", {}),
        ("Constant", [], "four", {"value_ints": [-1, 4]}),
        (last, ["wide", "four"] if last == "Reshape" else ["wide"], "y", {}),
    ]
    return model(nodes, W, outputs=("y", "value"))


def test_what_torch_writes_for_stable_baselines_is_read(tmp_path):
    onnx.save(ppo(), tmp_path / "ppo.onnx")
    controller = read_onnx(tmp_path / "ppo.onnx", LAYOUT, limit="clip")
    x = SHOWN.astype(float)
    expected = np.tanh(x @ W["a"].T + W["b"]) @ W["c"].T + W["d"]
    np.testing.assert_allclose(commanded(controller, x), 0.5 * (1 + np.clip(expected, -1, 1)), atol=1e-6)
    mean, std = np.full(LAYOUT.size, 0.2), np.full(LAYOUT.size, 2.0)
    controller = read_onnx(tmp_path / "ppo.onnx", LAYOUT, limit="tanh", mean=mean, std=std)
    expected = np.tanh((x - mean) / std @ W["a"].T + W["b"]) @ W["c"].T + W["d"]
    np.testing.assert_allclose(commanded(controller, x), 0.5 * (1 + np.tanh(expected)), atol=1e-6)
    save_policy(PolicyFile(controller, "target"), tmp_path / "kept.npz")
    assert load_policy(tmp_path / "kept.npz").controller.network.limit == "tanh"


def test_weights_in_a_file_of_their_own_are_read_or_missed(tmp_path):
    """As newer versions of torch write them."""
    path, beside = tmp_path / "ppo.onnx", tmp_path / "ppo.onnx.data"
    onnx.save(ppo(), path, save_as_external_data=True, size_threshold=0, location=beside.name)
    assert beside.stat().st_size > 1000
    onnx.save(ppo(), tmp_path / "whole.onnx")
    whole, parts = (read_onnx(tmp_path / name, LAYOUT, limit="clip") for name in ("whole.onnx", "ppo.onnx"))
    np.testing.assert_array_equal(commanded(whole), commanded(parts))
    beside.unlink()
    with pytest.raises(CfbError, match=r"ppo\.onnx: .*weights.*beside"):
        read_onnx(path, LAYOUT, limit="clip")


def test_scales_before_between_and_after_layers_become_part_of_them(tmp_path):
    nodes = [
        ("Sub", ["x", "mean"], "centred", {}),
        ("Div", ["centred", "std"], "scaled", {}),
        ("MatMul", ["scaled", "at"], "product", {}),
        ("Add", ["b", "product"], "one", {}),
        ("Sigmoid", ["one"], "gate", {}),
        ("Mul", ["gate", "one"], "two", {}),
        ("Mul", ["two", "gain"], "three", {}),
        ("Transpose", ["c"], "ct", {"perm": [1, 0]}),
        ("MatMul", ["three", "ct"], "four", {}),
        ("Add", ["four", "d"], "five", {}),
        ("Clip", ["five", "low", "high"], "six", {}),
        ("Mul", ["six", "half"], "seven", {}),
        ("Add", ["half", "seven"], "y", {}),
    ]
    more = {"mean": drawn(1, LAYOUT.size, seed=5), "std": 1 + drawn(LAYOUT.size, seed=6) ** 2, "gain": drawn(7, seed=7)}
    arrays = W | more | {"at": W["a"].T.copy(), "half": np.float32([0.5])}
    arrays |= {"low": np.float32(-1), "high": np.float32(1)}
    path = tmp_path / "m.onnx"
    onnx.save(model(nodes, arrays), path)
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    expected = np.concatenate([session.run(["y"], {"x": x[None]})[0] for x in SHOWN])
    controller = read_onnx(path, LAYOUT)
    assert (controller.network.activation, controller.network.limit) == ("swish", "clip")
    np.testing.assert_allclose(commanded(controller), expected, atol=1e-6)


def _refused() -> dict:
    dense = [
        ("Gemm", ["x", "a", "b"], "one", GEMM),
        ("Tanh", ["one"], "two", {}),
        ("Gemm", ["two", "c", "d"], "y", GEMM),
    ]
    inner = [*dense[:1], ("Softplus", ["one"], "two", {}), dense[2]]
    skip = [*dense[:2], ("Add", ["one", "two"], "sum", {}), ("Gemm", ["sum", "c", "d"], "y", GEMM)]
    sigmoid = [*dense[:2], ("Gemm", ["two", "c", "d"], "z", GEMM), ("Sigmoid", ["z"], "y", {})]
    scaled = [
        *dense[:2],
        ("Gemm", ["two", "c", "d"], "z", GEMM),
        ("Tanh", ["z"], "t", {}),
        ("Mul", ["t", "three"], "y", {}),
    ]
    mixed = [
        *dense[:2],
        ("Gemm", ["two", "e", "b"], "three", GEMM),
        ("Relu", ["three"], "four", {}),
        ("Gemm", ["four", "c", "d"], "y", GEMM),
    ]
    return {
        "another operator": (model(inner, W), {"limit": "clip"}, "the operator Softplus is not one of"),
        "a sum of two layers": (model(skip, W), {"limit": "clip"}, "the operator Add is not one of"),
        "no limit": (model(dense, W), {}, "does not limit its output; give a limit, tanh or clip"),
        "another limit": (model(sigmoid, W), {"limit": "tanh"}, "found sigmoid"),
        "another scale": (model(scaled, W | {"three": np.float32([3])}), {}, "another scale"),
        "two limits": (ppo("Tanh"), {"limit": "clip"}, None),
        "a tanh of a clip": (_clipped(dense), {"limit": "tanh"}, "by clip already; leave out the limit tanh"),
        "two activations": (model(mixed, W | {"e": drawn(7, 7)}), {"limit": "clip"}, "tanh, a layer, relu, a layer"),
        "the value first": (model(dense, W, outputs=("two",)), {"limit": "clip"}, "to 4 outputs"),
        "other inputs": (model(dense, W | {"a": drawn(7, 5)}), {"limit": "clip"}, f"{LAYOUT.size} inputs"),
    }


def _clipped(dense):
    nodes = [*dense[:2], ("Gemm", ["two", "c", "d"], "z", GEMM), ("Clip", ["z", "low", "high"], "y", {})]
    return model(nodes, W | {"low": np.float32(-1), "high": np.float32(1)})


@pytest.mark.parametrize("case", _refused())
def test_other_models_are_refused_in_one_sentence(case, tmp_path):
    made, given, words = _refused()[case]
    path = tmp_path / "other.onnx"
    onnx.save(made, path)
    if words is None:
        assert read_onnx(path, LAYOUT, **given).network.limit == "tanh"
        return
    with pytest.raises(CfbError, match=rf"^{path}: .*{words}"):
        read_onnx(path, LAYOUT, **given)


def test_files_that_do_not_say_enough_are_refused_by_name(tmp_path):
    other = tmp_path / "ppo.onnx"
    onnx.save(ppo(), other)
    with pytest.raises(CfbError, match=r"ppo\.onnx: does not say what the policy observes; read it with .*read_onnx"):
        load_policy(other)
    with pytest.raises(CfbError, match=r"none\.onnx: there is no such file"):
        load_policy(tmp_path / "none.onnx")
    for content in (b"", b"weights", ppo().SerializeToString()[:500]):
        (tmp_path / "bad.onnx").write_bytes(content)
        with pytest.raises(CfbError, match=r"bad\.onnx: "):
            load_policy(tmp_path / "bad.onnx")
    with pytest.raises(CfbError, match=r"must end in \.onnx"):
        write_onnx(policy(), tmp_path / "policy.npz")
    mine = tmp_path / "mine.onnx"
    write_onnx(policy(), mine)
    with pytest.raises(CfbError, match="has an observation layout of its own"):
        read_onnx(mine, Layout())
    assert read_onnx(mine, LAYOUT).layout == LAYOUT


@pytest.mark.parametrize(
    ("change", "words"), [({"format": "9"}, "another format"), ({"weights_sha256": "0"}, "weights are not those")]
)
def test_a_changed_model_is_not_taken_for_the_policy(change, words, tmp_path):
    path = tmp_path / "mine.onnx"
    write_onnx(policy(), path)
    changed = onnx.load(path)
    about = json.loads(changed.metadata_props[0].value)
    onnx.helper.set_model_props(changed, {"cfb_mjx": json.dumps(about | change)})
    onnx.save(changed, path)
    with pytest.raises(CfbError, match=rf"mine\.onnx: .*{words}"):
        load_policy(path)


def test_without_the_package_the_remedy_is_named(tmp_path, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(CfbError, match=r"pip install 'cfb_mjx\[onnx\]'"):
        write_onnx(policy(), tmp_path / "mine.onnx")
    assert main(["export", "target", "-o", str(tmp_path / "c"), "--onnx", str(tmp_path / "t.onnx")]) == 2
    assert "cfb_mjx[onnx]" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())
