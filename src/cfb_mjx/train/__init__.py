"""Training: configurations, two algorithms, checkpoints, learning curves, and the evaluation of controllers."""

from cfb_mjx.train.config import TrainingConfig, load_config
from cfb_mjx.train.run import Training, train

__all__ = ["Training", "TrainingConfig", "load_config", "train"]
