"""Controllers of the Crazyflie's firmware, and its inner loops beneath a policy. Pure functions of pytrees."""

from cfb_mjx.firmware.mellinger import Mellinger
from cfb_mjx.firmware.pid import FirmwarePid, PidState, PositionHold, Setpoint, init, resume, step

__all__ = ["FirmwarePid", "Mellinger", "PidState", "PositionHold", "Setpoint", "init", "resume", "step"]
