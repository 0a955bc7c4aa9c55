"""What a task is: everything about an episode except the drone, and the noise of states and estimates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.envs.observation import Layout
from cfb_mjx.errors import CfbError
from cfb_mjx.firmware.actions import ACTIONS, Action
from cfb_mjx.firmware.pid import DT
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State
from cfb_mjx.parameters import Parameters, Randomisation


@dataclass(frozen=True)
class Noise:
    """Standard deviations of noise: on the state in every simulation step (paper), on the estimate in every reading."""

    state_velocity_mps: float = 0.001
    state_rate_radps: float = 0.001
    position_m: float = 0.001
    velocity_mps: float = 0.005
    attitude_rad: float = 0.001
    rate_radps: float = 0.01
    pose_jitter_s: float = 0.0
    """Largest additional delay of a reading, s, on top of the model's ``pose_delay``. Each reading draws it uniformly:
    jitter of a radio or of the network of a motion-capture system."""


QUIET = Noise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""No noise at all."""


@dataclass(frozen=True)
class Task:
    """Everything about a task except the drone. Hashable, so that functions may close over it under ``jit``.

    A subclass defines the set-points, how episodes begin, the reward of a state, and which states end an episode.
    """

    layout: Layout = field(default_factory=Layout)
    noise: Noise = field(default_factory=Noise)
    randomisation: Randomisation | None = None
    """Ranges that vary from episode to episode; None: nothing varies."""
    magnitude: float = 1.0
    """Factor on all ranges of ``randomisation``."""
    graded: float = 0.0
    """Share of the episodes that draw their own factor between 0 and ``magnitude``."""
    episode_s: float = 6.0
    lumped_delay: bool = True
    """Whether pose, velocity and gyro have one common delay, the model's ``pose_delay``, as in the paper. Otherwise the
    gyro is on the drone, as a real one, and has only the delay ``gyro_delay``."""
    longest_delay_s: float | None = None
    """Longest delay of any drone of the task, s, for which estimates are stored. None: computed from the model and the
    randomisation. Set it (`with_room`) if the model is traced."""

    @property
    def episode_steps(self) -> int:
        """Number of commands in a full episode."""
        return round(self.episode_s / self.layout.control_dt_s)

    def stepped(self, model: Quadrotor) -> Quadrotor:
        """The model with the steps of the task: beneath a policy a loop of the firmware runs every 2 ms."""
        return replace(model, dt=DT) if self.action.has_loop else model

    def hold(self, model: Quadrotor) -> int:
        """Number of simulation steps per command; raises as `Quadrotor.steps_per_command`."""
        return self.stepped(model).steps_per_command(self.layout.control_dt_s)

    @property
    def largest_reward(self) -> float:
        """Reward of the best possible step."""
        raise NotImplementedError

    @property
    def action(self) -> Action:
        """What the policy's outputs mean."""
        return ACTIONS[self.layout.action]

    def draw_setpoint(self, key: PRNGKeyArray) -> Float[Array, " setpoints"]:
        """Draw the set-point of an episode, or whatever else determines what is to be done in it."""
        return jnp.zeros(0)

    def next_setpoint(self, setpoint: Float[Array, " setpoints"], state: State) -> Float[Array, " setpoints"]:
        """Set-point of the next command, after a command has led to ``state``; by default it stays."""
        return setpoint

    def target(self, setpoint: Float[Array, " setpoints"], origin: Float[Array, "3"]) -> Float[Array, "3"]:
        """Target, world, m; by default the ``origin`` of the episode."""
        return origin

    def target_velocity(self, setpoint: Float[Array, " setpoints"]) -> Float[Array, "3"]:
        """Velocity of the target, world, m/s; by default zero."""
        return jnp.zeros(3, setpoint.dtype)

    def relative(self, state: State, setpoint: Float[Array, " setpoints"]) -> State:
        """The state with a velocity relative to the target's, for rewards and costs of a target that moves."""
        return replace(state, velocity=state.velocity - self.target_velocity(setpoint))

    def shown(self, setpoint: Float[Array, " setpoints"]) -> Float[Array, " shown"]:
        """What the policy sees of the set-point: ``layout.shown`` numbers; by default the set-point."""
        return setpoint

    def draw_start(
        self, model: Quadrotor, target: Float[Array, "3"], setpoint: Float[Array, " setpoints"], key: PRNGKeyArray
    ) -> State:
        """Draw an initial state."""
        raise NotImplementedError

    def judge(
        self,
        state: State,
        target: Float[Array, "3"],
        setpoint: Float[Array, " setpoints"],
        command: Float[Array, "4"],
        parameters: Parameters,
    ) -> Float[Array, ""]:
        """Reward of the true ``state`` (not its estimate) after ``command`` [0 to 1]."""
        raise NotImplementedError

    def failed(self, state: State) -> Bool[Array, ""]:
        """Whether ``state`` ends the episode as a failure; a state that is not finite always does."""
        raise NotImplementedError

    @property
    def diverged_reward(self) -> float:
        """Reward of a step after which the state is not finite."""
        return -300.0

    def errors(
        self, state: State, target: Float[Array, "3"], setpoint: Float[Array, " setpoints"]
    ) -> Float[Array, "errors"]:
        """Errors that the reward decreases with, each scaled to about one, for the value network."""
        raise NotImplementedError


