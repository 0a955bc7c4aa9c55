"""Land controllers on a pad: a target that comes down, motors that stop on touch-down, and how soft that was.

The floor is MuJoCo's, in C (`MujocoBody`). Near it the rotors give more thrust: a model without an effect for that gets
`CUSHION`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control.controllers import Controller
from cfb_mjx.envs.observation import StateEstimate
from cfb_mjx.envs.path import Path, derivative
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import with_room
from cfb_mjx.files import shipped
from cfb_mjx.model.effects import GroundEffect
from cfb_mjx.model.mjcf import BODY_NAME, World, compiled_scene, meet
from cfb_mjx.model.mujoco_body import MujocoBody
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import AnyArray
from cfb_mjx.train.flight import Flight, fly

DESCENT_MPS, CRAWL_MPS, CRAWL_M = 0.3, 0.1, 0.2
"""Speed of the descent, and the speed from `CRAWL_M` above the pad on. There the rotors' thrust grows with every
centimetre, which controllers without integral action answer by floating; and a landing at a third of `CONTACT_MPS`
leaves room for errors of the speed."""
BELOW_M = 0.15
"""How far beneath the pad the target goes, so that a drone that flies above its target reaches the pad too, m."""
APPROACH_S, RAMP_S, LANDING_S = 2.0, 0.4, 11.0
"""Duration of the way to above the pad, of a change of the descent's speed, and of the whole flight, which leaves the
drone two seconds or more on the pad."""
NEAR_M, SINKING_MPS, HELD_S = 0.01, 0.05, 0.1
"""The motors stop once the estimate has been so near to the pad, and sinking by so little, for so long."""
CONTACT_MPS, ON_PAD_M = 0.3, 0.1
"""A successful landing touches the pad more slowly than this, and rests so near to its middle. The speed is the one at
which PX4 lets multirotors touch the ground (default of its parameter MPC_LAND_CRWL)."""
STILL_S, STILL_MPS, UPRIGHT_DEG, ON_FEET_M = 0.5, 0.02, 3.0, 0.003
"""At rest: so long, slower than this, tilted by less than this, and with its centre at the height of a drone on its
feet within this."""
CUSHION = {"strength": 0.0342, "height": 0.0312}
"""Strength and height [m] of the drone's `GroundEffect`: least squares to the formula of Sanchez-Cuevas et al. 2017
(cited there) for four rotors and a body (K_b = 2), with blades of 27.5 mm on axes 70.7 mm apart, over heights of the
rotors from 14 mm, where the drone rests, to 0.5 m."""


class Descent(eqx.Module):
    """Path of a target from beside the pad to above it, and down to `BELOW_M` beneath it."""

    start: Float[AnyArray, "3"]
    pad: Float[AnyArray, "3"]
    """Where the drone's centre rests, m."""

    @property
    def times_s(self) -> tuple[Array, Array, Array]:
        """When the descent, the crawl and the end begin."""
        crawl = APPROACH_S + (self.start[2] - self.pad[2] - CRAWL_M) / DESCENT_MPS
        return jnp.asarray(APPROACH_S), crawl, crawl + (CRAWL_M + BELOW_M) / CRAWL_MPS

    @property
    def end_s(self) -> Array:
        """When the target has come to its end, s."""
        return self.times_s[2] + RAMP_S

    def __call__(self, time_s: Float[AnyArray, ""]) -> Float[Array, "3"]:
        """Return the position, m."""
        share = jnp.clip(time_s / APPROACH_S, 0.0, 1.0)
        level = self.start + (self.pad - self.start) * share**3 * (10 - 15 * share + 6 * share**2)
        down = 0.0
        for begins, change in zip(self.times_s, (DESCENT_MPS, CRAWL_MPS - DESCENT_MPS, -CRAWL_MPS), strict=True):
            since = time_s - begins
            ramp = jnp.clip(since / RAMP_S, 0.0, 1.0)
            # The integral of a smooth step of the speed.
            down += change * (RAMP_S * (ramp**3 - ramp**4 / 2) + jnp.maximum(since - RAMP_S, 0.0))
        return jnp.append(level[:2], self.start[2] - down)


