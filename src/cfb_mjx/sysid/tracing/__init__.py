"""Model correction: search the catalogue for the physical effects that a model lacks."""

from cfb_mjx.sysid.tracing.closing import close_loop
from cfb_mjx.sysid.tracing.diagnosis import Diagnosis
from cfb_mjx.sysid.tracing.rules import RULES, Rules

__all__ = ["RULES", "Diagnosis", "Rules", "close_loop"]
