"""The workloads of ``cfb bench``: compiled programs with their arguments and numbers of steps."""

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
from cfb_mjx.model import MjxBody, MujocoBody, Quadrotor, rollout_final
from cfb_mjx.model import rollout as every_state
from cfb_mjx.model.mjx_body import mjx
from cfb_mjx.model.state import State
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import load_randomisation, sample_parameters

STEPS = 500
MJX_WORK = 200_000
"""Steps of all drones together in one MJX measurement; without a floor MJX is a hundred times slower than the closed
form."""

ENVIRONMENT_STEPS = 20
"""Steps of an environment in one measurement."""

HEIGHT_M = 1.0
"""Height of the drones above the floor, if there is one."""

KEPT = 1_000_000
"""States of all drones together in a measurement that returns them: 70 MB."""


@dataclass
class Workload:
    """A compiled program to measure; ``run`` returns when it is done."""

    what: str
    body: str
    drones: int
    steps: int
    run: Callable[[], None]
    compile_s: float
    peak_mb: float | None
    devices: int
    trace: tuple[Callable, tuple] | None = None
    """The function and its arguments, before compiling; None for what is not one program."""

    def seconds(self) -> float:
        """Run it once and return the wall time."""
        begin = time.perf_counter()
        self.run()
        return time.perf_counter() - begin


def _compile(
    what: str, body: str, drones: int, steps: int, function, *arguments, over: Devices | None = None
) -> Workload:
    """Compile a workload; with ``over``, the arguments after the first are divided over these devices."""
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
    hover, command = model.hover_state((0.0, 0.0, HEIGHT_M)), model.hover_command()
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (drones, *x.shape)), hover)
    # Different commands, so that no work can be shared between drones.
    commands = command * (1 + 0.01 * jax.random.normal(jax.random.key(0), (drones, 1, 4)))
    return states, commands


