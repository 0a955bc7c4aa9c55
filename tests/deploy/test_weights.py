"""Weights that are loaded into an exported policy: taken only as a whole, and then JAX's commands of the new policy."""

import ctypes
import functools
import json
import re
import runpy
import struct
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.control.neural import Gru, Network, NeuralController
from cfb_mjx.control.policy_file import PolicyFile
from cfb_mjx.deploy import compare, compile_policy, cortex, export_policy
from cfb_mjx.deploy.check import FREE_RAM, _costs, _loads, random_inputs
from cfb_mjx.deploy.deployment import Deployment, find_deployment
from cfb_mjx.deploy.weights import FILE, GOOD, HEADER, architecture, weight_set
from cfb_mjx.envs import Layout
from tests.deploy.test_export import STRICT, Control, firmware, random_policy, tick
from tests.deploy.test_export import pytestmark as pytestmark

UNCHECKED, INCOMPLETE, FORMAT, ARCHITECTURE, CRC, NOT_FINITE = 1, 3, 4, 5, 6, 7
ROWS = random_inputs(np.random.default_rng(3), 2, 30).reshape(60, -1)


def loadable(name: str) -> Deployment:
    return replace(find_deployment(name), loadable=True)


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    exported = export_policy(loadable("target"), tmp_path_factory.mktemp("export") / "c")
    return exported, compile_policy(exported, STRICT)


@functools.cache
def retrained() -> Deployment:
    """``target`` with other weights, trained on a heavier drone, whose hover is another."""
    held = find_deployment("target").holder
    network, model = held.controller.network, held.training["model"]
    rng = np.random.default_rng(4)
    other = jax.tree.map(lambda x: x * (1 + 0.05 * rng.standard_normal(x.shape).astype(np.float32)), network)
    heavier = model["parameters"] | {"mass": 1.1 * model["parameters"]["mass"]}
    training = held.training | {"model": model | {"parameters": heavier}}
    controller = NeuralController(other, held.controller.layout)
    return Deployment("retrained", replace(held, controller=controller, training=training), loadable=True)


@pytest.fixture(scope="module")
def new() -> bytes:
    return weight_set(retrained())


def commands(compiled) -> np.ndarray:
    compiled.reset()
    return compiled.steps(ROWS)


def test_a_set_in_any_order_is_taken_and_flies_as_in_jax(target, new):
    _, compiled = target
    c, flash, crc = compiled._library, commands(compiled), HEADER.unpack_from(new)[-1]
    starts = np.random.default_rng(0).permutation(np.arange(0, len(new), 24)).tolist()
    for i, start in enumerate(starts):
        part = new[start : start + 24]
        assert c.cfb_weights_write(start, part, len(part)) == 1
        if i in (0, len(starts) - 1):
            assert c.cfb_weights_status() == UNCHECKED
            np.testing.assert_array_equal(commands(compiled), flash)
    assert (c.cfb_weights_apply(), c.cfb_weights_loaded(), c.cfb_weights_crc() % 2**32) == (GOOD, 1, crc)
    assert compare(retrained(), compiled, sequences=300).largest < 1e-5
    assert np.abs(commands(compiled) - flash).max() > 0.01
    assert retrained().settled()[0] > 1.02 * target[0].deployment.settled()[0], "the hover is part of the set"
    c.cfb_weights_unload()
    np.testing.assert_array_equal(commands(compiled), flash)
    assert c.cfb_weights_loaded() == 0


def test_the_history_begins_anew_with_other_weights(target, new):
    _, compiled = target
    compiled.load_weights(new)
    fresh = compiled.steps(ROWS[:1])
    compiled.steps(ROWS)
    compiled.load_weights(new)
    np.testing.assert_array_equal(compiled.steps(ROWS[:1]), fresh)


def with_crc(data: bytes) -> bytes:
    return data[:16] + struct.pack("<I", crc32(data[:16] + data[20:])) + data[20:]


def with_float(data: bytes, x: float) -> bytes:
    return with_crc(data[:4000] + struct.pack("<f", x) + data[4004:])


