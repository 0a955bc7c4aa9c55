"""Physical effects the basic model leaves out, one module each, and the catalogue that names them."""

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.catalogue import CATALOGUE, effect_from_mapping, effect_to_mapping
from cfb_mjx.model.effects.parasitic_drag import ParasiticDrag

__all__ = ["CATALOGUE", "Condition", "Effect", "ParasiticDrag", "Wrench", "effect_from_mapping", "effect_to_mapping"]
