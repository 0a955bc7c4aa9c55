"""Refinement: numbers of a model fitted to multi-step predictions, within what is physically plausible.

`cfb_mjx.sysid.identification` and tracing rest on one-step innovations, which feedback does not bias. A model that
still misses something may score badly over half a second nevertheless, above all where the attitude is unstable. Here
the same numbers are fitted to the predictions themselves. That is what feedback biases: a controller answers what the
model misses, so a plant that listens less to its rotors predicts better. Bounds keep every number where physics allows
it (`plausible_numbers`); without them the result is a predictor, not a plant (`free_numbers`).

Every flight has a trim torque of its own, a nuisance: a battery is never put back in quite the same place. It is
estimated beside the rest, with a prior, and not part of the model that comes out. Trims have no mean: what all flights
share belongs to the model, and is fitted if an effect for it (`cog_offset`) is. A predictor is fitted without: what it
is for is a flight whose trim nobody knows.
"""

from cfb_mjx.sysid.refinement.fitting import Refinement, refine
from cfb_mjx.sysid.refinement.numbers import Number, free_numbers, plausible_numbers

__all__ = ["Number", "Refinement", "free_numbers", "plausible_numbers", "refine"]