def other_observation() -> bytes:
    """Of the same layers, for an observation with other axes and scales."""
    return weight_set(loadable("target-analytic"))


REFUSED = {
    "nothing but a header": (INCOMPLETE, lambda data: data[:20]),
    "less than a header": (INCOMPLETE, lambda data: data[:14]),
    "half": (INCOMPLETE, lambda data: data[:10_000]),
    "all but the last number": (INCOMPLETE, lambda data: data[:-4]),
    "something else": (FORMAT, lambda data: with_crc(b"XXXX" + data[4:])),
    "another version": (FORMAT, lambda data: with_crc(data[:4] + struct.pack("<I", 2) + data[8:])),
    "another observation": (ARCHITECTURE, lambda data: other_observation()),
    "a smaller network": (ARCHITECTURE, lambda data: weight_set(Deployment("s", random_policy(1, Layout())))),
    "a bit of a number": (CRC, lambda data: data[:9000] + bytes([data[9000] ^ 1]) + data[9001:]),
    "the CRC of another": (CRC, lambda data: data[:16] + struct.pack("<I", 1) + data[20:]),
    "NaN": (NOT_FINITE, lambda data: with_float(data, np.nan)),
    "infinity": (NOT_FINITE, lambda data: with_float(data, -np.inf)),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_set_that_is_wrong_is_refused_and_the_weights_in_flash_fly(case, target, new):
    _, compiled = target
    compiled._library.cfb_weights_unload()
    flash = commands(compiled)
    # After a good one, of which nothing may remain.
    assert compiled.load_weights(new) == GOOD
    expected, spoil = REFUSED[case]
    assert compiled.load_weights(spoil(new)) == expected
    assert compiled._library.cfb_weights_loaded() == 0
    np.testing.assert_array_equal(commands(compiled), flash)


def test_nothing_is_written_beyond_the_end(target, new):
    c = target[1]._library
    for offset, length in ((len(new), 1), (len(new) - 3, 4), (2**32 - 1, 4)):
        assert c.cfb_weights_write(ctypes.c_uint32(offset), new, length) == 0


def with_gru(seed: int) -> PolicyFile:
    rng, size = np.random.default_rng(seed), 6
    shapes = (9, 3 * size), (3 * size,), (size, 3 * size), (3 * size,)
    gru = Gru(*(jnp.asarray(0.7 * rng.normal(size=shape), jnp.float32) for shape in shapes))
    network = random_policy(seed, LAYOUT, hidden=(9, size)).controller.network
    weights, biases = network.weights, network.biases
    network = Network((weights[0], weights[2]), (biases[0], biases[2]), gru=gru, before=1)
    return PolicyFile(NeuralController(network, LAYOUT), "target")


LAYOUT = Layout(integral=True)
OTHERS = {
    "a path ahead": lambda seed: random_policy(seed, Layout(preview_s=(0.05, 0.3), action="body_rates")),
    "an integral": lambda seed: random_policy(seed, LAYOUT),
    "a recurrent unit": with_gru,
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_networks_take_sets_too(name, tmp_path):
    first, second = (Deployment("own", OTHERS[name](seed), loadable=True) for seed in (1, 2))
    compiled = compile_policy(export_policy(first, tmp_path / "c"), STRICT)
    assert compiled.load_weights(weight_set(second)) == GOOD
    assert compare(second, compiled, sequences=100).largest < 1e-4
    assert compare(first, compiled, sequences=10).largest > 1e-2


def test_only_what_is_computed_with_makes_the_architecture():
    base = Deployment("a", random_policy(1, Layout()))
    assert architecture(Deployment("b", random_policy(2, Layout()))) == architecture(base)
    others = [
        random_policy(1, Layout(), hidden=(8, 6)),
        random_policy(1, Layout(), activation="relu"),
        random_policy(1, Layout(rate_scale_radps=9.0)),
        random_policy(1, Layout(action="body_rates")),
    ]
    assert len({architecture(Deployment("c", policy)) for policy in others} | {architecture(base)}) == 5


def test_the_contract_names_the_set_and_a_later_export_removes_it(tmp_path):
    exported = export_policy(loadable("target"), tmp_path)
    said = json.loads((tmp_path / "contract.json").read_text())["weights_set"]
    *_, fits, count, crc = HEADER.unpack_from((tmp_path / FILE).read_bytes())
    assert (int(said["architecture"], 16), said["numbers"], int(said["crc32"], 16)) == (fits, count, crc)
    assert "cfb_weights.o" in (tmp_path / "Kbuild").read_text()
    loadable_only = {path.name for path in tmp_path.iterdir()}
    export_policy(replace(exported.deployment, loadable=False), tmp_path)
    gone = loadable_only - {path.name for path in tmp_path.iterdir()}
    assert gone == {FILE, "cfb_weights.c", "cfb_weights.h", "load_weights.py"}
    assert "weights_set" not in (tmp_path / "contract.json").read_text()
    assert not any(re.search(r"CFB_SET|cfb_weights|loadable", path.read_text()) for path in tmp_path.iterdir())


@pytest.mark.skipif(not cortex.has_compiler(), reason="arm-none-eabi-gcc is not installed")
def test_the_check_knows_the_memory_and_that_the_set_is_taken(target, tmp_path):
    exported, compiled = target
    numbers, findings = _costs(exported, compiled)
    assert len((exported.folder / FILE).read_bytes()) < numbers["ram_bytes"] < FREE_RAM
    assert all(finding.good for finding in findings)
    assert _loads(exported, compiled).good
    (tmp_path / FILE).write_bytes((exported.folder / FILE).read_bytes()[:-8])
    assert not _loads(exported._replace(folder=tmp_path), compiled).good
    adaptive = export_policy(loadable("target-adaptive"), tmp_path / "c")
    bad = [finding.text for finding in _costs(adaptive, compile_policy(adaptive))[1] if not finding.good]
    assert len(bad) == 1
    assert f"of {FREE_RAM} B of memory" in bad[0]


class Handler(ctypes.Structure):
    _fields_ = [
        ("type", ctypes.c_int),
        ("get_size", ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_uint8)),
        ("get_serial", ctypes.c_void_p),
        ("read", ctypes.c_void_p),
        ("write", ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_uint8, ctypes.c_uint32, ctypes.c_uint8, ctypes.c_char_p)),
        ("internal_id", ctypes.c_uint8),
    ]