def longest_delay_s(task: Task, nominal: Quadrotor, magnitude: Float[Array, ""] | float | None = None) -> float | None:
    """Longest delay, s, of the estimates of any drone that the task draws about ``nominal``.

    Args:
        task: the task.
        nominal: centre of the ranges; may carry batch axes.
        magnitude: magnitude of the randomisation; default: the task's.

    Returns:
        The delay, or None if the model or the magnitude is traced.

    Raises:
        CfbError: a delay of zero has a relative range.
    """
    ranges = {} if task.randomisation is None else dict(task.randomisation.ranges)
    magnitude = task.magnitude if magnitude is None else magnitude
    longest = 0.0
    for name in _DELAYS[: 1 if task.lumped_delay else 2]:
        value, spread = getattr(nominal.parameters, name), ranges.get(name)
        if isinstance(value, Tracer) or (spread is not None and isinstance(magnitude, Tracer)):
            return None
        value = float(np.asarray(value).max())
        if spread is not None:
            if spread.relative and value == 0:
                raise CfbError(
                    f"ranges.{name} is relative, and {name} is 0, so nothing would vary; give the model one (--set "
                    f"{name}=0.002), or leave the range out."
                )
            width = float(magnitude) * max(spread.half_width)
            value = value * (1 + width) if spread.relative else value + width
        longest = max(longest, value + (task.noise.pose_jitter_s if name == "pose_delay" else 0.0))
    return longest


_DELAYS = ("pose_delay", "gyro_delay")


_AnyTask = TypeVar("_AnyTask", bound=Task)


def with_room(task: _AnyTask, nominal: Quadrotor) -> _AnyTask:
    """Return the task with room for the delayed estimates of all drones that it draws about ``nominal``.

    Afterwards ``nominal`` may be traced.

    Args:
        task: the task.
        nominal: centre of the ranges; may carry batch axes.
    """
    longest = longest_delay_s(task, nominal)
    return task if longest is None else replace(task, longest_delay_s=longest)


def room_s(task: Task, nominal: Quadrotor, magnitude) -> float:
    """How long estimates are stored, s.

    Raises:
        CfbError: the task has no room for the delays that can be drawn, or these are unknown as the model is traced.
    """
    longest, room = longest_delay_s(task, nominal, magnitude), task.longest_delay_s
    if room is None:
        if longest is None:
            raise CfbError(
                "reset: the delay of a traced model is not known at compile time; give the task its longest_delay_s, "
                "for example by with_room(task, model) outside of jit and vmap."
            )
        return longest
    if longest is not None and longest > room * (1 + 1e-6):
        names = " or ".join(_DELAYS[: 1 if task.lumped_delay else 2])
        raise CfbError(
            f"The task stores estimates for longest_delay_s = {room:g} s, but {names} can be {longest:g} s; increase "
            "it or leave it out."
        )
    return room
