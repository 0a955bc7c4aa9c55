"""The PID as a holder of positions, for what flies a drone without asking how (`sysid.excitation`)."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.control.pid import FirmwarePid, PidState, Setpoint, init, resume, step
from cfb_mjx.model.state import State


class PositionHold(eqx.Module):
    """Start, resume and command a `FirmwarePid`."""

    pid: FirmwarePid

    def start(self, measurement: State) -> PidState:
        """Memory at the first measurement."""
        return init(self.pid, measurement)

    def resume(self, memory: PidState, measurement: State) -> PidState:
        """Memory when taking over again."""
        return resume(self.pid, memory, measurement)

    def command(
        self, memory: PidState, measurement: State, position: Float[Array, "3"], yaw: Float[Array, ""] | float = 0.0
    ) -> tuple[PidState, Float[Array, "4"]]:
        """New memory and command to hold ``position`` [m, world] and ``yaw`` [rad]; called every `pid.DT`."""
        return step(self.pid, memory, measurement, Setpoint.hover(position, yaw))
