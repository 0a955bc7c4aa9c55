"""The exported C: the same commands as JAX, as the contract alone, and as the firmware would call it."""

import ctypes
import json
import math
import os
import re
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfb_mjx.cli import main
from cfb_mjx.control.manoeuvre import load_manoeuvre
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.control.policy_file import PolicyFile, load_policy, save_policy, shipped_policies
from cfb_mjx.deploy import compare, compile_policy, cortex, export_policy, fly_beside
from cfb_mjx.deploy.check import FIRMWARE_STACK, STACK, STEP_S, _costs, begin, random_inputs
from cfb_mjx.deploy.deployment import Deployment, find_deployment
from cfb_mjx.deploy.export import literal
from cfb_mjx.envs import Layout
from cfb_mjx.envs.flip import FLIP_LAYOUT
from cfb_mjx.errors import CfbError

pytestmark = pytest.mark.skipif(shutil.which(os.environ.get("CC") or "cc") is None, reason="no C compiler here")
STRICT = ("-pedantic", "-Wconversion", "-Wdouble-promotion", "-Wshadow")
ACCEPTANCE = Path(__file__).resolve().parents[2].parent / "shared/accept/export.py"


def random_policy(seed: int, layout: Layout, hidden=(8, 5), activation="tanh", task="target") -> PolicyFile:
    """Of large random weights, so that every input matters and activations saturate now and then."""
    controller = NeuralController.random(jax.random.PRNGKey(seed), layout, hidden, activation)
    grown = jax.tree.map(lambda x: jnp.asarray(2 * x, jnp.float32), controller.network)
    last = jnp.asarray(jax.random.normal(jax.random.PRNGKey(seed), grown.weights[-1].shape), jnp.float32)
    grown = type(grown)((*grown.weights[:-1], last), grown.biases, activation)
    return PolicyFile(NeuralController(grown, layout), task)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Exports and their compiled code, made once."""
    made = {}

    def make(deployment: Deployment):
        if deployment.name not in made:
            exported = export_policy(deployment, tmp_path_factory.mktemp("export") / deployment.name)
            made[deployment.name] = exported, compile_policy(exported, STRICT)
        return made[deployment.name]

    return make


LAYOUTS = {
    "no history": (Layout(past_estimates=0, past_commands=0), "relu"),
    "long": (Layout(past_estimates=3, estimate_stride=4, past_commands=2, integral=True), "tanh"),
    "body axes": (
        Layout(control_dt_s=0.004, body_position=True, body_velocity=True, position_limit_m=1.5, position_scale_m=0.5),
        "swish",
    ),
    "positions as they are": (Layout(position_bend_m=0.0, position_scale_m=1.0, velocity_bend_mps=0.0), "tanh"),
    "integral alone": (Layout(past_estimates=1, past_commands=0, integral=True, integral_limit_ms=0.01), "relu"),
    "a path ahead": (Layout(preview_s=(0.05, 0.3), action="body_rates"), "tanh"),
    "a path ahead in world axes": (Layout(preview_s=(0.2,), body_position=False, action="velocity"), "relu"),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_commands_are_those_of_jax_whatever_the_network_sees(name, built):
    layout, activation = LAYOUTS[name]
    deployment = Deployment(name.replace(" ", "_"), random_policy(3, layout, activation=activation))
    found = compare(deployment, built(deployment)[1], sequences=200, steps=20)
    # Large weights make large sums, whose roundings are larger too.
    assert found.largest < 1e-4, found
    assert found.mean < 1e-6


@pytest.mark.parametrize("name", ["target", "target-adaptive", "double-flip"])
def test_shipped_policies_within_a_hundred_thousandth(name, built):
    deployment = find_deployment(name)
    assert compare(deployment, built(deployment)[1], sequences=1000).largest < 1e-5


def test_flips_of_other_networks(built):
    turner = random_policy(5, FLIP_LAYOUT, activation="relu", task="flip")
    holder = random_policy(6, Layout(integral=True, past_estimates=2), activation="swish")
    deployment = Deployment("strange", holder, turner, load_manoeuvre("flip", ("climb_s=0.05", "turn_s=0.06")))
    assert compare(deployment, built(deployment)[1], sequences=200, steps=30).largest < 1e-4


def test_a_difference_would_be_seen(built):
    target, adaptive = find_deployment("target"), find_deployment("target-adaptive")
    assert compare(adaptive, built(target)[1], sequences=10).largest > 0.01


@pytest.mark.parametrize("name", ["target", "target-adaptive"])
def test_the_contract_alone_is_enough_to_rebuild_the_command(name, built):
    """From contract.json and the weights, in NumPy and SciPy, with nothing of the library's."""
    exported, compiled = built(find_deployment(name))
    promised = json.loads((exported.folder / "contract.json").read_text())
    policy = promised["policies"]["holder"]
    archive = np.load(shipped_policies()[name])
    weights = [(archive[f"weight_{i}"], archive[f"bias_{i}"]) for i in range(len(policy["layers"]) - 1)]
    rows = random_inputs(np.random.default_rng(5), 2, 45)[1].astype(float)

    def frame(row):
        to_world = Rotation.from_quat(row[[7, 8, 9, 6]])
        numbers = {
            "position - target": row[:3] - row[13:],
            "position - target, body axes": to_world.inv().apply(row[:3] - row[13:]),
            "velocity, world axes": row[3:6],
            "velocity, body axes": to_world.inv().apply(row[3:6]),
            "rotation matrix, body to world, by rows": to_world.as_matrix().reshape(-1),
            "body rate": row[10:13],
        }
        parts = []
        for part in policy["observation"][0]["of"]:
            x = numbers[part["name"]]
            if "limit" in part:
                limit = float(re.search(r"([\d.]+) m$", part["limit"]).group(1))
                x = x * min(1.0, limit / np.linalg.norm(x))
            if "bend" in part:
                b, d = float(re.search(r"([\d.]+) m(/s)?$", part["bend"]).group(1)), np.linalg.norm(x)
                x = x * b * np.arcsinh(d / b) / d
            parts.append(x / part["divided_by"])
        return np.concatenate(parts)

    frames, commands, integral = (
        [frame(rows[0])] * 60,
        [np.full(4, 2 * promised["first_step"]["hover_command"] - 1)] * 9,
        0.0,
    )
    near = most = 0.0
    compiled.reset()
    for row, u in zip(rows, compiled.steps(rows), strict=True):
        parts = []
        for segment in policy["observation"]:
            ago = int((re.search(r"(\d+) steps ago", segment["name"]) or [0, 0])[1])
            if segment["name"] == "newest estimate":
                parts.append(frame(row))
            elif segment["name"].startswith("estimate"):
                parts.append(frames[ago - 1])
            elif segment["name"].startswith("command"):
                parts.append(commands[ago - 1])
            else:
                near, most = map(float, re.findall(r"within ([\d.]+) m", segment["limit"]))
                parts.append(np.broadcast_to(integral, 3) / segment["divided_by"])
            assert len(parts[-1]) == segment["length"]
        x = np.concatenate(parts)
        for weight, bias in weights[:-1]:
            x = np.tanh(x @ weight + bias)
        expected = (1 + np.tanh(x @ weights[-1][0] + weights[-1][1])) / 2
        np.testing.assert_allclose(u, expected, atol=1e-5)
        frames, commands = [frame(row), *frames], [2 * u - 1, *commands]
        integral = np.clip(integral + promised["step_s"] * np.clip(row[:3] - row[13:], -near, near), -most, most)


