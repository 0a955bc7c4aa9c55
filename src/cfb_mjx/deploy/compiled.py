"""An exported policy, compiled for this machine and called from Python."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cfb_mjx.deploy.export import Exported
from cfb_mjx.errors import CfbError
from cfb_mjx.files import scratch

FLAGS = ("-std=c11", "-O2", "-Wall", "-Wextra", "-Werror")
"""Flags with which the sources must compile."""


class CompiledPolicy:
    """The compiled C policy. The C library holds one global state; `reset` begins anew."""

    def __init__(self, library: ctypes.CDLL, flips: bool, previews: int = 0):
        self._library, self.flips, self.previews = library, flips, previews
        library.cfb_policy_dt.restype = ctypes.c_float
        if flips:
            library.cfb_policy_set_flip.argtypes = [ctypes.c_float, ctypes.c_float]
        library.cfb_policy_step.argtypes = [ctypes.c_void_p] * 6
        library.cfb_policy_step.restype = None

    @property
    def dt(self) -> float:
        """Time between two steps, s."""
        return float(self._library.cfb_policy_dt())

    @property
    def fault(self) -> int:
        """Fault of the policy: 0 none, 1 blind, 2 stopped."""
        return int(self._library.cfb_policy_fault())

    @property
    def phase(self) -> int:
        """Phase of a flip: 0 hold, 1 climb, 2 turn, 3 catch."""
        return int(self._library.cfb_policy_phase())

    def reset(self) -> None:
        """Clear the memory."""
        self._library.cfb_policy_reset()

    def set_flip(self, speed_mps: float, rate_radps: float) -> None:
        """Begin a flip at the next step."""
        self._library.cfb_policy_set_flip(speed_mps, rate_radps)

    def load_weights(self, data: bytes) -> int:
        """Write a set of weights and let it fly; return its status, `cfb_weights_status_t`."""
        self._library.cfb_weights_write(0, data, len(data))
        return int(self._library.cfb_weights_apply())

    def step(self, position, velocity, quaternion, body_rate, target=(0.0, 0.0, 0.0)) -> np.ndarray:
        """Do one step; return the commands of M1..M4, (4,), float32."""
        return self.steps(np.concatenate([position, velocity, quaternion, body_rate, target])[None])[0]

    def steps(self, inputs: np.ndarray) -> np.ndarray:
        """Do many steps in a row.

        Args:
            inputs: (steps, 16): position, velocity, quaternion, body rate, target; for a policy that sees ahead also
                three numbers for every preview.

        Returns:
            Commands, (steps, 4), float32.
        """
        rows = np.ascontiguousarray(inputs, np.float32)
        commands = np.empty((len(rows), 4), np.float32)
        step, at, into = self._library.cfb_policy_step, rows.ctypes.data, commands.ctypes.data
        for i in range(len(rows)):
            row = at + rows.strides[0] * i
            if self.previews and rows.shape[1] > 16:
                self._library.cfb_policy_set_preview(ctypes.c_void_p(row + 64))
            step(row, row + 12, row + 24, row + 40, row + 52, into + 16 * i)
        return commands


def compile_policy(exported: Exported, extra: Sequence[str] = ()) -> CompiledPolicy:
    """Compile with the system's compiler (``CC``, else cc) and strict flags.

    Args:
        exported: the exported policy.
        extra: further flags.

    Raises:
        CfbError: there is no compiler, or it reports an error.
    """
    compiler = os.environ.get("CC") or "cc"
    with scratch("cfb-policy-") as folder:
        library = Path(folder) / "policy.so"
        sources = [str(path) for path in exported.sources]
        run_compiler([compiler, *FLAGS, *extra, "-shared", "-fPIC", "-o", str(library), *sources, "-lm"])
        # Once loaded, the library stays in memory after its file is deleted.
        previews = len(exported.deployment.holder.controller.layout.preview_s)
        return CompiledPolicy(ctypes.CDLL(str(library)), exported.deployment.flips, previews)


def run_compiler(command: list[str]) -> str:
    """Run a compiler or one of its tools, and return its output.

    Raises:
        CfbError: the program is not installed, or fails.
    """
    if shutil.which(command[0]) is None:
        raise CfbError(f"{command[0]}: there is no such compiler; install one (Debian: apt install gcc) or set CC.")
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        words = " ".join(done.stderr.split())[:400]
        raise CfbError(f"{command[0]} does not compile the exported policy: {words}")
    return done.stdout
