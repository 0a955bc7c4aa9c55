"""The task of rotating about the body's x axis at a given rate (paper section V, its flips).

Set-points are [v_target, rate_target]: speed along the body's z axis, m/s, and rate about its x axis, rad/s. The
position is neither rewarded nor observed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.envs.observation import Layout, rotation_matrix
from cfb_mjx.envs.reward import length, too_fast, triangle
from cfb_mjx.envs.task import Task
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rotors import hover_rotor_speed
from cfb_mjx.model.state import AnyArray, State
from cfb_mjx.parameters import Parameters

SETPOINTS = ("speed_mps", "rate_radps")
"""Names of the set-points, in order."""
FLIP_LAYOUT = Layout(
    position=False,
    position_scale_m=1.0,
    position_bend_m=0.0,
    body_position=False,
    body_velocity=True,
    velocity_scale_mps=3.0,
    velocity_bend_mps=0.0,
    setpoint_scales=(3.0, 10.0),
)
"""Observation of a flip policy."""


@dataclass(frozen=True)
class FlipReward:
    """Weights, widths and limits of the paper, per control step:

        0.6 Lambda(|R^T v - [0, 0, v_target]|, 20 m/s) + 0.15 Lambda(|R e_x - axis|, 3)
        + Lambda(|omega - [rate_target, 0, 0]|, e_omega) - 300 fail

    Two values differ from the printed ones, which cannot be right (docs/deviations.md): the paper gives e_omega in N m,
    and its axis [0, 1, 0] would turn the drone out of the plane of the paper's figures.
    """

    velocity: float = 0.6
    velocity_width_mps: float = 20.0
    axis: float = 0.15
    axis_width: float = 3.0
    axis_direction: tuple[float, ...] = (1.0, 0.0, 0.0)
    """Wanted direction of the body's x axis, world."""
    body_rate: float = 1.0
    body_rate_width_radps: float = 20.0
    failure: float = 300.0
    """Subtracted in the step that ends an episode."""
    speed_limit_mps: float = 10.0
    rate_limit_radps: float = 30.0

    @property
    def largest(self) -> float:
        """Reward of a step at the set-points."""
        return self.velocity + self.axis + self.body_rate

    def failed(self, state: State) -> Bool[Array, ""]:
        """Whether speed or body rate exceed their limits."""
        return too_fast(state, self.speed_limit_mps, self.rate_limit_radps)

    def __call__(self, state: State, setpoint: Float[Array, "2"]) -> Float[Array, ""]:
        """Reward of ``state``."""
        velocity, axis, body_rate = deviations(state, setpoint, self.axis_direction)
        reward = (
            self.velocity * triangle(length(velocity), self.velocity_width_mps)
            + self.axis * triangle(length(axis), self.axis_width)
            + self.body_rate * triangle(length(body_rate), self.body_rate_width_radps)
        )
        return reward - self.failure * self.failed(state)


def deviations(
    state: State, setpoint: Float[Array, "2"], axis_direction: tuple[float, ...] = (1.0, 0.0, 0.0)
) -> tuple[Float[AnyArray, "3"], Float[AnyArray, "3"], Float[AnyArray, "3"]]:
    """Deviations of velocity (body axes, m/s), of the body's x axis (world), and of the body rate (rad/s)."""
    turn = rotation_matrix(state.quaternion)
    speed, rate = setpoint
    nothing = jnp.zeros_like(speed)
    velocity = state.velocity @ turn - jnp.stack([nothing, nothing, speed])
    axis = turn[:, 0] - jnp.asarray(axis_direction, turn.dtype)
    return velocity, axis, state.body_rate - jnp.stack([rate, nothing, nothing])


@dataclass(frozen=True)
class Setpoints:
    """Ranges of the set-points; each episode draws its own uniformly between the two numbers."""

    speed_mps: tuple[float, ...] = (-3.0, 5.0)
    rate_radps: tuple[float, ...] = (8.0, 22.0)