def test_closed_loop_in_c_is_the_flight_of_jax(built):
    deployment = find_deployment("target")
    flown = fly_beside(deployment, built(deployment)[1], 1.0, (0.5, -0.5, 0.3))
    assert flown.command_difference() < 1e-5
    assert flown.distance_m < 1e-5
    # It did fly: half a second in it is much nearer than it began.
    assert np.linalg.norm(flown.position[0, -1]) < 0.2


def test_a_flip_goes_through_its_phases_and_holds_again(built):
    deployment = find_deployment("double-flip")
    compiled = built(deployment)[1]
    begin(deployment, compiled)
    level, phases = (1.0, 0.0, 0.0, 0.0), []
    for i in range(600):
        roll = 0.2 * max(0, i - 60)
        q = (math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0) if roll < 11 else level
        compiled.step((0, 0, 1e-5 * (i % 2)), (0, 0, 2.5 if i > 50 else 0.0), q, (0, 0, 0))
        phases.append(compiled.phase)
    hold, climb, turn, catch = range(4)
    order = [p for i, p in enumerate(phases) if i == 0 or phases[i - 1] != p]
    assert order == [climb, turn, catch, hold]
    assert phases.index(turn) == 51
    # The first step at 0.2 rad each at which it has turned far enough.
    assert phases.index(catch) == 60 + math.ceil(deployment.manoeuvre.knobs.turn_rad / 0.2)
    compiled.reset()
    compiled.step((0, 0, 0), (0, 0, 0), level, (0, 0, 0))
    assert compiled.phase == hold


