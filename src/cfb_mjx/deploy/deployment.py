"""What goes onto the drone: a policy that holds a target, or one that flips in between."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx.control.manoeuvre import Manoeuvre
from cfb_mjx.control.manoeuvre_file import ManoeuvreFile, load_manoeuvre, shipped_manoeuvres
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.control.policy_file import PolicyFile, load_policy, shipped_policies
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.optional import not_none
from cfb_mjx.parameters.model_file import load_model_file
from cfb_mjx.parameters.parameters import current_names

CATCH_S = 3.0
"""How long after the turn a flip counts as under way."""


@dataclass(frozen=True)
class Deployment:
    """Policies and manoeuvre of one export.

    Attributes:
        name: for people.
        holder: flies to targets.
        turner: of a flip; None: there is none.
        manoeuvre: its knobs.
    """

    name: str
    holder: PolicyFile
    turner: PolicyFile | None = None
    manoeuvre: ManoeuvreFile | None = None

    @property
    def flips(self) -> bool:
        """Whether it can flip."""
        return self.turner is not None

    @property
    def controller(self) -> NeuralController | Manoeuvre:
        """The same in JAX. A flip begins with its first command."""
        if self.turner is None:
            return self.holder.controller
        return Manoeuvre(self.holder.controller, self.turner.controller, not_none(self.manoeuvre).knobs)

    @property
    def policies(self) -> dict[str, PolicyFile]:
        """All of them by what they do."""
        return {"holder": self.holder} | ({} if self.turner is None else {"turner": self.turner})

    @property
    def setpoint_ranges(self) -> dict[str, tuple[float, float]]:
        """Of a flip's speed and rate: what its policy was trained for, and the manoeuvre's own, where that is more."""
        turner, manoeuvre = not_none(self.turner), not_none(self.manoeuvre)
        trained = (turner.training.get("config") or {}).get("setpoints", {})
        ranges = {}
        for name in ("speed_mps", "rate_radps"):
            own = float(getattr(manoeuvre.knobs, name))
            low, high = trained.get(name, (own, own))
            ranges[name] = min(low, own), max(high, own)
        return ranges

    def trained_on(self) -> dict[str, Any] | None:
        """The model that the holder was trained on; None: its file does not say."""
        return self.holder.training.get("model")

    def pose_delay(self) -> float | None:
        """Age of the pose that the holder was trained with, s; None: its file does not say."""
        trained = self.trained_on()
        return None if trained is None else current_names(trained["parameters"], f"policy {self.name}")["pose_delay"]

    def hover_command(self) -> float:
        """The command that hovers the drone it was trained for, mean of the motors."""
        return float(np.mean(self.plant().hover_command()))

    def plant(self) -> Quadrotor:
        """The drone it was trained for, without effects; the paper's with guards where its file does not say."""
        model = load_model_file("cfb-guards")
        if (trained := self.trained_on()) is not None:
            model = model.with_values(f"training of {self.name}", **trained["parameters"])
        return Quadrotor.from_file(model)


def find_deployment(name: str | Path, knobs: str | Path | None = None, holder: str | Path | None = None) -> Deployment:
    """What a name or file stands for.

    Args:
        name: a shipped policy, a policy file, or a shipped manoeuvre (``double-flip``: the shipped flip policy
            with it).
        knobs: manoeuvre of a flip policy: a shipped one or a YAML file; ``flip`` by default.
        holder: the target policy that climbs and catches in a flip; by default the one its knobs were found with.

    Raises:
        CfbError: there is no such policy or manoeuvre, or they do not go together.
    """
    shipped = shipped_policies()
    if str(name) in shipped_manoeuvres() and str(name) not in shipped:
        if knobs is not None:
            raise CfbError(f"{name} is a manoeuvre already; leave out --knobs, or export flip with them.")
        return _flip(str(name), load_policy("flip"), load_manoeuvre(str(name)), holder)
    policy = _policy(name)
    label = Path(name).stem if str(name) not in shipped else str(name)
    if policy.controller.layout.setpoint_scales:
        return _flip(label, policy, load_manoeuvre(knobs or "flip"), holder)
    if knobs is not None:
        raise CfbError(f"--knobs are for flip policies; {name} holds a target.")
    return Deployment(label, policy)


def _policy(name: str | Path) -> PolicyFile:
    shipped = shipped_policies()
    if str(name) not in shipped and Path(name).suffix != ".npz":
        names = ", ".join([*shipped, *(m for m in shipped_manoeuvres() if m not in shipped)])
        raise CfbError(f"{name}: no such policy; give a policy file (.npz) or one of {names}.")
    return load_policy(name)


def _flip(name: str, turner: PolicyFile, manoeuvre: ManoeuvreFile, holder: str | Path | None) -> Deployment:
    held = _policy(holder or manoeuvre.holder)
    found = Deployment(name, held, turner, manoeuvre)
    _ = found.controller  # says so where they do not go together
    return found