class Lander(eqx.Module):
    """A controller that tells when it has landed, from its estimates alone: see `stopped`.

    Attributes:
        controller: what flies; it goes on until somebody stops the motors.
        path: path of the target, to which the estimates are relative.
        pad: path of where the drone's centre will rest.
        end_s: time at which the motors stop wherever the drone is, s.
    """

    controller: Controller
    path: Path
    pad: Path
    end_s: Float[Array, ""]

    @property
    def control_dt_s(self) -> float:
        """Time between two commands, s."""
        return self.controller.control_dt_s

    @property
    def layout(self) -> Any:
        """What the controller sees; None for one without a network."""
        return getattr(self.controller, "layout", None)

    def start(self, estimate: StateEstimate, command: Float[Array, "4"]) -> Any:
        """Return the memory at take-over: the controller's, time, time near the pad, and whether the motors stop."""
        nothing = jnp.zeros((), estimate.position.dtype)
        return self.controller.start(estimate, command), nothing, nothing, jnp.asarray(False)

    def command(self, memory: Any, estimate: StateEstimate, *ahead: Array) -> tuple[Any, Float[Array, "4"]]:
        """Return the new memory and the controller's command."""
        own, time, held, stopped = memory
        above = estimate.position[2] + self.path(time)[2] - self.pad(time)[2]
        rising = estimate.velocity[2] - derivative(self.pad)(time)[2]
        held = jnp.where((above < NEAR_M) & (rising > -SINKING_MPS), held + self.control_dt_s, 0.0)
        stopped = stopped | (held > HELD_S) | (time > self.end_s)
        own, command = self.controller.command(own, estimate, *ahead)
        return (own, time + self.control_dt_s, held, stopped), command

    @staticmethod
    def stopped(memory: Any) -> Bool[Array, ""]:
        """Whether the motors stop."""
        return memory[3]


class Landing(NamedTuple):
    """Measurements of a landing, per drone; those of the first contact are NaN if there was none."""

    landed: Bool[Array, "*drones"]
    """Touched down slowly (`CONTACT_MPS`), and rests on its feet, with its motors stopped, on the pad (`ON_PAD_M`)."""
    vertical_speed_mps: Float[Array, "*drones"]
    """Speed at which the drone sinks at the first contact."""
    horizontal_speed_mps: Float[Array, "*drones"]
    """Of the first contact too."""
    tilt_deg: Float[Array, "*drones"]
    """Of the first contact too."""
    distance_m: Float[Array, "*drones"]
    """Horizontal distance of the last position from the middle of the pad."""
    failed: Bool[Array, "*drones"]


def clearance(position: Float[AnyArray, "*batch 3"], quaternion: Float[AnyArray, "*batch 4"]) -> Float[Array, "*batch"]:
    """Height of the drone's lowest point above a floor at z = 0: feet and guards of ``assets/cfb.xml``.

    Args:
        position: of the rotors' centre, m.
        quaternion: attitude, body to world.
    """
    model = compiled_scene(World(str(shipped("assets", "cfb.xml"))))
    own = (model.geom_bodyid == model.body(BODY_NAME).id) & meet(model, slice(None), [model.geom("floor").id])[:, 0]
    # Spheres and flat ellipsoids, in the body's axes.
    axes = np.where(model.geom_size[own, 1:2] > 0, model.geom_size[own], model.geom_size[own, :1])
    w, x, y, z = jnp.moveaxis(jnp.asarray(quaternion), -1, 0)
    up = jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    reach = jnp.linalg.norm(up[..., None, :] * axes, axis=-1)
    return jnp.asarray(position)[..., 2] + jnp.min(up @ model.geom_pos[own].T - reach, axis=-1)