def test_set_points_a_flip_was_not_trained_for_are_refused(built):
    deployment = find_deployment("double-flip")
    compiled = built(deployment)[1]
    for speed, rate in ((2.0, 60.0), (50.0, 18.0), (math.nan, 18.0), (2.0, math.inf), (2.0, -18.0)):
        compiled.reset()
        compiled.set_flip(speed, rate)
        compiled.step((0, 0, 0), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0))
        assert compiled.phase == 0


BAD = {"NaN": math.nan, "infinity": math.inf, "absurd": 1e7}


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("where", range(16))
def test_a_bad_estimate_is_survived_and_forgotten(bad, where, built):
    compiled = built(find_deployment("target"))[1]
    good = np.array([0.1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], np.float32)
    worse = good.copy()
    worse[where] = BAD[bad]
    compiled.reset()
    before = compiled.steps(np.tile(good, (3, 1)))[-1]
    held = compiled.steps(np.tile(worse, (5, 1)))
    assert compiled.fault == 1
    np.testing.assert_array_equal(held, np.tile(before, (5, 1)))
    # As if nothing had been: the history holds none of it.
    after = compiled.steps(good[None])[0]
    assert compiled.fault == 0
    compiled.reset()
    np.testing.assert_array_equal(after, compiled.steps(np.tile(good, (4, 1)))[-1])


def test_blind_for_long_stops_the_motors_until_a_reset(built):
    compiled = built(find_deployment("target"))[1]
    good, bad = ((0, 0, 0), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0)), ((math.nan, 0, 0), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0))
    compiled.reset()
    compiled.step(*good)
    for _ in range(5):
        assert compiled.step(*bad).min() > 0.2
    assert compiled.step(*bad).max() == 0
    assert compiled.step(*good).max() == 0
    assert compiled.fault == 2
    compiled.reset()
    assert compiled.step(*good).min() > 0.2
    assert compiled.fault == 0
    compiled.reset()
    assert compiled.step((0, 0, 0), (0, 0, 0), (0, 0, 0, 0), (0, 0, 0)).max() == 0
    assert compiled.fault == 2


def test_quaternions_count_by_direction_only(built):
    compiled = built(find_deployment("target"))[1]
    q, seen = np.array([0.9, 0.1, -0.2, 0.3]), ((0.3, 0, 0.1), (0, 1, 0))
    commands = []
    for scale in (1.0, -1.0, 3.0):
        compiled.reset()
        commands.append(compiled.step(*seen, scale * q, (1, 2, 3)))
    np.testing.assert_allclose(commands[1], commands[0], atol=1e-6)
    np.testing.assert_allclose(commands[2], commands[0], atol=1e-6)


