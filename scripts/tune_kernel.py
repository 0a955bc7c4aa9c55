"""Measure the GPU kernel of rollouts beside the plain program, for several batch sizes and ways to deal out drones.

    python scripts/tune_kernel.py [--drones 64 1024 8192 65536] [--steps 500] [--every 100]

Needs a GPU. For each batch: steps per second of the plain program and of the kernel with each tuning, best of several
runs that take turns, and how far apart their results are (largest difference over largest value). Every drone has its
own model, state and commands, and states are kept. `--interpret` tries the script itself without a GPU.
"""

from __future__ import annotations

import argparse
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.cli.runtime import environment
from cfb_mjx.model import Quadrotor, rollout
from cfb_mjx.model.acceleration import using
from cfb_mjx.model.kernel import Tuning
from cfb_mjx.parameters import load_randomisation, sample_parameters

TUNINGS = [Tuning(block, warps) for block, warps in ((32, 1), (64, 2), (128, 4), (256, 8), (128, 2), (128, 1))]
REPETITIONS = 7


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drones", type=int, nargs="+", default=[64, 1024, 8192, 65536, 524288])
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--every", type=int, default=100)
    parser.add_argument("--interpret", action="store_true")
    options = parser.parse_args()
    if jax.default_backend() != "gpu" and not options.interpret:
        print("There is no GPU here; --interpret tries the script without one.", file=sys.stderr)
        return 2
    print(", ".join(f"{name} {value}" for name, value in environment().items()))
    print(f"{'drones':>8} {'way':<24}{'steps/s':>10}{'compile s':>11}{'apart':>10}")
    for drones in options.drones:
        measure(drones, options.steps, options.every, "interpret" if options.interpret else "kernel")
    return 0


def measure(drones: int, steps: int, every: int, way: str) -> None:
    """Print a line for each way to fly this many drones."""
    arguments = flights(drones, steps)
    programs = {"plain": compiled("plain", None, every, arguments)}
    for tuning in TUNINGS:
        programs[f"{way} {tuning.block}/{tuning.warps}"] = compiled(way, tuning, every, arguments)
    expected = programs["plain"][0](*arguments)
    best = dict.fromkeys(programs, float("inf"))
    for _ in range(REPETITIONS):
        for name, (program, _) in programs.items():
            begin = time.perf_counter()
            jax.block_until_ready(program(*arguments))
            best[name] = min(best[name], time.perf_counter() - begin)
    for name, (program, compile_s) in programs.items():
        apart = max(jax.tree.leaves(jax.tree.map(_apart, program(*arguments), expected)))
        print(f"{drones:>8} {name:<24}{drones * steps / best[name]:>10.3g}{compile_s:>11.2f}{apart:>10.1e}", flush=True)


def flights(drones: int, steps: int):
    """Models drawn from the paper's ranges, states near hover, commands (steps, 4, drones) near hover."""
    model = Quadrotor.from_file("cfb-guards")
    keys = jax.random.split(jax.random.key(0), drones)
    draw = jax.vmap(lambda key: sample_parameters(key, model.parameters, load_randomisation()))
    state = model.hover_state()
    states = jax.tree.map(lambda x: x + 0.01 * jax.random.normal(jax.random.key(1), (drones, *x.shape)), state)
    noise = 1 + 0.02 * jax.random.normal(jax.random.key(2), (steps, 4, drones))
    return Quadrotor(jax.jit(draw)(keys)), states, model.hover_command()[:, None] * noise


def compiled(way: str, tuning: Tuning | None, every: int, arguments):
    """The program, run once, and the seconds it took to compile."""
    begin = time.perf_counter()
    with using(way, tuning):
        fly = jax.vmap(lambda model, state, commands: rollout(model, state, commands, every=every), (0, 0, 2))
        program = jax.jit(fly).lower(*arguments).compile()
    compile_s = time.perf_counter() - begin
    jax.block_until_ready(program(*arguments))
    return program, compile_s


def _apart(a, b) -> float:
    return float(np.abs(jnp.asarray(a) - b).max() / np.abs(b).max())


if __name__ == "__main__":
    sys.exit(main())