def touch_down(flown: Flight, dt: float) -> Landing:
    """Measure landings.

    Args:
        flown: flights, axes (drones, steps), with positions from the middle of the pad's surface and velocities
            relative to the pad.
        dt: time between two commands, s.
    """
    above = clearance(flown.position, flown.quaternion)
    touching = above <= 0
    touched = touching.any(axis=1)
    # The last state before the contact, whose forces have changed the one after it.
    before = jnp.maximum(jnp.argmax(touching, axis=1) - 1, 0)[:, None]

    def at_contact(x: Array) -> Array:
        return jnp.where(touched, jnp.take_along_axis(x, before, axis=1)[:, 0], jnp.nan)

    _, x, y, _ = jnp.moveaxis(flown.quaternion, -1, 0)
    tilt = jnp.degrees(jnp.arccos(jnp.clip(1 - 2 * (x * x + y * y), -1.0, 1.0)))
    sinking = at_contact(-flown.velocity[..., 2])
    sideways = at_contact(jnp.linalg.norm(flown.velocity[..., :2], axis=-1))
    distance = jnp.linalg.norm(flown.position[:, -1, :2], axis=-1)
    last = slice(-round(STILL_S / dt), None)
    still = jnp.linalg.norm(flown.velocity[:, last], axis=-1).mean(axis=1) < STILL_MPS
    upright = (tilt[:, -1] < UPRIGHT_DEG) & (jnp.abs(above[:, -1]) < ON_FEET_M)
    off = jnp.all(flown.command[:, last] == 0, axis=(1, 2))
    soft = jnp.hypot(sinking, sideways) < CONTACT_MPS
    failed = flown.failed[:, -1]
    landed = touched & soft & still & upright & off & (distance < ON_PAD_M) & ~failed
    return Landing(landed, sinking, sideways, at_contact(tilt), distance, failed)


def with_floor(drone: Quadrotor) -> Quadrotor:
    """The drone with a floor to touch, and with thrust that grows near it (`CUSHION`, if it has no such effect)."""
    cushioned = any(isinstance(effect, GroundEffect) for effect in drone.effects)
    effects = drone.effects if cushioned else (*drone.effects, GroundEffect(**CUSHION))
    return replace(drone, body=MujocoBody(), effects=effects)


def land(controller: Controller, task: TargetTask, nominal: Quadrotor, keys: PRNGKeyArray) -> tuple[Landing, Flight]:
    """Land on a pad at the origin, from hover about 1 m above it and up to 1 m beside it.

    The target moves to above the pad, and down (`Descent`); the motors stop as `Lander` says.

    Args:
        controller: the controller; those that do not see ahead are given a target that moves.
        task: determines the drones and the noise.
        nominal: the nominal drone; it is flown `with_floor`.
        keys: one key per flight.

    Returns:
        The measurements and the flights, with positions in the world and ``watched`` the target.
    """
    return _land(controller, with_room(task, nominal), with_floor(nominal), keys)


def drawn(key: PRNGKeyArray) -> Descent:
    """Draw the path of a landing on a pad at the origin: it begins 0.9 to 1.1 m above it and up to 1 m beside it."""
    way, away, height = jax.random.uniform(key, (3,))
    angle, radius = 2 * jnp.pi * way, jnp.sqrt(away)
    start = jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), 0.9 + 0.2 * height])
    level = jnp.array([1.0, 0.0, 0.0, 0.0])
    return Descent(start, jnp.zeros(3).at[2].set(-clearance(jnp.zeros(3), level)))


@eqx.filter_jit
def _land(controller, task, nominal, keys):
    def one(key):
        of_flight, of_start = jax.random.split(key)
        path = drawn(of_start)
        lander = Lander(controller, path, lambda time: jnp.asarray(path.pad), path.end_s)
        start = nominal.hover_state(path.start)
        return fly(lander, task, nominal, of_flight, LANDING_S, start, path=path, stop=Lander.stopped)

    flown = jax.vmap(one)(keys)
    return touch_down(flown, controller.control_dt_s), flown
