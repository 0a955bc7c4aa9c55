"""Controllers that fly to a target, from delayed estimates relative to it: networks and those of the firmware."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.control.policy_file import SUFFIXES, load_policy, shipped_policies
from cfb_mjx.envs.observation import StateEstimate
from cfb_mjx.errors import CfbError
from cfb_mjx.firmware import mellinger, pid
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State


@runtime_checkable
class Controller(Protocol):
    """A controller that flies to a target; it sees estimates relative to the target. `NeuralController` is one."""

    @property
    def control_dt_s(self) -> float:
        """Time between two commands, s."""
        ...

    def start(self, estimate: StateEstimate, command: Float[Array, "4"]) -> Any:
        """Return the memory at take-over; ``command`` is the command at which the rotors turn."""
        ...

    def command(self, memory: Any, estimate: StateEstimate) -> tuple[Any, Float[Array, "4"]]:
        """Return the new memory and the command of M1..M4, each in [0, 1]."""
        ...


class PidController(eqx.Module):
    """The firmware's PID with the heading held at zero."""

    firmware: pid.FirmwarePid
    control_dt_s: float = eqx.field(static=True, default=pid.DT)

    def start(self, estimate: StateEstimate, command: Float[Array, "4"]) -> Any:
        """Return a memory with empty integrators."""
        return pid.init(self.firmware, _measured(estimate))

    def command(self, memory: Any, estimate: StateEstimate) -> tuple[Any, Float[Array, "4"]]:
        """Return the new memory and the command of M1..M4, each in [0, 1]."""
        return pid.step(self.firmware, memory, _measured(estimate), pid.Setpoint.hover(jnp.zeros(3)))


class MellingerController(eqx.Module):
    """The firmware's Mellinger controller with the heading held at zero."""

    firmware: mellinger.Mellinger
    control_dt_s: float = eqx.field(static=True, default=pid.DT)

    def start(self, estimate: StateEstimate, command: Float[Array, "4"]) -> Any:
        """Return a memory with empty integrators."""
        return mellinger.init(_measured(estimate))

    def command(self, memory: Any, estimate: StateEstimate) -> tuple[Any, Float[Array, "4"]]:
        """Return the new memory and the command of M1..M4, each in [0, 1]."""
        return mellinger.step(self.firmware, memory, _measured(estimate), jnp.zeros(3))


def has_lumped_delay(controller: str | Path) -> bool:
    """Whether a controller expects the gyro with the delay of the pose (`cfb_mjx.envs.Task.lumped_delay`).

    For a policy this is how it was trained; policies that do not say follow the paper (True). The firmware's
    controllers read the gyro on the drone (False).

    Args:
        controller: ``pid``, ``mellinger``, a shipped policy or a policy file.

    Raises:
        CfbError: the file is not a policy.
    """
    if controller in ("pid", "mellinger"):
        return False
    return load_policy(controller).lumped_delay


def is_flip_policy(controller: Controller) -> bool:
    """Whether a controller flies set-points of speed and rate, which a manoeuvre gives it, rather than to a target."""
    return bool(getattr(getattr(controller, "layout", None), "setpoint_scales", ()))


def is_tracking_policy(controller: Controller) -> bool:
    """Whether a controller sees ahead of a target that moves (`cfb_mjx.envs.Layout.preview_s`)."""
    return bool(getattr(getattr(controller, "layout", None), "preview_s", ()))


def require_motor_commands(controller: Controller, what: str) -> None:
    """Refuse policies that command the firmware's loops.

    Args:
        controller: the controller.
        what: what needs motor commands, for the message.

    Raises:
        CfbError: the controller is a policy with another action than motor commands.
    """
    action = getattr(getattr(controller, "layout", None), "action", "motors")
    if action != "motors":
        raise CfbError(
            f"{what} needs a controller that commands the motors, not {action}; fly this policy with cfb fly, "
            "cfb_mjx.train.flight.fly or an environment, which have the firmware's loops."
        )


def _measured(estimate: StateEstimate) -> State:
    return State(estimate.position, estimate.velocity, estimate.quaternion, estimate.body_rate, jnp.zeros(4))


def find_controller(controller: str | Path, nominal: Quadrotor) -> Controller:
    """Return the controller of a name (pid, mellinger, a shipped policy) or of a policy file.

    Args:
        controller: name or file.
        nominal: drone for which the PID's base thrust is set.

    Raises:
        CfbError: there is no such controller, or the file is not a policy.
    """
    if controller == "pid":
        return PidController(pid.FirmwarePid.hovering(nominal.changed_parameters()))
    if controller == "mellinger":
        return MellingerController(mellinger.Mellinger())
    found = shipped_policies()
    if controller not in found and Path(controller).suffix not in SUFFIXES:
        names = ", ".join(["pid", "mellinger", *found])
        raise CfbError(
            f"{controller}: no such controller; give a policy file ({' or '.join(SUFFIXES)}) or one of {names}."
        )
    return load_policy(controller).controller
