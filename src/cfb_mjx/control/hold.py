"""Hold positions with the PID, for code that flies a drone with any controller (`sysid.excitation`)."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.control.pid import FirmwarePid, PidState, Setpoint, init, resume, step
from cfb_mjx.model.state import State


class PositionHold(eqx.Module):
    """Hold positions with a `FirmwarePid`."""

    pid: FirmwarePid

    def start(self, measurement: State) -> PidState:
        """Return the memory at the first measurement."""
        return init(self.pid, measurement)

    def resume(self, memory: PidState, measurement: State) -> PidState:
        """Return the memory for taking over again."""
        return resume(self.pid, memory, measurement)

    def command(
        self, memory: PidState, measurement: State, position: Float[Array, "3"], yaw: Float[Array, ""] | float = 0.0
    ) -> tuple[PidState, Float[Array, "4"]]:
        """New memory and command to hold ``position`` [m, world] and ``yaw`` [rad]; call it every `pid.DT` seconds."""
        return step(self.pid, memory, measurement, Setpoint.hover(position, yaw))
