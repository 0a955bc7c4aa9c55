"""What ``cfb bench`` measures: each workload is a compiled program with its arguments and its number of steps."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

from cfb_mjx.control.closed_loop import at_once, rollout_closed_loop
from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.devices import Devices
from cfb_mjx.engine.gpu import using
from cfb_mjx.files import shipped
from cfb_mjx.model import MjxBody, Quadrotor, rollout_final
from cfb_mjx.model import rollout as every_state
from cfb_mjx.model.mjx_body import mjx
from cfb_mjx.model.state import State
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import load_randomisation, sample_parameters

STEPS = 500
MJX_WORK = 200_000
"""Steps of all drones together in one MJX measurement; MJX is some hundred times slower than the closed form."""

KEPT = 1_000_000
"""States of all drones together in one measurement that keeps them: 70 MB."""


@dataclass
class Workload:
    """A measurable program: ``run`` blocks until done."""

    what: str
    body: str
    drones: int
    steps: int
    run: Callable[[], None]
    compile_s: float
    peak_mb: float
    devices: int
    trace: tuple[Callable, tuple]
    """The function and its arguments, before compiling."""

    def seconds(self) -> float:
        """Wall time of one run."""
        begin = time.perf_counter()
        self.run()
        return time.perf_counter() - begin


def _compile(
    what: str, body: str, drones: int, steps: int, function, *arguments, over: Devices | None = None
) -> Workload:
    """With ``over``, what comes after the first argument is divided over these devices."""
    if over is not None:
        function = over.divided(function, (None, *[0] * (len(arguments) - 1)), 0)
        arguments = (over.whole(arguments[0]), *over.along(arguments[1:]))
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_s = time.perf_counter() - begin
    memory = not_none(compiled.memory_analysis())
    peak = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    jax.block_until_ready(compiled(*arguments))  # first call: allocations

    def run():
        jax.block_until_ready(compiled(*arguments))

    devices = 1 if over is None else over.count
    return Workload(what, body, drones, steps, run, compile_s, peak / 2**20, devices, (function, arguments))


def _start(model: Quadrotor, drones: int):
    hover, command = model.hover_state(), model.hover_command()
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (drones, *x.shape)), hover)
    # Not all alike: nothing may be shared between drones.
    commands = command * (1 + 0.01 * jax.random.normal(jax.random.key(0), (drones, 1, 4)))
    return states, commands


def rollout(drones: int, body: str = "rigid", over: Devices | None = None) -> Workload:
    """Open loop, one command held per drone, final state only: what crazyflow's ``sim.step(n)`` does.

    With ``over`` the drones are divided over several devices.
    """
    mjx_floor = {"mjx": False, "mjx-floor": True}
    choices = {"body": MjxBody(floor=mjx_floor[body])} if body in mjx_floor else {}
    model = Quadrotor.from_file("cfb-guards", **choices)
    steps = max(5, min(200, MJX_WORK // drones)) if choices else STEPS
    states, commands = _start(model, drones)
    fly = jax.vmap(lambda m, s, u: rollout_final(m, s, u, hold=steps), in_axes=(None, 0, 0))
    # Beside the kernel that a GPU gets, the program it would have got without.
    with using("plain") if body == "rigid-plain" else contextlib.nullcontext():
        return _compile("rollout", body, drones, steps, fly, model, states, commands, over=over)


def rollout_kept(drones: int) -> Workload:
    """As `rollout` (closed form), every state kept; fewer steps of many drones."""
    model, steps = Quadrotor.from_file("cfb-guards"), max(10, min(STEPS, KEPT // drones))
    states, commands = _start(model, drones)
    commands = jnp.repeat(commands, steps, axis=1)
    fly = jax.vmap(every_state, in_axes=(None, 0, 0))
    return _compile("rollout_kept", "rigid", drones, steps, fly, model, states, commands)


def rollout_randomised(drones: int) -> Workload:
    """As `rollout` (closed form) with every drone's parameters drawn from the paper's randomisation."""
    model = Quadrotor.from_file("cfb-guards")
    ranges = load_randomisation()

    def draw(key):
        parameters = sample_parameters(key, model.parameters, ranges)
        return eqx.tree_at(lambda m: m.parameters, model, parameters)

    models = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(1), drones))
    states, commands = _start(model, drones)
    fly = jax.vmap(lambda m, s, u: rollout_final(m, s, u, hold=STEPS))
    return _compile("rollout_randomised", "rigid", drones, STEPS, fly, models, states, commands)


def rollout_gradient(drones: int) -> Workload:
    """Reverse-mode gradient of the final position's square with respect to all parameters, 100 steps."""
    model = Quadrotor.from_file("cfb-guards")
    states, commands = _start(model, drones)

    return _compile("rollout_gradient", "rigid", drones, 100, jax.grad(_distance), model, states, commands)