@pytest.mark.parametrize("x", [0.1, -3.0, 1e-30, 123456792.0, 1 / 3, 0.0, 7e-5, 1e6])
def test_literals_read_back_as_the_same_number(x):
    text = literal(x)
    assert text.endswith("f")
    assert "." in text or "e" in text
    assert np.float32(text[:-1]) == np.float32(x)


def firmware(exported, folder: Path) -> ctypes.CDLL:
    """The app, compiled against the firmware's types."""
    library, stubs = folder / "app.so", Path(__file__).parent / "firmware"
    app = exported.folder / "controller_out_of_tree.c"
    command = ["cc", "-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", f"-I{stubs}", f"-I{exported.folder}"]
    command += ["-shared", "-fPIC", "-o", str(library), str(app), *map(str, exported.sources), "-lm"]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(library))


class Setpoint(ctypes.Structure):
    _fields_ = [
        ("position", ctypes.c_float * 3),
        ("mode", ctypes.c_int * 7),
        ("velocity", ctypes.c_float * 3),
        ("acceleration", ctypes.c_float * 3),
        ("attitude", ctypes.c_float * 3),
        ("attitude_rate", ctypes.c_float * 3),
        ("thrust", ctypes.c_float),
        ("velocity_body", ctypes.c_bool),
    ]


class FirmwareState(ctypes.Structure):
    _fields_ = [("xyzw", ctypes.c_float * 4), ("position", ctypes.c_float * 3), ("velocity", ctypes.c_float * 3)]


class Control(ctypes.Structure):
    _fields_ = [("forces", ctypes.c_float * 4), ("mode", ctypes.c_int)]


def tick(
    app,
    at: int,
    control,
    position=(0, 0, 1),
    velocity=(0, 0, 0),
    wxyz=(1, 0, 0, 0),
    gyro_deg=(0, 0, 0),
    absolute=1,
    mode=2,
    velocity_of_target=(0, 0, 0),
):
    state = FirmwareState((*wxyz[1:], wxyz[0]), position, velocity)
    gyro = (ctypes.c_float * 3)(*gyro_deg)
    target = Setpoint((0.5, 0, 1), (absolute,) * 3, velocity_of_target, (0.5, 0.0, -0.5))
    app.controllerOutOfTree(ctypes.byref(control), ctypes.byref(target), gyro, ctypes.byref(state), ctypes.c_uint32(at))
    assert control.mode == mode
    return np.array(control.forces)


def test_the_app_hands_over_the_firmwares_units_and_orders_every_eight_ticks(built, tmp_path):
    exported, compiled = built(find_deployment("target"))
    app = firmware(exported, tmp_path)
    app.controllerOutOfTreeInit()
    assert app.controllerOutOfTreeTest()
    seen = ((0.1, -0.2, 1.1), (0.3, 0.2, -0.1), (0.96, 0.1, 0.2, 0.17))
    control, rate = Control(), np.array([1.0, -2.0, 0.5])
    compiled.reset()
    for i in range(33):
        found = tick(app, 100 + i, control, *seen, np.degrees(rate))
        if i % 8 == 0:
            expected = compiled.step(*seen, rate, (0.5, 0, 1))
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_app_stops_without_a_set_point_and_begins_anew_after_a_pause(built, tmp_path):
    exported, compiled = built(find_deployment("target"))
    app = firmware(exported, tmp_path)
    app.controllerOutOfTreeInit()
    control = Control()
    compiled.reset()
    first = compiled.step((0, 0, 1), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0), (0.5, 0, 1))
    np.testing.assert_allclose(tick(app, 0, control), first, atol=1e-6)
    for at in range(8, 80, 8):
        later = tick(app, at, control)
    assert np.abs(later - first).max() > 1e-3
    assert tick(app, 81, control, absolute=0).max() == 0
    np.testing.assert_allclose(tick(app, 82, control), first, atol=1e-6)
    tick(app, 90, control)
    np.testing.assert_allclose(tick(app, 500, control), first, atol=1e-6)