def rollout(drones: int, body: str = "rigid", over: Devices | None = None) -> Workload:
    """Open-loop rollout that returns the final state, with one command held per drone, as crazyflow's ``sim.step(n)``.

    Args:
        drones: number of drones.
        body: ``rigid``, ``rigid-plain`` (without the GPU kernel), ``mjx``, ``mjx-floor`` or ``mujoco-floor``; the
            drones hover `HEIGHT_M` above the floor.
        over: devices that share the drones; one device by default.
    """
    bodies = {"mjx": lambda: MjxBody(floor=False), "mjx-floor": MjxBody, "mujoco-floor": MujocoBody}
    choices: dict[str, Any] = {"body": bodies[body]()} if body in bodies else {}
    model = Quadrotor.from_file("cfb-guards", **choices)
    steps = max(5, min(200, MJX_WORK // drones)) if choices else STEPS
    states, commands = _start(model, drones)
    fly = jax.vmap(lambda m, s, u: rollout_final(m, s, u, hold=steps), in_axes=(None, 0, 0))
    # The program without the kernel that a GPU uses by default.
    with using("plain") if body == "rigid-plain" else contextlib.nullcontext():
        return _compile("rollout", body, drones, steps, fly, model, states, commands, over=over)


def rollout_kept(drones: int) -> Workload:
    """Rollout of the closed form that returns every state; large batches take fewer steps."""
    model, steps = Quadrotor.from_file("cfb-guards"), max(10, min(STEPS, KEPT // drones))
    states, commands = _start(model, drones)
    commands = jnp.repeat(commands, steps, axis=1)
    fly = jax.vmap(every_state, in_axes=(None, 0, 0))
    return _compile("rollout_kept", "rigid", drones, steps, fly, model, states, commands)


def rollout_randomised(drones: int) -> Workload:
    """Rollout of the closed form with the parameters of every drone drawn from the paper's randomisation."""
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
    """Reverse-mode gradient of the squared final distance after 100 steps with respect to all parameters."""
    model = Quadrotor.from_file("cfb-guards")
    states, commands = _start(model, drones)

    return _compile("rollout_gradient", "rigid", drones, 100, jax.grad(_distance), model, states, commands)


def _distance(model: Quadrotor, states: State, commands: Array) -> Array:
    """Mean square of the final distance after 100 steps."""
    final = jax.vmap(lambda s, u: rollout_final(model, s, u, hold=100))(states, commands)
    return jnp.mean(jnp.sum(final.position**2, axis=-1))


def rollout_policy(drones: int, over: Devices | None = None) -> Workload:
    """Closed-loop rollout: the shipped policy `target-analytic` reads the true state every 8 ms, two steps of 4 ms.

    Args:
        drones: number of drones.
        over: devices that share the drones; one device by default.
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
    """The network of `rollout_policy`, evaluated as often, without a simulation: an upper bound for any simulator."""
    controller = load_policy("target-analytic").controller
    commands, groups = STEPS // 4, -(-drones // at_once())

    def one(shown, _):
        # Every evaluation depends on the last one, so that none can be optimised away.
        return shown.at[:4].set(controller.act(shown)), None

    def act(shown):
        return jax.lax.map(lambda shown: jax.lax.scan(one, shown, length=commands)[0], shown)

    shown = jax.random.normal(jax.random.key(3), (groups, controller.layout.size, -(-drones // groups)))
    return _compile("network_alone", "none", drones, 2 * commands, act, shown)


def network_file(folder: Path) -> Path:
    """Write the network of `rollout_policy` as arrays w0, b0, w1 ..., for a peer; return the path of the file."""
    network = load_policy("target-analytic").controller.network
    layers = enumerate(zip(network.weights, network.biases, strict=True))
    path = folder / "network.npz"
    arrays: dict[str, Any] = {f"{k}{i}": np.asarray(x) for i, layer in layers for k, x in zip("wb", layer, strict=True)}
    np.savez(path, **arrays)
    return path


def rollout_ten(drones: int) -> Workload:
    """Reverse-mode gradient of the loss of `rollout_hundred` with respect to ten parameters."""
    states, commands, loss = _of_ten_parameters(drones)
    return _compile("rollout_ten", "rigid", drones, 100, jax.grad(loss), jnp.ones(10), states, commands)


def rollout_hundred(drones: int) -> Workload:
    """The loss over 100 steps that `rollout_ten` differentiates, without derivatives."""
    states, commands, loss = _of_ten_parameters(drones)
    return _compile("rollout_hundred", "rigid", drones, 100, loss, jnp.ones(10), states, commands)


def _of_ten_parameters(drones: int):
    """Return states, commands, and the loss as a function of ten factors of parameters, states and commands."""
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
    """Residuals of a fit to the shipped logs and their derivatives with respect to its parameters; a step is a row."""
    from cfb_mjx.logs import read_log
    from cfb_mjx.sysid.identification.flight_data import prepare
    from cfb_mjx.sysid.identification.likelihood import fit_slopes
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
    """One update of PPO with the shipped configuration: flights of all drones, and training on them."""
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


def gymnasium(drones: int) -> Workload:
    """Steps of the Gymnasium environment, of 8 ms each, on drones drawn from the paper's randomisation."""
    from cfb_mjx.envs.gym import TargetVectorEnv
    from cfb_mjx.envs.target import TargetTask

    begin = time.perf_counter()
    env = TargetVectorEnv(drones, TargetTask(randomisation=load_randomisation()))
    env.reset(seed=0)
    # About hover, so that episodes end as often as those of an untrained policy.
    actions = np.random.default_rng(0).uniform(-0.2, 0.3, (ENVIRONMENT_STEPS, drones, 4)).astype(np.float32)

    def run():
        for action in actions:
            env.step(action)

    run()
    compile_s = time.perf_counter() - begin
    return Workload("gymnasium", "rigid", drones, ENVIRONMENT_STEPS, run, compile_s, None, 1)


def stock_mjx(drones: int) -> Workload:
    """Plain ``mjx.step`` on the shipped MJCF, without contacts and with a constant applied force, for reference."""
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
