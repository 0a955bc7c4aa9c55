"""Simulate, identify and train controllers for the Crazyflie 2.1 Brushless in JAX and MJX.

The names that most programs need are here. They are imported on first use, so ``import cfb_mjx`` takes milliseconds::

    import cfb_mjx as cfb

    drone = cfb.load("cfb-guards")                                  # a preset, or your model.yaml
    flown = cfb.rollout(drone, drone.hover_state(), commands)       # jit, vmap and grad work on it
    errors = cfb.Evaluate("flight.mcap", model="my_drone.yaml").run()

Functions work on arrays. Commands (`Evaluate`, `Fit`, `CloseLoop`, `Train` ...) work on files, as ``cfb`` does. Less
common functions are in the packages ``cfb.model``, ``cfb.sysid`` and so on.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

__version__ = "0.2.0"

_PACKAGES = (
    "bench",
    "commands",
    "control",
    "deploy",
    "envs",
    "firmware",
    "logs",
    "loop",
    "model",
    "parameters",
    "reproduce",
    "runtime",
    "sweep",
    "sysid",
    "train",
    "view",
)
_FUNCTIONS = {
    "CfbError": "errors",
    "MjxBody": "model",
    "Quadrotor": "model",
    "evaluate": "sysid",
    "export_policy": "deploy",
    "find_controller": "control",
    "load_policy": "control",
    "load_randomisation": "parameters",
    "read_log": "logs",
    "rollout": "model",
    "rollout_closed_loop": "control",
    "rollout_final": "model",
    "sample_drone": "model",
}
if TYPE_CHECKING:
    from cfb_mjx import (
        bench,
        commands,
        control,
        deploy,
        envs,
        firmware,
        logs,
        loop,
        model,
        parameters,
        reproduce,
        runtime,
        sweep,
        sysid,
        train,
        view,
    )
    from cfb_mjx.commands import (
        Check,
        CloseLoop,
        Evaluate,
        Excite,
        Export,
        Fit,
        FitRotors,
        Fly,
        Import,
        Refine,
        Sweep,
        Train,
        View,
    )
    from cfb_mjx.control import find_controller, load_policy, rollout_closed_loop
    from cfb_mjx.deploy import export_policy
    from cfb_mjx.errors import CfbError
    from cfb_mjx.logs import read_log
    from cfb_mjx.model import MjxBody, Quadrotor, rollout, rollout_final, sample_drone
    from cfb_mjx.parameters import load_randomisation
    from cfb_mjx.sysid import evaluate

    load = Quadrotor.from_file

__all__ = [
    "CfbError",
    "Check",
    "CloseLoop",
    "Evaluate",
    "Excite",
    "Export",
    "Fit",
    "FitRotors",
    "Fly",
    "Import",
    "MjxBody",
    "Quadrotor",
    "Refine",
    "Sweep",
    "Train",
    "View",
    "__version__",
    "bench",
    "commands",
    "control",
    "deploy",
    "envs",
    "evaluate",
    "export_policy",
    "find_controller",
    "firmware",
    "load",
    "load_policy",
    "load_randomisation",
    "logs",
    "loop",
    "model",
    "parameters",
    "read_log",
    "reproduce",
    "rollout",
    "rollout_closed_loop",
    "rollout_final",
    "runtime",
    "sample_drone",
    "sweep",
    "sysid",
    "train",
    "view",
]


def __getattr__(name: str):
    if name in _PACKAGES:
        return importlib.import_module(f"cfb_mjx.{name}")
    if name == "load":
        return importlib.import_module("cfb_mjx.model").Quadrotor.from_file
    if name in __all__:
        return getattr(importlib.import_module(f"cfb_mjx.{_FUNCTIONS.get(name, 'commands')}"), name)
    raise AttributeError(f"module 'cfb_mjx' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
