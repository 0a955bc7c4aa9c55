"""Tasks for training: observations, rewards, and how episodes begin and end."""

from cfb_mjx.envs.episode import Episode, observe, privileged, reset, step
from cfb_mjx.envs.flip import FlipReward, FlipStarts, FlipTask, Setpoints
from cfb_mjx.envs.observation import Layout, Memory, StateEstimate
from cfb_mjx.envs.path import (
    Harmonics,
    Path,
    Polynomials,
    demand,
    figure_eight,
    random_spline,
    read_path,
    slowed,
    through,
)
from cfb_mjx.envs.reward import PAPER_REWARD, TargetReward
from cfb_mjx.envs.starts import Starts
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import Noise, Task, with_room
from cfb_mjx.envs.track import Paths, TrackTask

__all__ = [
    "PAPER_REWARD",
    "Episode",
    "FlipReward",
    "FlipStarts",
    "FlipTask",
    "Harmonics",
    "Layout",
    "Memory",
    "Noise",
    "Path",
    "Paths",
    "Polynomials",
    "Setpoints",
    "Starts",
    "StateEstimate",
    "TargetReward",
    "TargetTask",
    "Task",
    "TrackTask",
    "demand",
    "figure_eight",
    "observe",
    "privileged",
    "random_spline",
    "read_path",
    "reset",
    "slowed",
    "step",
    "through",
    "with_room",
]