class Legacy(ctypes.Structure):
    _fields_ = [("roll_pitch_yaw", ctypes.c_int16 * 3), ("thrust", ctypes.c_float), ("mode", ctypes.c_int)]


def test_the_app_hands_thrust_and_rates_to_the_firmwares_rate_loop(built, tmp_path):
    deployment = Deployment("rates", random_policy(8, Layout(action="body_rates")))
    exported, compiled = built(deployment)
    app = firmware(exported, tmp_path)
    app.controllerOutOfTreeInit()
    rate, seen = np.array([1.0, -2.0, 0.5]), ((0.1, -0.2, 1.1), (0.3, 0.2, -0.1), (0.96, 0.1, 0.2, 0.17))
    compiled.reset()
    thrust, *wanted = compiled.step(*seen, rate, (0.5, 0, 1))
    assert 0 < thrust < 1
    assert np.abs(wanted).max() > 1
    control = Control()
    tick(app, 100, control, *seen, np.degrees(rate), mode=0)
    # The firmware's pitch is positive with the nose up, ours about the body's y axis.
    signs = np.array([1, -1, 1])
    asked = np.array((ctypes.c_float * 6).in_dll(app, "asked"))
    np.testing.assert_allclose(asked[:3], np.degrees(rate) * signs, rtol=1e-5)
    np.testing.assert_allclose(asked[3:], np.degrees(wanted) * signs, rtol=1e-5)
    legacy = Legacy.from_buffer_copy(bytes(control)[:12] + bytes(8))
    assert list(legacy.roll_pitch_yaw) == [100, 200, -300]
    assert legacy.thrust == pytest.approx(65535 * thrust, rel=1e-5)


@pytest.mark.parametrize("action", ["attitude", "velocity", "position"])
def test_the_app_hands_set_points_to_the_firmwares_pid(action, built, tmp_path):
    exported, compiled = built(Deployment(action, random_policy(9, Layout(action=action))))
    app = firmware(exported, tmp_path)
    app.controllerOutOfTreeInit()
    tick(app, 100, Control(), mode=0)
    compiled.reset()
    command = compiled.step((0, 0, 1), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0), (0.5, 0, 1))
    found = Setpoint.in_dll(app, "followed")
    modes = {"attitude": [0, 0, 0, 1, 1, 1, 0], "velocity": [2, 2, 2, 0, 0, 1, 0], "position": [1, 1, 1, 0, 0, 1, 0]}
    assert list(found.mode) == modes[action]
    assert found.attitude[2] == pytest.approx(np.degrees(command[3]), rel=1e-5)
    if action == "attitude":
        assert found.thrust == pytest.approx(65535 * command[0], rel=1e-5)
        np.testing.assert_allclose(found.attitude[:2], np.degrees(command[1:3]) * [1, -1], rtol=1e-5)
    if action == "velocity":
        np.testing.assert_allclose(found.velocity, command[:3], rtol=1e-5)
    if action == "position":
        np.testing.assert_allclose(found.position, command[:3] + np.array([0.5, 0, 1]), rtol=1e-5)


def test_the_app_looks_ahead_along_the_targets_velocity_and_acceleration(built, tmp_path):
    layout = Layout(preview_s=(0.1, 0.4))
    exported, compiled = built(Deployment("ahead", random_policy(10, layout)))
    app = firmware(exported, tmp_path)
    app.controllerOutOfTreeInit()
    found = tick(app, 100, Control(), velocity_of_target=(1, -2, 0))
    velocity, acceleration = np.array([1, -2, 0]), np.array([0.5, 0.0, -0.5])
    ahead = [velocity * t + acceleration * t**2 / 2 for t in layout.preview_s]
    row = np.concatenate([(0, 0, 1), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0), (0.5, 0, 1), *ahead])
    compiled.reset()
    np.testing.assert_allclose(found, compiled.steps(row[None])[0], atol=1e-6)