def _distance(model: Quadrotor, states: State, commands: Array) -> Array:
    """Mean square of the final distance after 100 steps."""
    final = jax.vmap(lambda s, u: rollout_final(model, s, u, hold=100))(states, commands)
    return jnp.mean(jnp.sum(final.position**2, axis=-1))


def rollout_policy(drones: int, over: Devices | None = None) -> Workload:
    """Closed loop: the shipped policy `target-analytic` commands every 8 ms on the true state, two steps of 4 ms each.

    With ``over`` the drones are divided over several devices.
    """
    model = Quadrotor.from_file("cfb-guards")
    controller = load_policy("target-analytic").controller
    states, _ = _start(model, drones)
    offsets = 0.3 * jax.random.normal(jax.random.key(2), (drones, 3))
    states = eqx.tree_at(lambda s: s.position, states, offsets)
    commands = STEPS // 4

    def fly(model, state):
        flown = rollout_closed_loop(model, controller, state, commands, every=commands)
        return jax.tree.map(lambda x: x[-1], flown.state)

    together = jax.vmap(fly, in_axes=(None, 0))
    return _compile("rollout_policy", "rigid", drones, 2 * commands, together, model, states, over=over)


def network_alone(drones: int) -> Workload:
    """The network of `rollout_policy` as often as there, with nothing to fly: no simulator can be faster with it."""
    controller = load_policy("target-analytic").controller
    commands, groups = STEPS // 4, -(-drones // at_once())

    def one(shown, _):
        # Every command is seen by the next one; nothing could be left out.
        return shown.at[:4].set(controller.act(shown)), None

    def act(shown):
        return jax.lax.map(lambda shown: jax.lax.scan(one, shown, length=commands)[0], shown)

    shown = jax.random.normal(jax.random.key(3), (groups, controller.layout.size, -(-drones // groups)))
    return _compile("network_alone", "none", drones, 2 * commands, act, shown)


def network_file(folder: Path) -> Path:
    """The network of `rollout_policy` as arrays w0, b0, w1 ..., for a peer."""
    network = load_policy("target-analytic").controller.network
    layers = enumerate(zip(network.weights, network.biases, strict=True))
    path = folder / "network.npz"
    arrays: dict[str, Any] = {f"{k}{i}": np.asarray(x) for i, layer in layers for k, x in zip("wb", layer, strict=True)}
    np.savez(path, **arrays)
    return path


def rollout_ten(drones: int) -> Workload:
    """As `rollout_gradient`, with respect to ten parameters only."""
    states, commands, loss = _of_ten_parameters(drones)
    return _compile("rollout_ten", "rigid", drones, 100, jax.grad(loss), jnp.ones(10), states, commands)


def rollout_hundred(drones: int) -> Workload:
    """The loss that `rollout_ten` differentiates, alone."""
    states, commands, loss = _of_ten_parameters(drones)
    return _compile("rollout_hundred", "rigid", drones, 100, loss, jnp.ones(10), states, commands)


def _of_ten_parameters(drones: int):
    """States, commands, and the loss as a function of ten factors of parameters and of them."""
    model = Quadrotor.from_file("cfb-guards")
    names = ("mass", "inertia", "rotor_inertia", "motor_time_constant", "motor_gain", "thrust_scale", "torque_scale")

    def changed(x):
        scale = dict(zip(names, (x[0], x[1:4], x[4], x[5], x[6], x[7], x[8]), strict=True))
        parameters = model.parameters
        for name, factor in scale.items():
            parameters = eqx.tree_at(lambda p, n=name: getattr(p, n), parameters, getattr(parameters, name) * factor)
        spacing = parameters.rotor_spacing * x[9]
        return eqx.tree_at(lambda m: m.parameters, model, eqx.tree_at(lambda p: p.rotor_spacing, parameters, spacing))

    return *_start(model, drones), lambda x, s, u: _distance(changed(x), s, u)


def fit_jacobian() -> Workload:
    """Residuals of a fit to the shipped logs, and their derivatives by its parameters; a step is a row of a log."""
    from cfb_mjx.logs import read_log
    from cfb_mjx.sysid.identification.fitting import fit_slopes
    from cfb_mjx.sysid.identification.flight_data import prepare
    from cfb_mjx.sysid.identification.noise import Noise
    from cfb_mjx.sysid.identification.unknowns import choose

    nominal = Quadrotor.from_file("cfb-guards").parameters
    logs = [read_log(path) for path in sorted(shipped("data", "flight_logs").glob("*.mcap"))]
    data = prepare(logs)
    unknowns = choose("inertia,rotor_inertia,motor,thrust_scale,torque_scale", nominal)
    segments, noise = jax.tree.map(jnp.asarray, (not_none(data.segments), Noise.first(data)))

    def slopes(vector, segments):
        return fit_slopes(unknowns, vector, noise, segments, True, False)

    count, rows = segments.valid.shape
    return _compile("fit_jacobian", f"{len(unknowns.names)} parameters", count, rows, slopes, unknowns.start, segments)


def ppo_update(drones: int = 512) -> Workload:
    """One update of PPO with the shipped configuration: flights of all drones, and the learning from them."""
    from cfb_mjx.train.config import load_config
    from cfb_mjx.train.ppo import Ppo
    from cfb_mjx.train.run import Training, build

    training = Training.prepare(load_config("target", (f"ppo.drones={drones}",)), {})
    nominal, config = training.nominal(), training.config
    task = config.build_task()
    algorithm = build(config, task, nominal)
    assert isinstance(algorithm, Ppo)  # as the shipped configuration says
    state = algorithm.begin(jax.random.PRNGKey(0), training.first_controller(nominal))
    arrays, rest = eqx.partition(state, eqx.is_array)

    def update(arrays):
        return eqx.filter(algorithm._update(eqx.combine(arrays, rest)), eqx.is_array)

    return _compile("ppo", "rigid", drones, config.ppo.unroll * task.hold(nominal), update, arrays)


def stock_mjx(drones: int) -> Workload:
    """Plain ``mjx.step`` on the shipped MJCF with contacts switched off and a constant applied force, for reference."""
    specification = mujoco.MjSpec.from_file(str(shipped("assets", "cfb.xml")))
    specification.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model = mjx.put_model(specification.compile(), impl="jax")
    steps = max(5, min(200, MJX_WORK // drones))
    force = jnp.tile(jnp.array([0.0, 0.0, 0.044 * 9.81, 1e-6, 0.0, 0.0]), (drones, 1))
    data = jax.vmap(lambda f: mjx.make_data(model).replace(qfrc_applied=f))(force)

    def fly(data):
        final, _ = jax.lax.scan(
            lambda d, _: (jax.vmap(mjx.step, in_axes=(None, 0))(model, d), None), data, length=steps
        )
        return final.qpos, final.qvel

    return _compile("rollout", "mjx-stock", drones, steps, fly, data)