class Drone:
    """The app on the firmware's stubs: its memory and its log."""

    def __init__(self, exported, folder):
        self.app = firmware(exported, folder)
        self.app.controllerOutOfTreeInit()
        self.app.controllerOutOfTreeInit()
        first, second = (ctypes.POINTER(Handler) * 2).in_dll(self.app, "memories")
        assert not second, "registered once"
        self.memory = first.contents

    def write(self, address: int, data: bytes) -> bool:
        parts = ((i, data[i : i + 25]) for i in range(0, len(data), 25))
        return all(self.memory.write(0, address + i, len(part), part) for i, part in parts)

    def load(self, data: bytes) -> bool:
        return self.write(0, data) and self.write(self.memory.get_size(0) - 1, b"\1")

    @property
    def log(self) -> tuple[int, int, int]:
        at = (ctypes.c_void_p * 9).in_dll(self.app, "log_cfb")[5:8]
        kinds = (ctypes.c_uint8, ctypes.c_uint32, ctypes.c_uint8)
        loaded, crc, status = (kind.from_address(x).value for kind, x in zip(kinds, at, strict=True))
        return loaded, crc, status


@pytest.fixture
def drone(target, tmp_path):
    return Drone(target[0], tmp_path)


def test_the_app_takes_a_set_on_the_ground_and_none_in_flight(drone, target, new):
    own, crc = (HEADER.unpack_from(x)[-1] for x in (weight_set(loadable("target")), new))
    assert (drone.memory.type, drone.memory.get_size(0)) == (0x18, len(new) + 1)
    assert drone.log == (0, own, 0)
    control = Control()
    flash = tick(drone.app, 0, control)
    assert not drone.write(0, new), "it flies"
    assert drone.log == (0, own, 0)
    tick(drone.app, 8, control, absolute=0)
    assert drone.write(0, new)
    assert drone.log == (0, own, UNCHECKED)
    # A flight begins before the set is applied: that does not change its weights.
    np.testing.assert_array_equal(tick(drone.app, 16, control), flash)
    assert not drone.write(len(new), b"\1")
    tick(drone.app, 24, control)
    assert drone.log[:2] == (0, own)
    tick(drone.app, 32, control, absolute=0)
    assert drone.write(len(new), b"\1")
    assert drone.log == (1, crc, GOOD)
    loaded = tick(drone.app, 40, control)
    assert np.abs(loaded - flash).max() > 1e-3
    assert not drone.write(0, b"\0")
    assert drone.log == (1, crc, GOOD)
    tick(drone.app, 48, control, absolute=0)
    assert not drone.load(new[:-1] + b"\0")
    assert drone.log == (0, own, CRC)
    np.testing.assert_array_equal(tick(drone.app, 56, control), flash)


