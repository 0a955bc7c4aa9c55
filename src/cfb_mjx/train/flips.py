"""Fly flips and measure them: rotations, height, times to stop the rotation and the fall, and the error of return."""

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
"""Number of rotations of each manoeuvre."""
FLIP_S, COUNTED_S = 6.0, 1.0
"""Duration of a flip's flight, and of its end over which the return is measured, s."""
STOPPED_RADPS = np.radians(100.0)
"""Rate below which a drone has stopped turning (paper section VI)."""
FLOOR_M = 2.0
"""Height of the start of a flip above the floor, m."""


class Flips(NamedTuple):
    """Measurements of flips, per drone."""

    rotations: Float[Array, "*drones"]
    """Rotations about the x axis in the whole flight."""
    vertical_extent_m: Float[Array, "*drones"]
    """Height of the highest point above the lowest."""
    lowest_m: Float[Array, "*drones"]
    """Lowest point relative to the start."""
    peak_rate_radps: Float[Array, "*drones"]
    """Largest body rate about x."""
    rate_stop_s: Float[Array, "*drones"]
    """Time from the switch to the target policy until the body rate is below `STOPPED_RADPS`; infinite if never."""
    vertical_stop_s: Float[Array, "*drones"]
    """Time from that switch until the drone no longer falls; infinite if never."""
    fall_mps: Float[Array, "*drones"]
    """Largest downward speed."""
    return_error_m: Float[Array, "*drones"]
    """Mean distance from the start over the last `COUNTED_S`."""
    failed: Bool[Array, "*drones"]
    """Whether a limit of speed or rate was exceeded."""

    def completed(self, rotations: int, floor_m: float = FLOOR_M) -> Bool[Array, "*drones"]:
        """Whether a flip has the right rotations, is caught within `CAUGHT_M`, did not fail and stayed above the floor.

        Args:
            rotations: required number of rotations.
            floor_m: distance of the floor below the start, m.
        """
        right = jnp.abs(self.rotations - rotations) < 0.25
        return right & ~self.failed & (self.return_error_m < CAUGHT_M) & (self.lowest_m > -floor_m)


def flips(
    manoeuvre: Manoeuvre, task: TargetTask, nominal: Quadrotor, keys: PRNGKeyArray, seconds: float = FLIP_S
) -> tuple[Flips, Flight]:
    """Hover at the start, flip and return; one flight per key.

    Args:
        manoeuvre: manoeuvre to fly.
        task: determines the drones and the noise.
        nominal: the nominal drone.
        keys: one key per flight.
        seconds: duration of a flight; at least that of the manoeuvre plus `COUNTED_S`.

    Returns:
        The measurements and the flights.
    """
    return _flips(manoeuvre, with_room(task, nominal), nominal, keys, seconds)


@eqx.filter_jit
def _flips(manoeuvre, task, nominal, keys, seconds):
    start = nominal.hover_state((0.0, 0.0, 0.0))
    flown = jax.vmap(lambda key: fly(manoeuvre, task, nominal, key, seconds, start, lambda m: m.phase))(keys)
    return measure(flown, manoeuvre.control_dt_s), flown


def measure(flown: Flight, dt: float) -> Flips:
    """Measure flights of manoeuvres, axes (drones, steps), with their phases watched and a command every ``dt`` [s]."""
    # A command of the catch phase has been flown for dt when its row is written.
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
    """Measurements of a flip policy alone, per drone; means from `SPUN_UP_S` on."""

    rate_error_radps: Float[Array, "*drones"]
    axis_error: Float[Array, "*drones"]
    """Distance of the body's x axis from its wanted direction."""
    command_change: Float[Array, "*drones"]
    """Root mean square change from one command to the next."""
    failed: Bool[Array, "*drones"]


TURNING_S, SPUN_UP_S, RISING_MPS = 1.0, 0.3, 3.5
"""Duration of a policy's turn, start of the counted part, and initial upward speed."""


def turning(controller: NeuralController, task: FlipTask, nominal: Quadrotor, keys: PRNGKeyArray) -> Turning:
    """Turn for `TURNING_S` at the middle of the task's set-points, from level flight at `RISING_MPS` upwards.

    Args:
        controller: flip policy.
        task: determines the set-points, the drones and the noise.
        nominal: the nominal drone.
        keys: one key per flight.
    """
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
    """A flip without noise on the nominal drone, and its commands flown again in open loop."""

    apart_m: Float[Array, ""]
    """Largest distance between the two flights."""
    largest_thrust_n: Float[Array, ""]
    """Largest force other than gravity in the flight: mass times the velocity change over a control step, per time."""
    model_thrust_n: Float[Array, ""]
    """Thrust of the motor model at full command."""


def replay(manoeuvre: Manoeuvre, nominal: Quadrotor) -> Replay:
    """Fly a manoeuvre without noise, and fly its commands again in open loop."""
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
