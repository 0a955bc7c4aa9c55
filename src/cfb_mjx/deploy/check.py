"""Check an exported policy: does it compute what it computes in JAX, and what does a step cost on the drone.

Three comparisons: commands on random estimates in independent sequences, flights of the compiled C in closed loop with
the simulated drone beside those of the JAX policy with the same noise, and the cost of a step.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from cfb_mjx.control.manoeuvre import Manoeuvre
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.deploy import cortex
from cfb_mjx.deploy.compiled import FLAGS, CompiledPolicy, compile_policy
from cfb_mjx.deploy.deployment import Deployment
from cfb_mjx.deploy.export import Exported
from cfb_mjx.deploy.weights import FILE, GOOD
from cfb_mjx.envs import StateEstimate, TargetTask, Task
from cfb_mjx.envs.episode import Episode, reset, step
from cfb_mjx.envs.task import with_room
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State
from cfb_mjx.optional import not_none

SEQUENCES, STEPS = 10_000, 12
TOLERANCE = 1e-5
"""Largest difference of a command in [0, 1]."""


class Parity(NamedTuple):
    """Differences between the commands of C and JAX."""

    sequences: int
    steps: int
    largest: float
    """Largest difference of a command, over all sequences, steps and motors."""
    mean: float


def compare(
    deployment: Deployment, compiled: CompiledPolicy, sequences: int = SEQUENCES, steps: int = STEPS, seed: int = 0
) -> Parity:
    """Run both on the same random estimates, each sequence after a reset, and compare every command.

    Args:
        deployment: the exported policies; a flip begins with the first step.
        compiled: the compiled C.
        sequences: number of sequences.
        steps: steps per sequence, more than the number of commands in a policy's history.
        seed: seed of the estimates.
    """
    inputs = random_inputs(np.random.default_rng(seed), sequences, steps, compiled.previews)
    expected = np.asarray(
        _commands(deployment.controller, jnp.asarray(deployment.settled(), jnp.float32), jnp.asarray(inputs))
    )
    found = np.empty_like(expected)
    for i in range(sequences):
        begin(deployment, compiled)
        found[i] = deployment.outputs(compiled.steps(inputs[i]))
    difference = np.abs(found.astype(float) - expected)
    return Parity(sequences, steps, float(difference.max()), float(difference.mean()))


def begin(deployment: Deployment, compiled: CompiledPolicy) -> None:
    """Reset the policy; a flip begins with the next step."""
    compiled.reset()
    if deployment.flips:
        knobs = not_none(deployment.manoeuvre).knobs
        compiled.set_flip(float(knobs.speed_mps), float(knobs.rate_radps))


def random_inputs(generator: np.random.Generator, sequences: int, steps: int, previews: int = 0) -> np.ndarray:
    """Random estimates, (sequences, steps, 16 + 3 previews), float32: near and far, slow and fast, any attitude."""
    # Half of the sequences hover about their targets, the others are anywhere.
    wide = np.where(np.arange(sequences) % 2, 1.0, 0.05)[:, None, None]
    shape = sequences, steps
    target = generator.uniform(-3, 3, (sequences, 1, 3)) * np.ones((*shape, 1))
    position = target + 6 * wide * generator.standard_normal((*shape, 3))
    velocity = 4 * wide * generator.standard_normal((*shape, 3))
    rotation = generator.standard_normal((*shape, 3)) * np.pi * wide
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    quaternion = np.concatenate([np.cos(angle / 2), rotation / angle * np.sin(angle / 2)], axis=-1)
    body_rate = 12 * wide * generator.standard_normal((*shape, 3))
    parts = [position, velocity, quaternion, body_rate, target]
    if previews:
        parts.append(wide * generator.standard_normal((*shape, 3 * previews)))
    return np.concatenate(parts, axis=-1).astype(np.float32)


@eqx.filter_jit
def _commands(controller, hover, inputs):
    def one(rows):
        def estimate(row):
            return StateEstimate(row[:3] - row[13:16], row[3:6], row[6:10], row[10:13])

        def step(memory, row):
            given = (row[16:],) if rows.shape[1] > 16 else ()
            return controller.command(memory, estimate(row), *given)

        first = controller.start(estimate(rows[0]), hover)
        return jax.lax.scan(step, first, rows)[1]

    return jax.vmap(one)(inputs)


Flier = NeuralController | Manoeuvre


class Beside(NamedTuple):
    """Two flights: C and JAX."""

    position: np.ndarray
    """(2, steps, 3), relative to the target, m."""
    command: np.ndarray
    """(2, steps, 4)."""
    dt: float
    """Time between two commands, s."""

    def command_difference(self, seconds: float | None = None) -> float:
        """Largest difference of a command, over all motors and the first ``seconds``."""
        until = None if seconds is None else round(seconds / self.dt)
        return float(np.abs(self.command[0, :until] - self.command[1, :until]).max())

    @property
    def distance_m(self) -> float:
        """Largest distance between the two drones at the same time."""
        return float(np.linalg.norm(self.position[0] - self.position[1], axis=-1).max())


def fly_beside(
    deployment: Deployment,
    compiled: CompiledPolicy,
    seconds: float,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
) -> Beside:
    """Fly both from hover, with the noise of trainings.

    Args:
        deployment: the exported policies; a flip begins with the first step.
        compiled: the compiled C.
        seconds: duration, s.
        offset: start relative to the target, m.
        seed: seed of the noise, the same for both.
    """
    plant = deployment.plant()
    controller, dt = deployment.controller, deployment.controller.control_dt_s
    if dt < plant.dt:
        plant = replace(plant, dt=dt)
    task = TargetTask(layout=deployment.holder.controller.layout, lumped_delay=deployment.holder.lumped_delay)
    task, start = with_room(task, plant), plant.hover_state(offset)
    hover = jnp.asarray(deployment.settled(), jnp.float32)
    steps = round(seconds / dt)
    position, command = np.empty((2, steps, 3)), np.empty((2, steps, 4), np.float32)

    for which in range(2):
        episode, memory = _first(task, plant, controller, start, hover, jax.random.PRNGKey(seed))
        begin(deployment, compiled)
        for i in range(steps):
            if which == 0:
                seen = episode.estimate
                u = deployment.outputs(compiled.step(seen.position, seen.velocity, seen.quaternion, seen.body_rate))
            else:
                memory, u = _commanded(controller, memory, episode.estimate)
            command[which, i] = u
            episode = _flown(task, episode, jnp.asarray(u, jnp.float32))
            position[which, i] = episode.state.position
    return Beside(position, command, dt)


# Compiled once for all flights of a policy.
@eqx.filter_jit
def _first(task: Task, plant: Quadrotor, controller: Flier, start: State, hover: Array, key: Array):
    episode = reset(task, plant, key, start)
    return episode, controller.start(episode.estimate, hover)


@eqx.filter_jit
def _commanded(controller: Flier, memory: Any, estimate: StateEstimate):
    return controller.command(memory, estimate)


@eqx.filter_jit
def _flown(task: Task, episode: Episode, u: Array) -> Episode:
    return step(task, episode, u)[0]


NEAR_M = 1e-3
"""Largest distance between the flights of C and JAX."""
FLASH, RAM, STEP_S = 64 * 1024, 8 * 1024, 1e-3
"""Limits of flash [bytes], memory [bytes] and time [s] of a step on the drone."""
FREE_RAM = 29_044
"""Limit of the memory with loadable weights, bytes: what the firmware's default build for the Crazyflie 2 leaves of its
128 kB (github.com/bitcraze/crazyflie-firmware/pull/1700, 2026)."""
STACK, FIRMWARE_STACK = 1000, 1800
"""Limit of the stack of a step, and the stack of the firmware's task that calls it (``STABILIZER_TASK_STACKSIZE``, 450
words), bytes. The task's own functions need the rest."""
_EMULATED_TOLERANCE = 1e-6