def radio(drone) -> dict[str, ModuleType]:
    """What the script uses of cflib, with this drone at the other end."""
    taken, failed = [], []
    element = SimpleNamespace(id=3, size=drone.memory.get_size(0))

    def write(memory, address, data):
        for callback in list(taken if drone.write(address, data) else failed):
            callback(memory, address)

    def caller(callbacks):
        return SimpleNamespace(add_callback=callbacks.append, remove_callback=callbacks.remove)

    class Context:
        def __init__(self, *_, **__):
            mem = SimpleNamespace(mem_write_cb=caller(taken), mem_write_failed_cb=caller(failed), write=write)
            mem.get_mems = lambda kind: (element,) if kind == 0x18 else ()
            self.cf = SimpleNamespace(mem=mem)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def __next__(self):
            return 0, dict(zip(("cfb.loaded", "cfb.crc", "cfb.weights"), drone.log, strict=True)), None

    config = SimpleNamespace(add_variable=lambda name, kind: None)
    names = {
        "cflib": {},
        "cflib.crtp": {"init_drivers": lambda: None},
        "cflib.crazyflie": {"Crazyflie": lambda **_: None},
        "cflib.crazyflie.log": {"LogConfig": lambda *_, **__: config},
        "cflib.crazyflie.mem": {"MemoryElement": SimpleNamespace(TYPE_APP=0x18)},
        "cflib.crazyflie.syncCrazyflie": {"SyncCrazyflie": Context},
        "cflib.crazyflie.syncLogger": {"SyncLogger": Context},
    }
    modules = {name: ModuleType(name) for name in names}
    for name, module in modules.items():
        vars(module).update(names[name])
    modules["cflib"].crtp = modules["cflib.crtp"]
    return modules


def test_the_script_loads_a_set_and_says_what_the_drone_says(drone, target, new, tmp_path, monkeypatch):
    for name, module in radio(drone).items():
        monkeypatch.setitem(sys.modules, name, module)
    main = runpy.run_path(str(target[0].folder / "load_weights.py"))["main"]
    path = tmp_path / FILE

    def load(data: bytes) -> str:
        path.write_bytes(data)
        return main("radio://0", str(path))

    crc = f"{HEADER.unpack_from(new)[-1]:#010x}"
    assert load(new) == f"{path}: loaded weights fly, CRC {crc}."
    for data, words in (
        (new[:-1] + b"\0", r"CRC is wrong; the weights in flash fly"),
        (with_float(new, np.nan), "not finite; the weights in flash fly"),
        (other_observation(), "another network or observation"),
        (new[:-4], "another architecture"),
        (b"something else altogether", "no set of weights"),
    ):
        with pytest.raises(SystemExit, match=words):
            load(data)
    tick(drone.app, 0, Control())
    with pytest.raises(SystemExit, match="because it flies"):
        load(new)
