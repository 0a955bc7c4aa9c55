"""The task of tracking a moving target: paths of two harmonics, figure eights among them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.envs.observation import Layout
from cfb_mjx.envs.path import Harmonics, derivative
from cfb_mjx.envs.starts import Starts, draw
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State
from cfb_mjx.model.vector import Vec, multiply
from cfb_mjx.parameters import Parameters

TRACK_LAYOUT = Layout(preview_s=(0.05, 0.1, 0.2, 0.4), velocity_bend_mps=0.0)
"""Observation of a tracking policy."""
TRACK_STARTS = Starts(0.3, 0.5, 0.3, speed_mps=1.0, tilt_deg=30.0, yaw_deg=20.0, rate_radps=3.0)
"""How episodes begin, beside the state that the path needs."""
_HARMONICS = 2


@dataclass(frozen=True)
class Paths:
    """Paths of the episodes. Every episode draws a lap time, a shape, and how much of the drone's thrust it needs."""

    eights: float = 0.4
    """Share of horizontal figure eights in any direction; the other paths have random amplitudes."""
    lap_s: tuple[float, ...] = (1.6, 6.0)
    """Shortest and longest lap, s."""
    size_m: float = 1.2
    """Largest amplitude, m."""
    upwards: float = 0.3
    """Amplitude along z as a share of the others."""
    thrust_to_weight: float = 2.4
    """Largest thrust that a path needs, in weights of the drone, without drag."""


@dataclass(frozen=True)
class TrackTask(TargetTask):
    """Track a path. The set-point is the time along the path, and the path's numbers."""

    layout: Layout = TRACK_LAYOUT
    starts: Starts = TRACK_STARTS
    paths: Paths = field(default_factory=Paths)

    def draw_setpoint(self, key: PRNGKeyArray) -> Float[Array, " setpoints"]:
        """Draw a path, and the time at which the episode begins on it."""
        of_shape, of_numbers = jax.random.split(key)
        which, lap, effort, way, begun, side = jax.random.uniform(of_numbers, (6,))
        low, high = self.paths.lap_s
        rate = 2 * jnp.pi / (low * (high / low) ** lap)
        drawn = jax.random.normal(of_shape, (2, _HARMONICS, 3)) * jnp.array([1.0, 1.0, self.paths.upwards])
        drawn = drawn / jnp.arange(1, _HARMONICS + 1)[:, None]
        angle = 2 * jnp.pi * way
        along = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0.0])
        across = jnp.stack([-jnp.sin(angle), jnp.cos(angle), 0.0]) * jnp.where(side < 0.5, 0.5, 1.0 * side)
        eight = jnp.stack([jnp.stack([along, across]), jnp.zeros((_HARMONICS, 3))])
        shape = jnp.where(which < self.paths.eights, eight, drawn)
        # Demanding paths are drawn more often: the easy ones are learnt from them.
        scale = self._scale(rate, shape, jnp.sqrt(effort))
        return jnp.concatenate([jnp.stack([begun * 2 * jnp.pi / rate, rate]), scale * shape.reshape(-1)])

    def _scale(self, rate: Array, shape: Array, effort: Array) -> Array:
        """Largest amplitude within ``size_m`` at which the path needs a share ``effort`` of the thrust it may need."""
        angles = jnp.linspace(0, 2 * jnp.pi, 24, endpoint=False)[:, None] * jnp.arange(1, _HARMONICS + 1)
        place = jnp.sin(angles) @ shape[0] + jnp.cos(angles) @ shape[1]
        order = (rate * jnp.arange(1, _HARMONICS + 1)) ** 2
        pull = -(jnp.sin(angles) * order) @ shape[0] - (jnp.cos(angles) * order) @ shape[1]
        largest = 1 + effort * (self.paths.thrust_to_weight - 1)
        # |s a / g + e_z| = largest, solved for s at every sample.
        a, up = jnp.sum(pull**2, axis=1) / 9.81**2, pull[:, 2] / 9.81
        within = (jnp.sqrt(up**2 + a * (largest**2 - 1)) - up) / jnp.maximum(a, 1e-9)
        return jnp.minimum(jnp.min(within), self.paths.size_m / jnp.max(jnp.linalg.norm(place, axis=1)))

    def next_setpoint(self, setpoint: Float[Array, " setpoints"], state: State) -> Float[Array, " setpoints"]:
        """Move on along the path by one command."""
        return setpoint.at[0].add(self.layout.control_dt_s)

    def target(self, setpoint: Float[Array, " setpoints"], origin: Float[Array, "3"]) -> Float[Array, "3"]:
        """Position on the path, m."""
        return origin + _path(setpoint)(setpoint[0])

    def target_velocity(self, setpoint: Float[Array, " setpoints"]) -> Float[Array, "3"]:
        """Velocity along the path, m/s."""
        return derivative(_path(setpoint))(setpoint[0])

    def shown(self, setpoint: Float[Array, " setpoints"]) -> Float[Array, " shown"]:
        """Displacements of the target from now until each of ``layout.preview_s`` later, m."""
        path, now = _path(setpoint), setpoint[0]
        return jnp.concatenate([path(now + ahead) - path(now) for ahead in self.layout.preview_s])

    def draw_start(
        self, model: Quadrotor, target: Float[Array, "3"], setpoint: Float[Array, " setpoints"], key: PRNGKeyArray
    ) -> State:
        """Draw an initial state about the path's position, velocity and attitude."""
        drawn, path = draw(self.starts, model, target, key), _path(setpoint)
        force = derivative(derivative(path))(setpoint[0]) + jnp.array([0.0, 0.0, 9.81])
        x, y, z = force / jnp.sqrt(jnp.sum(force**2))
        # The shortest turn that takes the body's z axis there.
        turn = Vec(1 + z, -y, x, 0.0) * (1 / jnp.sqrt(2 * jnp.maximum(1 + z, 1e-3)))
        quaternion = multiply(turn, Vec.unstack(drawn.quaternion)).stack()
        return replace(drawn, velocity=drawn.velocity + self.target_velocity(setpoint), quaternion=quaternion)

    def judge(
        self,
        state: State,
        target: Float[Array, "3"],
        setpoint: Float[Array, " setpoints"],
        command: Array,
        parameters: Parameters,
    ) -> Float[Array, ""]:
        """Reward of the state from ``reward``, with velocities relative to the target's."""
        return self.reward(self.relative(state, setpoint), target, command, parameters)

    def errors(
        self, state: State, target: Float[Array, "3"], setpoint: Float[Array, " setpoints"]
    ) -> Float[Array, "3"]:
        """Errors of position and velocity, and the body rate."""
        return super().errors(self.relative(state, setpoint), target, setpoint)


def _path(setpoint: Float[Array, " setpoints"]) -> Harmonics:
    sine, cosine = setpoint[2:].reshape(2, _HARMONICS, 3)
    return Harmonics(setpoint[1], sine, cosine, jnp.zeros_like(setpoint[1]))
