"""Controllers: the firmware's PID and Mellinger, and neural policies. Pure functions over immutable pytrees."""

from cfb_mjx.control.closed_loop import ClosedLoop, rollout_closed_loop
from cfb_mjx.control.controllers import Controller, MellingerController, PidController, find_controller
from cfb_mjx.control.foreign import brax_controller, foreign_controller
from cfb_mjx.control.neural import Gru, Network, NeuralController
from cfb_mjx.control.onnx_file import read_onnx, write_onnx
from cfb_mjx.control.policy_file import PolicyFile, load_policy, save_policy
from cfb_mjx.firmware.mellinger import Mellinger
from cfb_mjx.firmware.pid import FirmwarePid, PidState, PositionHold, Setpoint, init, resume, step

__all__ = [
    "ClosedLoop",
    "Controller",
    "FirmwarePid",
    "Gru",
    "Mellinger",
    "MellingerController",
    "Network",
    "NeuralController",
    "PidController",
    "PidState",
    "PolicyFile",
    "PositionHold",
    "Setpoint",
    "brax_controller",
    "find_controller",
    "foreign_controller",
    "init",
    "load_policy",
    "read_onnx",
    "resume",
    "rollout_closed_loop",
    "save_policy",
    "step",
    "write_onnx",
]
