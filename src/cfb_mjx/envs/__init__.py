"""Tasks for training: observations, rewards, and how episodes begin and end."""

from cfb_mjx.envs.episode import Episode, Noise, Starts, Task, observe, privileged, reset, step, with_room
from cfb_mjx.envs.flip import FlipReward, FlipStarts, FlipTask, Setpoints
from cfb_mjx.envs.observation import Layout, Memory, StateEstimate
from cfb_mjx.envs.reward import PAPER_REWARD, TargetReward
from cfb_mjx.envs.target import TargetTask

__all__ = [
    "PAPER_REWARD",
    "Episode",
    "FlipReward",
    "FlipStarts",
    "FlipTask",
    "Layout",
    "Memory",
    "Noise",
    "Setpoints",
    "Starts",
    "StateEstimate",
    "TargetReward",
    "TargetTask",
    "Task",
    "observe",
    "privileged",
    "reset",
    "step",
    "with_room",
]
