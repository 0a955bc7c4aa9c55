"""What holds a target on late estimates relative to it: networks and the firmware's controllers alike."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.control import mellinger, pid
from cfb_mjx.control.policy_file import load_policy, shipped_policies
from cfb_mjx.envs.observation import Estimate
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State


@runtime_checkable
class Controller(Protocol):
    """What holds the target: what it sees is relative to it. `NeuralController` is one."""

    @property
    def control_dt_s(self) -> float:
        """Time between two commands, s."""
        ...

    def start(self, estimate: Estimate, command: Float[Array, "4"]) -> Any:
        """Memory at take-over; ``command`` is what the rotors turn at."""
        ...

    def command(self, memory: Any, estimate: Estimate) -> tuple[Any, Float[Array, "4"]]:
        """New memory and command."""
        ...


class PidController(eqx.Module):
    """The firmware's PID, heading kept at zero."""

    firmware: pid.FirmwarePid
    control_dt_s: float = eqx.field(static=True, default=pid.DT)

    def start(self, estimate: Estimate, command: Float[Array, "4"]) -> Any:
        """Empty integrators."""
        return pid.init(self.firmware, _measured(estimate))

    def command(self, memory: Any, estimate: Estimate) -> tuple[Any, Float[Array, "4"]]:
        """New memory and command."""
        return pid.step(self.firmware, memory, _measured(estimate), pid.Setpoint.hover(jnp.zeros(3)))


class MellingerController(eqx.Module):
    """The firmware's Mellinger controller, heading kept at zero."""

    firmware: mellinger.Mellinger
    control_dt_s: float = eqx.field(static=True, default=pid.DT)

    def start(self, estimate: Estimate, command: Float[Array, "4"]) -> Any:
        """Empty integrators."""
        return mellinger.init(_measured(estimate))

    def command(self, memory: Any, estimate: Estimate) -> tuple[Any, Float[Array, "4"]]:
        """New memory and command."""
        return mellinger.step(self.firmware, memory, _measured(estimate), jnp.zeros(3))


def has_lumped_delay(controller: str | Path) -> bool:
    """Whether a controller flies with the gyro as late as the pose (`cfb_mjx.envs.Task.lumped_delay`).

    A policy does as it was trained, which for those that do not say is the paper's reading; the firmware's controllers
    read the gyro on the drone.

    Raises:
        CfbError: the file is no policy.
    """
    if controller in ("pid", "mellinger"):
        return False
    return load_policy(controller).lumped_delay


def is_flip_policy(controller: Controller) -> bool:
    """Whether it flies set-points of speed and rate, which a manoeuvre gives it, and not to a target."""
    return bool(getattr(getattr(controller, "layout", None), "setpoint_scales", ()))


def _measured(estimate: Estimate) -> State:
    return State(estimate.position, estimate.velocity, estimate.quaternion, estimate.body_rate, jnp.zeros(4))


def find_controller(controller: str | Path, nominal: Quadrotor) -> Controller:
    """The controller of a name (pid, mellinger, a shipped policy) or of a policy file.

    Args:
        controller: name or file.
        nominal: the drone that the PID's base thrust is set for.

    Raises:
        CfbError: there is no such controller, or the file is no policy.
    """
    if controller == "pid":
        return PidController(pid.FirmwarePid.hovering(nominal.changed_parameters()))
    if controller == "mellinger":
        return MellingerController(mellinger.Mellinger())
    found = shipped_policies()
    if controller not in found and Path(controller).suffix != ".npz":
        names = ", ".join(["pid", "mellinger", *found])
        raise CfbError(f"{controller}: no such controller; give a policy file (.npz) or one of {names}.")
    return load_policy(controller).controller