class Finding(NamedTuple):
    """Result of one check."""

    text: str
    good: bool = True


class Check(NamedTuple):
    """Results of all checks."""

    numbers: dict[str, Any]
    findings: list[Finding]

    @property
    def faults(self) -> list[str]:
        """Texts of the failed checks."""
        return [finding.text for finding in self.findings if not finding.good]


def check_export(exported: Exported) -> Check:
    """Compile the C, compare it with JAX on random sequences and in closed loop, and measure its costs.

    Args:
        exported: the exported policy.

    Raises:
        CfbError: there is no compiler, or it reports an error.
    """
    deployment, compiled = exported.deployment, compile_policy(exported)
    parity = compare(deployment, compiled)
    six = fly_beside(deployment, compiled, 6.0)
    # A flip is demanding from its start; holding a target is demanding from a distance.
    second = six if deployment.flips else fly_beside(deployment, compiled, 1.0, (0.5, -0.5, 0.3))
    largest, what = second.command_difference(1.0), "flip" if deployment.flips else "hover"
    costs, about_costs = _costs(exported, compiled)
    findings = [
        Finding(f"compiles with {' '.join(FLAGS)}"),
        Finding(
            f"commands on {parity.sequences} random sequences of {parity.steps} estimates: within {parity.largest:.1e} "
            "of JAX's",
            parity.largest <= TOLERANCE,
        ),
        Finding(f"commands of a second in closed loop: within {largest:.1e}", largest <= TOLERANCE),
        Finding(f"6 s of {what} in closed loop: within {1e3 * six.distance_m:.1e} mm of JAX", six.distance_m <= NEAR_M),
        *about_costs,
        *([_loads(exported, compiled)] if deployment.loadable else []),
    ]
    numbers = {
        "policy": deployment.name,
        "weights_sha256": {name: p.weights_sha256 for name, p in deployment.policies.items()},
        "parity": parity._asdict(),
        "closed_loop": {"command_difference@1s": largest, f"{what}_distance_m@6s": six.distance_m},
        "cortex_m4": costs,
        "passed": all(finding.good for finding in findings),
    }
    return Check(numbers, findings)


