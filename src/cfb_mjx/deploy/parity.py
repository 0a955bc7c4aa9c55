"""Compare the commands of C and JAX on random estimates, in independent sequences."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.deploy.compiled import CompiledPolicy
from cfb_mjx.deploy.deployment import Deployment
from cfb_mjx.envs.observation import Estimate
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
    inputs = random_inputs(np.random.default_rng(seed), sequences, steps)
    expected = np.asarray(
        _commands(deployment.controller, jnp.float32(deployment.hover_command()), jnp.asarray(inputs))
    )
    found = np.empty_like(expected)
    for i in range(sequences):
        begin(deployment, compiled)
        found[i] = compiled.steps(inputs[i])
    difference = np.abs(found.astype(float) - expected)
    return Parity(sequences, steps, float(difference.max()), float(difference.mean()))


def begin(deployment: Deployment, compiled: CompiledPolicy) -> None:
    """Reset the policy; a flip begins with the next step."""
    compiled.reset()
    if deployment.flips:
        knobs = not_none(deployment.manoeuvre).knobs
        compiled.set_flip(float(knobs.speed_mps), float(knobs.rate_radps))


def random_inputs(generator: np.random.Generator, sequences: int, steps: int) -> np.ndarray:
    """Random estimates, (sequences, steps, 16), float32: near and far, slow and fast, any attitude."""
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
    return np.concatenate([position, velocity, quaternion, body_rate, target], axis=-1).astype(np.float32)


@eqx.filter_jit
def _commands(controller, hover, inputs):
    def one(rows):
        def estimate(row):
            return Estimate(row[:3] - row[13:], row[3:6], row[6:10], row[10:13])

        def step(memory, row):
            return controller.command(memory, estimate(row))

        first = controller.start(estimate(rows[0]), jnp.full(4, hover))
        return jax.lax.scan(step, first, rows)[1]

    return jax.vmap(one)(inputs)
