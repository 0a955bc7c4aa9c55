"""Refinement: fit parameters of a model to multi-step predictions, within physically plausible bounds.

`cfb_mjx.sysid.identification` and the search use one-step innovations, which feedback does not bias. But a model that
still lacks an effect may predict badly over half a second, above all because the attitude is unstable. A refinement
fits the same parameters to the predictions themselves. Feedback does bias this fit: the controller responds to what the
model lacks, so a plant that responds less to its rotors predicts better. Bounds keep every parameter within physical
limits (`plausible_numbers`). Without them the result is a predictor, not a plant (`free_numbers`).

Every flight has its own trim torque, because a battery is never put back in exactly the same place. It is a nuisance
parameter with a prior, estimated with the rest, and not part of the resulting model. The trims of all flights have zero
mean: a torque common to all flights belongs to the model, and is fitted if `cog_offset` is among the effects. A
predictor is fitted without trims, because it will be used on flights whose trim is unknown.
"""

from cfb_mjx.sysid.refinement.fitting import Refinement, refine
from cfb_mjx.sysid.refinement.numbers import Number, free_numbers, plausible_numbers

__all__ = ["Number", "Refinement", "free_numbers", "plausible_numbers", "refine"]