def _loads(exported: Exported, compiled: CompiledPolicy) -> Finding:
    """Whether the C takes its own weights as a set, and then gives the same commands."""
    rows = random_inputs(np.random.default_rng(2), 16, 12, compiled.previews).reshape(192, -1)
    compiled.reset()
    flash, status = compiled.steps(rows), compiled.load_weights((exported.folder / FILE).read_bytes())
    same = status == GOOD and np.array_equal(compiled.steps(rows), flash)
    return Finding(f"{FILE}: status {status}, {'the same' if same else 'other'} commands as from flash", same)


def _costs(exported: Exported, compiled: CompiledPolicy) -> tuple[dict[str, Any], list[Finding]]:
    """Cost of a step on the drone's processor: numbers and findings."""
    deployment, findings = exported.deployment, []
    macs, cycles, clock = cortex.multiply_accumulates(deployment), cortex.CYCLES_PER_INSTRUCTION, cortex.CLOCK_HZ
    found: dict[str, Any] = {"multiply_accumulates": macs, "clock_hz": clock}
    if cortex.has_compiler():
        size = cortex.size(exported)
        found |= {"flash_bytes": size.flash, "ram_bytes": size.ram, "stack_bytes": size.stack}
        ram = FREE_RAM if deployment.loadable else RAM
        said = f"{size.flash / 1024:.1f} of {FLASH // 1024} kB of flash, {size.ram} of {ram} B of memory"
        findings.append(Finding(f"Cortex-M4: {said}", size.flash <= FLASH and size.ram <= ram))
        said = f"at most {size.stack} of {STACK} B of stack, of the {FIRMWARE_STACK} B that the firmware's task has"
        findings.append(Finding(said, size.stack <= STACK))
    else:
        findings.append(Finding("Cortex-M4 sizes: not measured, arm-none-eabi-gcc is not installed"))
    if cortex.has_emulator():
        rows = random_inputs(np.random.default_rng(1), 16, 12, compiled.previews).reshape(192, -1)
        run = cortex.emulate(exported, rows)
        begin(deployment, compiled)
        apart = float(np.abs(deployment.outputs(compiled.steps(rows)) - deployment.outputs(run.commands)).max())
        said = f"commands on an emulated STM32F405: within {apart:.1e} of this machine's C"
        findings.append(Finding(said, apart <= _EMULATED_TOLERANCE))
        instructions, how = float(run.instructions.max()), "counted on an emulated STM32F405"
        found["emulated_command_difference"] = apart
    else:
        instructions, how = cortex.estimated_instructions(deployment), "estimated from the multiply-accumulates"
    seconds, limit = instructions * cycles / clock, min(STEP_S, deployment.holder.controller.control_dt_s)
    said = (
        f"a step: {macs} multiply-accumulates, {instructions:.0f} instructions ({how}); at {clock / 1e6:.0f} MHz and "
        f"{cycles:g} cycles each {1e3 * seconds:.2f} of {1e3 * limit:g} ms"
    )
    findings.append(Finding(said, seconds <= limit))
    return found | {
        "instructions": instructions,
        "instructions_from": how,
        "step_s": seconds,
        "cycles_per_instruction": cycles,
    }, findings