def test_a_frozen_estimate_stops_the_motors(built):
    """An estimator that hangs repeats itself bit for bit; the policy used to fly on for ever."""
    compiled = built(find_deployment("target"))[1]
    compiled.reset()
    good = ((0, 0, 0.1), (0, 0, 0), (1, 0, 0, 0), (0, 0.001, 0))
    commands = [compiled.step(*good) for _ in range(13)]
    assert min(u.min() for u in commands[:12]) > 0.2
    assert commands[12].max() == 0
    assert compiled.fault == 2
    compiled.reset()
    for i in range(50):
        assert compiled.step((0, 0, 0.1), (0, 0, 0), (1, 0, 0, 0), (0, 0, 1e-6 * (i % 2))).min() > 0.2


_FIRMWARE_FLAGS = """
-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 -fno-math-errno -mfp16-format=ieee -g3 -Os -Werror
-Wno-address-of-packed-member -Wall -Wmissing-braces -fno-strict-aliasing -std=gnu11 -ffunction-sections -fdata-sections
-Wdouble-promotion
"""
"""Those of the firmware's Makefile."""


@pytest.mark.skipif(not cortex.has_compiler(), reason="arm-none-eabi-gcc is not installed")
@pytest.mark.parametrize("name", ["target", "double-flip", "rates", "velocity", "ahead", "loadable"])
def test_the_app_compiles_as_the_firmware_compiles_it(name, tmp_path):
    layouts = {"rates": {"action": "body_rates"}, "velocity": {"action": "velocity"}, "ahead": {"preview_s": (0.1,)}}
    layouts["loadable"] = {"preview_s": (0.1,), "action": "position"}
    chosen = layouts.get(name)
    policy = None if chosen is None else random_policy(1, Layout(**chosen))
    deployment = find_deployment(name) if policy is None else Deployment(name, policy, loadable=name == "loadable")
    exported = export_policy(deployment, tmp_path / "c")
    objects = re.findall(r"obj-y \+= (\w+)\.o", (exported.folder / "Kbuild").read_text())
    assert "controller_out_of_tree" in objects
    for stem in objects:
        command = ["arm-none-eabi-gcc", *_FIRMWARE_FLAGS.split(), "-DFIRMWARE_ELSEWHERE", "-fcommon"]
        command += [f"-I{Path(__file__).parent / 'firmware'}", f"-I{exported.folder}"]
        subprocess.run([*command, "-c", f"{exported.folder / stem}.c", "-o", f"{tmp_path / stem}.o"], check=True)


def test_the_app_flips_when_its_parameter_is_set(built, tmp_path):
    exported, _ = built(find_deployment("double-flip"))
    app = firmware(exported, tmp_path)
    app.controllerOutOfTreeInit()
    control, parameters = Control(), (ctypes.c_void_p * 4).in_dll(app, "param_cfbflip")
    go = ctypes.cast(parameters[0], ctypes.POINTER(ctypes.c_uint8))
    tick(app, 0, control)
    assert app.cfb_policy_phase() == 0
    go[0] = 1
    tick(app, 8, control)
    assert app.cfb_policy_phase() == 1
    assert go[0] == 0


@pytest.mark.skipif(not cortex.has_compiler(), reason="arm-none-eabi-gcc is not installed")
@pytest.mark.parametrize("name", ["target", "target-adaptive", "double-flip"])
def test_it_fits_the_drones_processor(name, built):
    found = cortex.size(built(find_deployment(name))[0])
    assert 10_000 < found.flash < 64 * 1024
    assert found.ram + found.stack < 8 * 1024


