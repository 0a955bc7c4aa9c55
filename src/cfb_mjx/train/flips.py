"""Fly flips and measure them: how often round, how high, how fast the turn and the fall are stopped, how far off."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control.manoeuvre import CATCH, Manoeuvre, roll_angle, unwrapped
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.envs.episode import QUIET, observe, reset, step, with_room
from cfb_mjx.envs.flip import FlipTask, deviations
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rollout import rollout
from cfb_mjx.model.rotors import thrust
from cfb_mjx.train.flying import CAUGHT_M, Flight, fly

FLIPS = {"flip": 1, "double-flip": 2, "triple-flip": 3}
"""Manoeuvres and their turns."""
FLIP_S, COUNTED_S = 6.0, 1.0
"""How long a flip is watched, and the end of it over which the way back is measured."""
STOPPED_RADPS = np.radians(100.0)
"""Slower is not turning any more (paper section VI)."""
FLOOR_M = 2.0
"""Flips begin this far above the floor."""


class Flips(NamedTuple):
    """Of flips, per drone."""

    rotations: Float[Array, "*drones"]
    """About the x axis, whole flight."""
    vertical_extent_m: Float[Array, "*drones"]
    """Highest minus lowest point."""
    lowest_m: Float[Array, "*drones"]
    """Relative to the start."""
    peak_rate_radps: Float[Array, "*drones"]
    """Largest body rate about x."""
    rate_stop_s: Float[Array, "*drones"]
    """From the switch to the target policy until the body rate is below `STOPPED_RADPS`; infinite if never."""
    vertical_stop_s: Float[Array, "*drones"]
    """From that switch until the drone does not fall any more; infinite if never."""
    fall_mps: Float[Array, "*drones"]
    """Largest downward speed."""
    return_error_m: Float[Array, "*drones"]
    """Mean distance from the start over the last `COUNTED_S`."""
    failed: Bool[Array, "*drones"]
    """Limits of speed or rate passed."""

    def completed(self, rotations: int, floor_m: float = FLOOR_M) -> Bool[Array, "*drones"]:
        """Turned so many times, caught within `CAUGHT_M`, not failed, never as low as a floor ``floor_m`` below."""
        right = jnp.abs(self.rotations - rotations) < 0.25
        return right & ~self.failed & (self.return_error_m < CAUGHT_M) & (self.lowest_m > -floor_m)


def flips(
    manoeuvre: Manoeuvre, task: TargetTask, nominal: Quadrotor, keys: PRNGKeyArray, seconds: float = FLIP_S
) -> tuple[Flips, Flight]:
    """Hover at the start, flip, return; one flight per key, measured, and the flights.

    Args:
        manoeuvre: what is flown.
        task: says which drones and how much noise.
        nominal: the drone.
        keys: one per flight.
        seconds: watched; no shorter than the manoeuvre and `COUNTED_S`.
    """
    return _flips(manoeuvre, with_room(task, nominal), nominal, keys, seconds)


@eqx.filter_jit
def _flips(manoeuvre, task, nominal, keys, seconds):
    start = nominal.hover_state((0.0, 0.0, 0.0))
    flown = jax.vmap(lambda key: fly(manoeuvre, task, nominal, key, seconds, start, lambda m: m.phase))(keys)
    return measure(flown, manoeuvre.control_dt_s), flown


def measure(flown: Flight, dt: float) -> Flips:
    """Of flights of manoeuvres with their phases watched, axes (drones, steps), a command every ``dt`` [s]."""
    # A command that belongs to the catch has been flown for dt when its row is written.
    since = dt * jnp.cumsum(flown.watched == CATCH, axis=-1)

    def first(condition: Array) -> Array:
        return jnp.min(jnp.where(condition & (since > 0), since, jnp.inf), axis=-1)

    height, rising = flown.position[..., 2], flown.velocity[..., 2]
    distance = jnp.linalg.norm(flown.position[..., -round(COUNTED_S / dt) :, :], axis=-1)
    return Flips(
        rotations=unwrapped(roll_angle(flown.quaternion))[..., -1] / (2 * jnp.pi),
        vertical_extent_m=jnp.max(height, axis=-1) - jnp.min(height, axis=-1),
        lowest_m=jnp.min(height, axis=-1),
        peak_rate_radps=jnp.max(flown.body_rate[..., 0], axis=-1),
        rate_stop_s=first(jnp.linalg.norm(flown.body_rate, axis=-1) < STOPPED_RADPS),
        vertical_stop_s=first(rising >= 0),
        fall_mps=jnp.max(-rising, axis=-1),
        return_error_m=distance.mean(axis=-1),
        failed=flown.failed[..., -1],
    )


class Turning(NamedTuple):
    """Of a flip policy alone, per drone; means from `SPUN_UP_S` on."""

    rate_error_radps: Float[Array, "*drones"]
    axis_error: Float[Array, "*drones"]
    """Distance of the body's x axis from where it was asked to be."""
    command_change: Float[Array, "*drones"]
    """Root mean square from one command to the next."""
    failed: Bool[Array, "*drones"]


