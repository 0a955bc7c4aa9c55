"""The drone's constants: parameter pytree, presets with their sources, YAML files, and randomisation ranges."""

from cfb_mjx.parameters.model_file import Entry, ModelFile, load_model_file, preset_names, save_model_file
from cfb_mjx.parameters.parameters import SPECIFICATIONS, Limits, Parameters
from cfb_mjx.parameters.randomisation import Randomisation, load_randomisation, require_possible, sample_parameters

__all__ = [
    "SPECIFICATIONS",
    "Entry",
    "Limits",
    "ModelFile",
    "Parameters",
    "Randomisation",
    "load_model_file",
    "load_randomisation",
    "preset_names",
    "require_possible",
    "sample_parameters",
    "save_model_file",
]