@pytest.mark.skipif(not cortex.has_compiler(), reason="arm-none-eabi-gcc is not installed")
def test_a_network_that_is_too_large_for_the_drone_is_refused(built):
    deployment = Deployment("wide", random_policy(1, Layout(), hidden=(256, 256)))
    exported, compiled = built(deployment)
    numbers, findings = _costs(exported, compiled)
    # However wide, the numbers between two layers are not on the stack of the firmware's task.
    assert numbers["stack_bytes"] <= STACK < FIRMWARE_STACK
    assert numbers["step_s"] > STEP_S
    bad = [finding.text for finding in findings if not finding.good]
    assert any("of 64 kB of flash" in text for text in bad)
    assert any(text.endswith("of 1 ms") for text in bad)


@pytest.mark.skipif(not cortex.has_emulator(), reason="qemu-system-arm is not installed")
@pytest.mark.parametrize("name", ["target", "target-adaptive", "double-flip"])
def test_the_emulated_processor_commands_the_same_in_less_than_a_millisecond(name, built):
    deployment = find_deployment(name)
    exported, compiled = built(deployment)
    rows = random_inputs(np.random.default_rng(2), 4, 12).reshape(-1, 16)
    found = cortex.emulate(exported, rows)
    begin(deployment, compiled)
    np.testing.assert_allclose(found.commands, compiled.steps(rows), atol=1e-6)
    # Each multiply-accumulate is at least four instructions (two loads, product, sum).
    macs = cortex.multiply_accumulates(deployment)
    assert 4 * macs < found.instructions.min()
    assert found.instructions.max() < cortex.estimated_instructions(deployment)
    assert found.instructions.max() * cortex.CYCLES_PER_INSTRUCTION / cortex.CLOCK_HZ < 1e-3


def test_the_command_exports_checks_and_says_so(tmp_path, capfd):
    assert main(["export", "target", "-o", str(tmp_path / "c"), "--check"]) == 0
    said = capfd.readouterr().out
    assert "6 s of hover in closed loop" in said
    assert "multiply-accumulates" in said
    result = json.loads((tmp_path / "c/check.json").read_text())
    assert result["passed"]
    assert result["parity"]["sequences"] == 10_000
    assert result["closed_loop"]["command_difference@1s"] < 1e-5
    assert result["closed_loop"]["hover_distance_m@6s"] < 1e-3
    if ACCEPTANCE.exists():
        subprocess.run(["python3", str(ACCEPTANCE), str(tmp_path / "c")], check=True)


def test_nothing_of_an_earlier_export_is_left(tmp_path):
    exported = export_policy(find_deployment("double-flip"), tmp_path / "c")
    (exported.folder / "check.json").write_text("{}")
    (exported.folder / "notes.txt").write_text("mine")
    again = export_policy(find_deployment("target"), tmp_path / "c")
    found = {path.name for path in again.folder.iterdir()}
    assert {path.name for path in again.folder.glob("*.c")} - {path.name for path in again.sources} == {
        "controller_out_of_tree.c"
    }
    assert "check.json" not in found
    assert "notes.txt" in found
    assert "cfb_policy_set_flip" not in "".join(path.read_text() for path in again.folder.glob("*.[ch]"))


def test_the_cards_of_the_policies_are_beside_the_c(tmp_path):
    exported = export_policy(find_deployment("double-flip"), tmp_path)
    card = (exported.folder / "card.md").read_text()
    assert all(path.with_name("card.md").read_text() in card for path in _held("flip", "target-analytic"))
    assert "`card.md`" in (exported.folder / "README.md").read_text()
    export_policy(Deployment("mine", random_policy(1, Layout())), tmp_path)
    assert not (tmp_path / "card.md").exists(), "one without a card leaves none of another policy"
    assert "card.md" not in (tmp_path / "README.md").read_text()


def _held(*names):
    return [shipped_policies()[name] for name in names]


def test_an_own_policy_file_is_exported(tmp_path):
    policy = random_policy(1, Layout())
    save_policy(policy, tmp_path / "mine.npz")
    assert main(["export", str(tmp_path / "mine.npz"), "-o", str(tmp_path / "c")]) == 0
    promised = json.loads((tmp_path / "c/contract.json").read_text())
    assert promised["policies"]["holder"]["weights_sha256"] == load_policy(tmp_path / "mine.npz").weights_sha256
    assert promised["trained_on"] is None
    assert promised["first_step"]["hover_command"] == pytest.approx(0.55, abs=0.01)


