"""Derivatives of a 50-step rollout in every number it depends on, against central differences of fourth order."""

from __future__ import annotations

import os
import subprocess
import sys

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from cfb_mjx.model import MjxBody, ParasiticDrag, Quadrotor, RigidBody, State, rollout_final
from cfb_mjx.parameters import SPECIFICATIONS

STEPS = 50
WEIGHTS = np.concatenate(
    [[1.0, -0.7, 0.9], [0.5, 0.4, -0.6], [0.8, -0.5, 0.3, 0.6], [0.1, -0.2, 0.3], np.full(4, 1e-3)]
)
# Measuring-side constants: a rollout does not depend on them.
NOT_IN_THE_ROLLOUT = ("pose_delay", "gyro_delay", "attitude_offset")


class _Problem:
    """A scalar function of one flat vector that holds model, state and commands, with its derivatives compiled."""

    def __init__(self, parameters, body, integrator, rotor_loads):
        random = np.random.default_rng(2)
        nudge = {
            "center_of_gravity": [0.010, -0.006, 0.004],
            "motor_speed_offset": [20.0, -30.0, 25.0, 40.0],
            "thrust_scale": [1.1, 0.9, 1.05, 0.95],
            "torque_scale": [0.9, 1.1, 1.0, 1.2],
            "attitude_offset": [0.02, -0.03, 0.01],
        }
        for name, value in nudge.items():
            parameters = eqx.tree_at(lambda p, n=name: getattr(p, n), parameters, jnp.asarray(value))
        # Fast enough that no component of the velocity passes zero, where |v| v has its kink.
        drag = ParasiticDrag(linear=[0.02, 0.03, 0.025], quadratic=[0.01, 0.005, 0.008], cross=0.4)
        model = Quadrotor(parameters, (drag,), body=body, integrator=integrator, rotor_loads=rotor_loads)
        q = np.array([0.95, 0.1, -0.2, 0.15])
        y = np.concatenate(
            [[0.3, -0.2, 1], [3, -3, 3], q / np.linalg.norm(q), [1, -0.8, 0.6], [1500, 1600, 1700, 1550]]
        )
        commands = jnp.asarray(random.uniform(0.4, 0.7, (STEPS, 4)))
        arrays, static = eqx.partition((model, helpers.state_of(y), commands), eqx.is_array)
        self.point, unravel = ravel_pytree(arrays)
        self.arrays, self.unravel = arrays, unravel
        # Differences are taken in units of each leaf's size, as leaves span eleven orders of magnitude.
        self.scale = ravel_pytree(jax.tree.map(lambda x: jnp.full(x.shape, jnp.max(jnp.abs(x))), arrays))[0]

        def value(flat):
            model, state, commands = eqx.combine(unravel(flat), static)
            final = rollout_final(model, state, commands)
            return sum(
                jnp.dot(jnp.asarray(WEIGHTS[helpers.SLICES[name]]), getattr(final, name)) for name in helpers.NAMES
            )

        options = helpers.QUICK_COMPILE
        self.pushforward = jax.jit(jax.vmap(lambda x, t: jax.jvp(value, (x,), (t,))), compiler_options=options)
        self.gradient = jax.jit(jax.grad(value), compiler_options=options)
        self.basis = jnp.diag(self.scale) if isinstance(body, RigidBody) else self._one_direction_per_leaf()

    def _one_direction_per_leaf(self) -> jax.Array:
        """A random direction within each array: MJX under a batch of every single number takes too long."""
        leaves, structure = jax.tree.flatten(self.unravel(self.scale))
        random = np.random.default_rng(6)
        rows = []
        for i, leaf in enumerate(leaves):
            weights = jnp.asarray(random.uniform(0.5, 1.0, leaf.shape) * random.choice([-1, 1], leaf.shape))
            zeroed = [leaf * weights if i == j else jnp.zeros_like(other) for j, other in enumerate(leaves)]
            rows.append(ravel_pytree(jax.tree.unflatten(structure, zeroed))[0])
        return jnp.stack(rows)

    def forward_and_differences(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives along each row of `basis`, in forward mode and by central differences.

        One batched call gives both: its values at the shifted points, its tangents at the centre.
        """
        basis, h = self.basis, 1e-3
        count = len(basis)
        shifts = jnp.concatenate([basis * k * h for k in (1, -1, 2, -2)] + [jnp.zeros_like(basis)])
        values, tangents = self.pushforward(self.point + shifts, jnp.concatenate([basis] * 5))
        up, down, up2, down2, _ = np.asarray(values).reshape(5, count)
        return np.asarray(tangents)[-count:], (8 * (up - down) - (up2 - down2)) / (12 * h)

    def at_rest(self) -> jax.Array:
        """The flat vector of a drone that stands still, rotors off, no command, centred."""
        model, _, commands = self.arrays
        model = eqx.tree_at(lambda m: m.parameters.center_of_gravity, model, jnp.zeros(3))
        model = eqx.tree_at(lambda m: m.parameters.motor_speed_offset, model, jnp.zeros(4))
        return ravel_pytree((model, State.at_rest(), jnp.zeros_like(commands)))[0]


@pytest.mark.parametrize(
    ("body", "integrator", "rotor_loads"),
    [
        (RigidBody(), "leapfrog", "mean"),
        (RigidBody(), "rk4", "instant"),
        # With XLA's multi-output fusion, which the suite runs with, jaxlib aborts while it compiles these.
        pytest.param(MjxBody(floor=False), "leapfrog", "mean", marks=pytest.mark.long),
        pytest.param(MjxBody(floor=False), "rk4", "instant", marks=pytest.mark.long),
    ],
    ids=lambda value: repr(value) if not isinstance(value, str) else value,
)
def test_gradients(body, integrator, rotor_loads, guards):
    problem = _Problem(guards, body, integrator, rotor_loads)
    forward, differences = problem.forward_and_differences()
    gradient = problem.gradient(problem.point)
    reverse = np.asarray(problem.basis @ gradient)
    tolerance = {"rtol": 1e-6, "atol": 1e-10 * np.abs(differences).max()}
    np.testing.assert_allclose(forward, differences, **tolerance)
    np.testing.assert_allclose(reverse, differences, **tolerance)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12 * np.abs(differences).max())

    # Every leaf matters, so none was compared zero with zero, save those of the measuring side.
    model, state, commands = problem.unravel(gradient * problem.scale)
    for name in SPECIFICATIONS:
        leaf = np.asarray(getattr(model.parameters, name))
        assert np.all(leaf == 0) if name in NOT_IN_THE_ROLLOUT else np.all(np.abs(leaf) > 1e-9), name
    for leaf in jax.tree.leaves((model.effects, state, commands)):
        assert np.all(np.abs(leaf) > 1e-12)

    at_rest = problem.at_rest()
    assert np.all(np.isfinite(problem.gradient(at_rest)))
    tangents_in = jnp.concatenate([problem.basis] * 5)
    _, tangents = problem.pushforward(jnp.broadcast_to(at_rest, tangents_in.shape), tangents_in)
    assert np.all(np.isfinite(tangents))


def test_gradients_of_the_mjx_body_in_a_process_of_its_own():
    chosen = ["-m", "long", "-k", "MjxBody and leapfrog", "-p", "no:cacheprovider", __file__]
    plain = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"} | {"PLAIN_XLA": "1"}
    command = [sys.executable, "-m", "pytest", *chosen]
    done = subprocess.run(command, env=plain, capture_output=True, text=True, check=False)
    assert "1 passed" in done.stdout, done.stdout + done.stderr
