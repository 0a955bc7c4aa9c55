"""What ``cfb bench`` measures: each workload is a compiled program with its arguments and its number of steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco

from cfb_mjx.files import shipped
from cfb_mjx.model import MjxBody, Quadrotor, rollout_final
from cfb_mjx.model.mjx_body import mjx
from cfb_mjx.parameters import load_randomisation, sample_parameters

STEPS = 500
MJX_WORK = 200_000
"""Steps of all drones together in one MJX measurement; MJX is some hundred times slower than the closed form."""


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

    def seconds(self) -> float:
        """Wall time of one run."""
        begin = time.perf_counter()
        self.run()
        return time.perf_counter() - begin


def _compile(what: str, body: str, drones: int, steps: int, function, *arguments) -> Workload:
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_s = time.perf_counter() - begin
    memory = compiled.memory_analysis()
    peak = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    jax.block_until_ready(compiled(*arguments))  # first call: allocations

    def run():
        jax.block_until_ready(compiled(*arguments))

    return Workload(what, body, drones, steps, run, compile_s, peak / 2**20)


def _start(model: Quadrotor, drones: int):
    hover, command = model.hover_state(), model.hover_command()
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (drones, *x.shape)), hover)
    # Not all alike: nothing may be shared between drones.
    commands = command * (1 + 0.01 * jax.random.normal(jax.random.key(0), (drones, 1, 4)))
    return states, commands


def rollout(drones: int, body: str = "rigid") -> Workload:
    """Open loop, one command held per drone, final state only: what crazyflow's ``sim.step(n)`` does."""
    bodies = {"rigid": None, "mjx": False, "mjx-floor": True}
    choices = {} if body == "rigid" else {"body": MjxBody(floor=bodies[body])}
    model = Quadrotor.from_file("cfb-guards", **choices)
    steps = STEPS if body == "rigid" else max(5, min(200, MJX_WORK // drones))
    states, commands = _start(model, drones)
    fly = jax.vmap(lambda m, s, u: rollout_final(m, s, u, hold=steps), in_axes=(None, 0, 0))
    return _compile("rollout", body, drones, steps, fly, model, states, commands)


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

    def loss(m, s, u):
        final = jax.vmap(lambda s, u: rollout_final(m, s, u, hold=100))(s, u)
        return jnp.mean(jnp.sum(final.position**2, axis=-1))

    return _compile("rollout_gradient", "rigid", drones, 100, jax.grad(loss), model, states, commands)


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
