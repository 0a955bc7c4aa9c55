"""Controllers: the firmware's PID and Mellinger, and neural policies. Pure functions over immutable pytrees."""

from cfb_mjx.control.closed_loop import ClosedLoop, rollout_closed_loop
from cfb_mjx.control.hold import PositionHold
from cfb_mjx.control.mellinger import Mellinger
from cfb_mjx.control.neural import Network, NeuralController
from cfb_mjx.control.pid import FirmwarePid, PidState, Setpoint, init, resume, step
from cfb_mjx.control.pilot import MellingerPilot, PidPilot, Pilot, find_pilot
from cfb_mjx.control.policy_file import PolicyFile, load_policy, save_policy

__all__ = [
    "ClosedLoop",
    "FirmwarePid",
    "Mellinger",
    "MellingerPilot",
    "Network",
    "NeuralController",
    "PidPilot",
    "PidState",
    "Pilot",
    "PolicyFile",
    "PositionHold",
    "Setpoint",
    "find_pilot",
    "init",
    "load_policy",
    "resume",
    "rollout_closed_loop",
    "save_policy",
    "step",
]
