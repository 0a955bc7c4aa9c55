"""Simulate, identify and train controllers for the Crazyflie 2.1 Brushless in JAX and MJX.

The rooms of the library are imported on first use, so that ``import cfb_mjx`` costs milliseconds::

    import cfb_mjx
    model = cfb_mjx.model.Quadrotor.from_file("cfb-guards")
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

__version__ = "0.2.0"

_ROOMS = ("control", "envs", "logs", "model", "parameters", "sysid", "train", "view")
__all__ = ["__version__", "control", "envs", "logs", "model", "parameters", "sysid", "train", "view"]

if TYPE_CHECKING:
    from cfb_mjx import control, envs, logs, model, parameters, sysid, train, view


def __getattr__(name: str):
    if name in _ROOMS:
        return importlib.import_module(f"cfb_mjx.{name}")
    raise AttributeError(f"module 'cfb_mjx' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
