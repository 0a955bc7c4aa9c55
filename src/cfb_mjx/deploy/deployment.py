"""What is exported to the drone: a policy that holds a target, optionally with a flip."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from cfb_mjx.control.manoeuvre import Manoeuvre, ManoeuvreFile, load_manoeuvre, shipped_manoeuvres
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.control.policy_file import SUFFIXES, PolicyFile, load_policy, shipped_policies
from cfb_mjx.errors import CfbError
from cfb_mjx.firmware.actions import ACTIONS, Action
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.optional import not_none
from cfb_mjx.parameters.model_file import load_model_file
from cfb_mjx.parameters.parameters import current_names

CATCH_S = 3.0
"""Time after the turn during which a flip still counts as running, s."""


@dataclass(frozen=True)
class Deployment:
    """Policies and manoeuvre of one export.

    Attributes:
        name: name for users.
        holder: policy that flies to targets.
        turner: policy of the flip; None: no flip.
        manoeuvre: rotations and knobs of the flip.
        loadable: whether the C takes other weights without being flashed; not with a flip.

    Raises:
        CfbError: a flip with loadable weights.
    """

    name: str
    holder: PolicyFile
    turner: PolicyFile | None = None
    manoeuvre: ManoeuvreFile | None = None
    loadable: bool = False

    def __post_init__(self):
        if self.loadable and self.flips:
            raise CfbError(f"{self.name}: the weights of a flip cannot be loadable; export it without --loadable.")

    @property
    def flips(self) -> bool:
        """Whether it can flip."""
        return self.turner is not None

    @property
    def controller(self) -> NeuralController | Manoeuvre:
        """The same controller in JAX. A flip begins with its first command."""
        if self.turner is None:
            return self.holder.controller
        return Manoeuvre(self.holder.controller, self.turner.controller, not_none(self.manoeuvre).knobs)

    @property
    def policies(self) -> dict[str, PolicyFile]:
        """All policies by their role."""
        return {"holder": self.holder} | ({} if self.turner is None else {"turner": self.turner})

    @property
    def setpoint_ranges(self) -> dict[str, tuple[float, float]]:
        """Ranges of a flip's speed and rate: those of the policy's training, extended to the manoeuvre's own values."""
        turner, manoeuvre = not_none(self.turner), not_none(self.manoeuvre)
        trained = (turner.training.get("config") or {}).get("setpoints", {})
        ranges = {}
        for name in ("speed_mps", "rate_radps"):
            own = float(getattr(manoeuvre.knobs, name))
            low, high = trained.get(name, (own, own))
            ranges[name] = min(low, own), max(high, own)
        return ranges

    def trained_on(self) -> dict[str, Any] | None:
        """Model on which the holder was trained; None if its file does not say."""
        return self.holder.training.get("model")

    def pose_delay(self) -> float | None:
        """Pose delay with which the holder was trained, s; None if its file does not say."""
        trained = self.trained_on()
        return None if trained is None else current_names(trained["parameters"], f"policy {self.name}")["pose_delay"]

    def hover_command(self) -> float:
        """Command at which the drone of the training hovers, mean of the motors."""
        return float(np.mean(self.plant().hover_command()))

    @property
    def action(self) -> Action:
        """What the policy's outputs mean."""
        return ACTIONS[self.holder.controller.layout.action]

    def settled(self) -> np.ndarray:
        """Outputs of the network, (4,), 0 to 1, that its history is filled with: those of a hover."""
        return np.asarray(self.action.settled(jnp.full(4, self.hover_command())))

    def outputs(self, commands: np.ndarray) -> np.ndarray:
        """Outputs of the network, 0 to 1, from commands of the C in their units; both (..., 4)."""
        return self.action.fractions(commands).astype(np.float32)

    def plant(self) -> Quadrotor:
        """Drone of the training, without effects; the paper's with guards if the policy's file does not say."""
        model = load_model_file("cfb-guards")
        if (trained := self.trained_on()) is not None:
            model = model.with_values(f"training of {self.name}", **trained["parameters"])
        return Quadrotor.from_file(model)


def find_deployment(name: str | Path, knobs: str | Path | None = None, holder: str | Path | None = None) -> Deployment:
    """Find the policies and the manoeuvre of a name or file.

    Args:
        name: shipped policy, policy file, or shipped manoeuvre (``double-flip``: the shipped flip policy with that
            manoeuvre).
        knobs: manoeuvre of a flip policy: a shipped one or a YAML file; default: ``flip``.
        holder: target policy that climbs and catches in a flip; default: the one with which the knobs were found.

    Raises:
        CfbError: there is no such policy or manoeuvre, or they do not fit together.
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
    if str(name) not in shipped and Path(name).suffix not in SUFFIXES:
        names = ", ".join([*shipped, *(m for m in shipped_manoeuvres() if m not in shipped)])
        raise CfbError(f"{name}: no such policy; give a policy file ({' or '.join(SUFFIXES)}) or one of {names}.")
    return load_policy(name)


def _flip(name: str, turner: PolicyFile, manoeuvre: ManoeuvreFile, holder: str | Path | None) -> Deployment:
    held = _policy(holder or manoeuvre.holder)
    found = Deployment(name, held, turner, manoeuvre)
    _ = found.controller  # raises if the two do not fit together
    return found
