"""Export of trained policies as C for the drone, and the check that the C computes the same commands."""

from cfb_mjx.deploy.check import compare, fly_beside
from cfb_mjx.deploy.compiled import CompiledPolicy, compile_policy
from cfb_mjx.deploy.contract import contract
from cfb_mjx.deploy.export import Exported, export_policy

__all__ = [
    "CompiledPolicy",
    "Exported",
    "compare",
    "compile_policy",
    "contract",
    "export_policy",
    "fly_beside",
]
