"""Runs under a Python that has crazyflow (not cfb_mjx): times one flight of all drones for every line it is sent.

Usage: python crazyflow_peer.py DRONES [NETWORK.npz | environment]. Answers ``ready VERSION COMPILE_SECONDS STEPS``,
then seconds per request. Without a network a flight is ``sim.step(500)`` at crazyflow's own 500 Hz. With one (weights
w0, b0, w1 ... of a tanh network that sees the present and one past estimate and six past commands) it is 1 s of that
network in the loop, a command every 8 ms, two steps of 4 ms each, as one program of crazyflow's pure functions. With
the word it is 20 steps of the Gymnasium environment `ReachPosEnv` with these dynamics and its other defaults.
"""

import contextlib
import sys
import time
import warnings

warnings.filterwarnings("ignore")
OPEN_STEPS, COMMANDS, HOLD, RPM = 500, 125, 2, 22000.0
ENVIRONMENT_STEPS = 20


def open_loop(drones):
    """``sim.step`` under a fresh command each time, as a user's loop would set one."""
    sim = simulator(drones, 500)
    command = np.full((drones, 1, 4), 16000.0, dtype=np.float32)

    def fly():
        sim.rotor_vel_control(command)
        begin = time.perf_counter()
        sim.step(OPEN_STEPS)
        jax.block_until_ready(sim.data.states.pos)
        return time.perf_counter() - begin

    return fly, OPEN_STEPS


def closed_loop(drones, path):
    """The network reads the states and commands rotor speeds."""
    with np.load(path) as file:
        layers = [(jnp.asarray(file[f"w{i}"]), jnp.asarray(file[f"b{i}"])) for i in range(len(file.files) // 2)]
    sim = simulator(drones, 250)
    sim.data = sim.data.replace(
        states=sim.data.states.replace(pos=jnp.asarray(np.random.default_rng(0).normal(1, 0.3, (drones, 1, 3)), "f4"))
    )
    step = sim.build_step_fn()

    def frame(states):
        x, y, z, w = jnp.moveaxis(states.quat[:, 0], -1, 0)
        turn = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
        turn += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
        turn += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
        moved = states.pos[:, 0], states.vel[:, 0] / 2, jnp.stack(turn, -1), states.ang_vel[:, 0] / 10
        return jnp.concatenate(moved, -1)

    def one(carry, _):
        data, past, commands = carry
        now = frame(data.states)
        x = jnp.concatenate([now, past, commands.reshape(drones, -1)], -1)
        for weight, bias in layers[:-1]:
            x = jnp.tanh(x @ weight + bias)
        u = 0.5 * (1 + jnp.tanh(x @ layers[-1][0] + layers[-1][1]))
        data = step(functional.rotor_vel_control(data, RPM * u[:, None]), HOLD)
        return (data, now, jnp.concatenate([2 * u[:, None] - 1, commands[:, :-1]], 1)), None

    @jax.jit
    def flight(data):
        carry = data, frame(data.states), jnp.zeros((drones, 6, 4))
        return jax.lax.scan(one, carry, length=COMMANDS)[0][0]

    def fly():
        begin = time.perf_counter()
        jax.block_until_ready(flight(sim.data).states.pos)
        return time.perf_counter() - begin

    return fly, COMMANDS * HOLD


def environment(drones):
    """Steps under random attitude commands near hover; everything is read as numpy arrays."""
    from crazyflow.envs.reach_pos_env import ReachPosEnv

    env = ReachPosEnv(num_envs=drones, dynamics="first_principles")
    env.reset(seed=0)
    low, high = env.action_space.low, env.action_space.high
    shares = np.random.default_rng(0).uniform(0.45, 0.55, (ENVIRONMENT_STEPS, drones, 4)).astype("f4")
    actions = low + shares * (high - low)

    def fly():
        begin = time.perf_counter()
        for action in actions:
            jax.tree.map(np.asarray, env.step(action))
        return time.perf_counter() - begin

    return fly, ENVIRONMENT_STEPS


def simulator(drones, frequency):
    """First-principles dynamics under rotor-velocity control."""
    return Sim(
        n_worlds=drones,
        n_drones=1,
        drone="cf21B_500",
        dynamics="first_principles",
        control=Control.rotor_vel,
        freq=frequency,
        device="cpu" if jax.default_backend() == "cpu" else "gpu",
    )


with contextlib.redirect_stdout(sys.stderr):
    from importlib.metadata import version

    import jax
    import jax.numpy as jnp
    import numpy as np
    from crazyflow.control import Control
    from crazyflow.sim import Sim, functional

    count, what = int(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None
    if what is None:
        fly, steps = open_loop(count)
    elif what == "environment":
        fly, steps = environment(count)
    else:
        fly, steps = closed_loop(count, what)
    begin = time.perf_counter()
    fly()
    compiled = time.perf_counter() - begin

print("ready", version("crazyflow"), compiled, steps, flush=True)
for _ in sys.stdin:
    print(fly(), flush=True)
