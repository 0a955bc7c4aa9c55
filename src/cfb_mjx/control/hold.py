"""The PID as a holder of positions, for what flies a drone without asking how (`sysid.excitation`)."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.control.pid import FirmwarePid, PidState, Setpoint, init, resume, step
from cfb_mjx.model.state import State


class PositionHold(eqx.Module):
    """Start, resume and command a `FirmwarePid`, yaw towards zero."""

    pid: FirmwarePid

    def start(self, measurement: State) -> PidState:
        """Memory at the first measurement."""
        return init(self.pid, measurement)

    def resume(self, memory: PidState, measurement: State) -> PidState:
        """Memory when taking over again."""
        return resume(self.pid, memory, measurement)

    def command(
        self, memory: PidState, measurement: State, position: Float[Array, "3"]
    ) -> tuple[PidState, Float[Array, "4"]]:
        """New memory and command to hold ``position`` [m, world]; called every `cfb_mjx.control.pid.DT`."""
        return step(self.pid, memory, measurement, Setpoint.hover(position))