def test_a_flip_is_climbed_and_caught_by_whom_its_knobs_were_found_with():
    def held_by(*arguments, **options):
        return find_deployment(*arguments, **options).holder.weights_sha256

    assert held_by("double-flip") == held_by("flip", "double-flip") == load_policy("target-analytic").weights_sha256
    assert held_by("double-flip-ppo") == load_policy("target").weights_sha256
    assert held_by("double-flip-ppo", holder="target-adaptive") == load_policy("target-adaptive").weights_sha256


REFUSED = {
    "nothing": (["export", "nothing"], "no such policy"),
    "pid": (["export", "pid"], "no such policy"),
    "knobs of a target": (["export", "target", "--knobs", "flip"], "flip policies"),
    "knobs twice": (["export", "double-flip", "--knobs", "flip"], "manoeuvre already"),
    "loadable flip": (["export", "double-flip", "--loadable"], "cannot be loadable"),
    "a flip that holds": (["export", "flip", "--holder", "flip"], "needs a target policy"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_exported_is_refused_in_one_sentence(case, tmp_path, capfd):
    arguments, words = REFUSED[case]
    assert main([*arguments, "-o", str(tmp_path / "c")]) == 2
    said = capfd.readouterr().err
    assert words in said.replace("Needs", "needs")
    assert said.startswith("cfb: ")
    assert not (tmp_path / "c").exists()


def test_a_full_disk_leaves_the_export_before_as_it_was(tmp_path, monkeypatch):
    exported = export_policy(find_deployment("target"), tmp_path / "c")
    before = {path.name: path.read_bytes() for path in exported.folder.iterdir()}
    written = Path.write_text

    def full(self, text, **more):
        if "README" in self.name:
            raise OSError(28, "No space left on device")
        return written(self, text, **more)

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(CfbError, match="No space"):
        export_policy(find_deployment("target-adaptive"), tmp_path / "c")
    assert {path.name: path.read_bytes() for path in exported.folder.iterdir()} == before


def test_the_app_forgives_one_late_step(built, tmp_path):
    """Twelve ticks instead of eight: the flight goes on; seventeen: it begins anew."""
    exported, compiled = built(find_deployment("target"))
    app = firmware(exported, tmp_path)
    app.controllerOutOfTreeInit()
    control, seen = Control(), ((0, 0, 1), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0), (0.5, 0, 1))
    compiled.reset()
    expected = [compiled.step(*seen) for _ in range(3)]
    assert np.abs(expected[2] - expected[0]).max() > 1e-4
    for at, command in ((0, expected[0]), (8, expected[1]), (20, expected[2]), (37, expected[0])):
        np.testing.assert_allclose(tick(app, at, control), command, atol=1e-6)


def test_a_flip_asked_for_during_a_flip_is_not_begun(built):
    deployment = find_deployment("double-flip")
    compiled, knobs = built(deployment)[1], deployment.manoeuvre.knobs
    begin(deployment, compiled)
    phases = []
    for i in range(600):
        roll = min(0.2 * max(0, i - 60), 4 * math.pi)
        compiled.step(
            (0, 0, 1e-5 * (i % 2)),
            (0, 0, 2.5 if i > 50 else 0.0),
            (math.cos(roll / 2), math.sin(roll / 2), 0, 0),
            (0, 0, 0),
        )
        phases.append(compiled.phase)
        if i in (20, 55, 130):
            compiled.set_flip(float(knobs.speed_mps), float(knobs.rate_radps))
    hold, climb, turn, catch = range(4)
    assert [phases[20], phases[55], phases[130]] == [climb, turn, catch]
    assert [p for i, p in enumerate(phases) if i == 0 or phases[i - 1] != p] == [climb, turn, catch, hold]
