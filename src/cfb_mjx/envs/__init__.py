"""Tasks to train on: what the controller sees, what it is rewarded for, how episodes begin and end."""

from cfb_mjx.envs.observation import Estimate, Layout, Memory
from cfb_mjx.envs.reward import PaperReward
from cfb_mjx.envs.starts import Starts
from cfb_mjx.envs.target import Episode, Noise, TargetTask, observe, reset, step

__all__ = [
    "Episode",
    "Estimate",
    "Layout",
    "Memory",
    "Noise",
    "PaperReward",
    "Starts",
    "TargetTask",
    "observe",
    "reset",
    "step",
]
