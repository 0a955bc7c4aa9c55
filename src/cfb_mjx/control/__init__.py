"""Controllers: the firmware's cascaded PID. Pure functions over immutable pytrees."""

from cfb_mjx.control.hold import PositionHold
from cfb_mjx.control.pid import FirmwarePid, PidState, Setpoint, init, resume, step

__all__ = ["FirmwarePid", "PidState", "PositionHold", "Setpoint", "init", "resume", "step"]