@dataclass(frozen=True)
class FlipStarts:
    """How flips begin: a share ``entering`` in the state after a climb, the rest in the middle of a turn.

    The fields are largest values; all draws are uniform.
    """

    entering: float = 0.5
    climb_mps: float = 6.0
    """Upward speed; when entering from zero upwards."""
    fall_mps: float = 2.0
    """Downward speed in a turn. A drone that falls faster reaches the speed limit before the episode is over."""
    level_mps: float = 1.0
    """Horizontal speed per axis; in a turn twice that across the axis."""
    tilt_rad: float = 0.3
    """Angle about each axis when entering; in a turn any roll angle, and this about the other two axes."""
    rate_radps: float = 1.5
    """Rate about each axis; in a turn in addition to the set-point."""
    rotor_speed: tuple[float, ...] = (0.2, 1.7)
    """Smallest and largest rotor speed, relative to hover."""


def draw_flip(
    starts: FlipStarts, model: Quadrotor, target: Float[Array, "3"], rate: Float[Array, ""], key: PRNGKeyArray
) -> State:
    """Draw an initial state of ``model`` that is about to turn, or turning, at ``rate`` [rad/s]."""
    unit = jax.random.uniform(key, (17,), jnp.result_type(float))
    entering = unit[0] < starts.entering
    both = 2 * unit - 1
    slowest = jnp.where(entering, 0.0, -starts.fall_mps)
    climb = slowest + (starts.climb_mps - slowest) * unit[1]
    across = jnp.where(entering, 1.0, 2.0)
    velocity = jnp.stack([starts.level_mps * both[2], starts.level_mps * across * both[3], climb])
    roll = jnp.where(entering, starts.tilt_rad, jnp.pi) * both[4]
    attitude = _from_roll_pitch_yaw(roll, starts.tilt_rad * both[5], starts.tilt_rad * both[6])
    turning = jnp.where(entering, 0.0, 1.2 * unit[7] * rate)
    body_rate = starts.rate_radps * both[8:11] + jnp.stack([turning, jnp.zeros_like(rate), jnp.zeros_like(rate)])
    low, high = starts.rotor_speed
    # The rotors of one drone turn at similar speeds.
    spread = low + (high - low) * (0.7 * unit[11] + 0.3 * unit[12:16])
    rotor_speed = hover_rotor_speed(model.changed_parameters()) * spread
    return State(target, velocity, attitude, body_rate, rotor_speed)


def _from_roll_pitch_yaw(roll: Array, pitch: Array, yaw: Array) -> Float[Array, "4"]:
    """Yaw about the world's z, then pitch, then roll about the body's axes."""
    (cr, sr), (cp, sp), (cy, sy) = ((jnp.cos(a / 2), jnp.sin(a / 2)) for a in (roll, pitch, yaw))
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


@dataclass(frozen=True)
class FlipTask(Task):
    """The paper's second task: rotate about x at the set-points."""

    layout: Layout = FLIP_LAYOUT
    reward: FlipReward = field(default_factory=FlipReward)
    starts: FlipStarts = field(default_factory=FlipStarts)
    setpoints: Setpoints = field(default_factory=Setpoints)
    episode_s: float = 0.9

    @property
    def largest_reward(self) -> float:
        """Reward of a step at the set-points."""
        return self.reward.largest

    def draw_setpoint(self, key: PRNGKeyArray) -> Float[Array, "2"]:
        """Draw speed and rate, uniformly within their ranges."""
        low, high = jnp.array([self.setpoints.speed_mps, self.setpoints.rate_radps]).T
        return jax.random.uniform(key, (2,), low.dtype, low, high)

    def draw_start(
        self, model: Quadrotor, target: Float[Array, "3"], setpoint: Float[Array, "2"], key: PRNGKeyArray
    ) -> State:
        """Draw an initial state from ``starts``."""
        return draw_flip(self.starts, model, target, setpoint[1], key)

    def judge(
        self,
        state: State,
        target: Float[Array, "3"],
        setpoint: Float[Array, "2"],
        command: Array,
        parameters: Parameters,
    ) -> Float[Array, ""]:
        """Reward of the paper."""
        return self.reward(state, setpoint)

    def failed(self, state: State) -> Bool[Array, ""]:
        """Whether speed or body rate exceed their limits."""
        return self.reward.failed(state)

    @property
    def diverged_reward(self) -> float:
        """Reward of the paper for a failure."""
        return -self.reward.failure

    def errors(self, state: State, target: Float[Array, "3"], setpoint: Float[Array, "2"]) -> Float[Array, "3"]:
        """Errors of velocity, axis and body rate."""
        velocity, axis, body_rate = deviations(state, setpoint, self.reward.axis_direction)
        return jnp.stack([length(velocity) / 3, length(axis), length(body_rate) / 10])
