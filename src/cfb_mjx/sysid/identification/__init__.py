"""Identification: fit the model's parameters and noise levels to flights, with uncertainty."""

from cfb_mjx.sysid.fitted import Estimate
from cfb_mjx.sysid.identification.fitting import default_parameters, fit
from cfb_mjx.sysid.identification.result import Fit
from cfb_mjx.sysid.identification.shooting import shoot

__all__ = ["Estimate", "Fit", "default_parameters", "fit", "shoot"]
