"""System identification: evaluate and fit the model on flights."""

from cfb_mjx.sysid.evaluation import HORIZONS, Evaluation, evaluate
from cfb_mjx.sysid.fitted import Estimate, Fitted
from cfb_mjx.sysid.windows import Windows, find_windows

__all__ = ["HORIZONS", "Estimate", "Evaluation", "Fitted", "Windows", "evaluate", "find_windows"]