TURNING_S, SPUN_UP_S, RISING_MPS = 1.0, 0.3, 3.5
"""How long a policy turns on its own, from when on that counts, and how fast it rises at first."""


def turning(controller: NeuralController, task: FlipTask, nominal: Quadrotor, keys: PRNGKeyArray) -> Turning:
    """Turn `TURNING_S` at the middle of the task's set-points, from rising level at `RISING_MPS`; a flight per key."""
    return _turning(controller, with_room(task, nominal), nominal, keys)


@eqx.filter_jit
def _turning(controller, task, nominal, keys):
    ranges = jnp.array([task.setpoints.speed_mps, task.setpoints.rate_radps])
    hovering = nominal.hover_state((0.0, 0.0, 0.0))
    start = eqx.tree_at(lambda s: s.velocity, hovering, jnp.array([0.0, 0.0, RISING_MPS]))

    def one(key):
        episode = reset(task, nominal, key, start, setpoint=ranges.mean(axis=1))

        def forward(carry, _):
            episode, failed = carry
            command = controller.act(observe(task, episode))
            after, outcome = step(task, episode, command)
            _, axis, rate = deviations(after.state, after.setpoint, task.reward.axis_direction)
            failed = failed | outcome.failed
            return (after, failed), (jnp.linalg.norm(rate), jnp.linalg.norm(axis), command)

        steps = round(TURNING_S / task.layout.control_dt_s)
        (_, failed), (rate, axis, command) = jax.lax.scan(forward, (episode, jnp.asarray(False)), length=steps)
        counted = round(SPUN_UP_S / task.layout.control_dt_s)
        change = jnp.sqrt(jnp.mean(jnp.diff(command[counted:], axis=0) ** 2))
        return Turning(rate[counted:].mean(), axis[counted:].mean(), change, failed)

    return jax.vmap(one)(keys)


class Replay(NamedTuple):
    """A flip without noise on the nominal drone, and its commands flown again without a controller."""

    apart_m: Float[Array, ""]
    """Largest distance between the two flights."""
    largest_thrust_n: Float[Array, ""]
    """Largest force that the flight shows beside gravity: mass times change of velocity over a control step."""
    model_thrust_n: Float[Array, ""]
    """What the motor model gives at full command."""


def replay(manoeuvre: Manoeuvre, nominal: Quadrotor) -> Replay:
    """Fly, and fly the commands again open loop: nothing but the commands moves the drone."""
    return _replay(manoeuvre, with_room(TargetTask(noise=QUIET), nominal), nominal)


@eqx.filter_jit
def _replay(manoeuvre, task, nominal):
    start, dt = nominal.hover_state((0.0, 0.0, 0.0)), manoeuvre.control_dt_s
    flown = fly(manoeuvre, task, nominal, jax.random.PRNGKey(0), FLIP_S, start)
    again = rollout(nominal, start, flown.command, hold=round(dt / nominal.dt))
    apart = jnp.max(jnp.linalg.norm(again.position - flown.position, axis=-1))
    parameters = nominal.changed_parameters()
    force = jnp.diff(flown.velocity, axis=0) / dt + parameters.gravity * jnp.array([0.0, 0.0, 1.0])
    full = thrust(parameters, parameters.motor_gain * jnp.ones(4) + parameters.motor_speed_offset)
    return Replay(apart, parameters.mass * jnp.max(jnp.linalg.norm(force, axis=-1)), jnp.sum(full))
