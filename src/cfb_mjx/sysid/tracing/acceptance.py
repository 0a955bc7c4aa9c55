"""When an effect counts: beyond chance on blocks left out, plausible, and worth something to predictions."""

from __future__ import annotations

import numpy as np

from cfb_mjx.model.effects import KNOWN
from cfb_mjx.sysid.tracing.columns import SHIFT
from cfb_mjx.sysid.tracing.evidence import Evidence
from cfb_mjx.sysid.tracing.fits import Fit
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis

ALPHA = 1e-2
"""An effect's p-value, times the number of effects tried, must be below this."""
LEAST_GAIN = 5.0
"""And it must gain so many nats of log-likelihood on blocks left out."""
MATERIAL = 0.05
"""And lower at least one prediction error (four quantities, two horizons) by this share."""
OF_FIRST = 0.02
"""And by this share of what the declared model scores, so that the last crumbs of a large error are not chased."""
STRUCTURE = 0.06
"""What a search did not find (a formula, a rarely excited effect) counts when it lowers an error by this share."""
STRUCTURE_OF_FIRST = 0.05
"""And by this share of what the declared model scores: an effect of slightly another shape leaves crumbs."""
CLEAR = 8.0
"""An effect whose statistic is above this need only be material in one flight: what few flights excite (yaw, most of
all) drowns in the errors of the others, and no chance brings such a statistic about."""
FAR_OFF = 1 / 3
"""A model lacks much if, after half a second, it errs by more than this share of what hold errs."""
SMALLEST_SHIFT = 0.0015
"""Motor columns less late or early than this, s, are commands between rows rather than a fault."""


def significant(found: Evidence, tried: int) -> bool:
    """Whether evidence stands after so many tries."""
    return found.p_value * tried < ALPHA and found.gain > LEAST_GAIN


def implausible(hypothesis: Hypothesis, name: str) -> bool:
    """Whether an effect had to be stretched to twice its plausible strength: then it stands in for another."""
    if name == SHIFT:
        return False
    effect, kind = hypothesis.effect(name), KNOWN[name]
    values = {field: np.asarray(getattr(effect, field)) for field in kind.strengths}
    return any(np.any((v > 2 * kind.prior[f][1]) | (v < 2 * kind.prior[f][0])) for f, v in values.items())


def worth_it(name: str, fit: Fit, richer: Fit, nothing: Fit, clear: bool) -> bool:
    """Whether an effect that stands against chance also predicts better, and is no other one in disguise.

    Args:
        name: the effect.
        fit: without it.
        richer: with it.
        nothing: the declared model.
        clear: whether its statistic is above `CLEAR`.
    """
    if not np.isfinite(richer.errors).all() or implausible(richer.hypothesis, name):
        return False
    if name == SHIFT and abs(richer.hypothesis.shift) < SMALLEST_SHIFT:
        return False
    return np.log(richer.errors / fit.errors).sum() <= 0 and material(fit, richer, nothing, clear)


def material(fit: Fit, richer: Fit, nothing: Fit, clear: bool) -> bool:
    """Whether the richer fit lowers an error by a share that matters, of all flights or, if ``clear``, of one."""
    shares = MATERIAL, OF_FIRST
    if enough(fit.errors, richer.errors, nothing.errors, *shares):
        return True
    return clear and enough(fit.by_flight, richer.by_flight, nothing.by_flight, *shares)


def missed(poorer: Fit, richer: Fit, clear: bool) -> bool:
    """Whether one effect of many matters beside all others, in all flights or, if ``clear``, twice as much in one.

    What the declared model scores, far off with many effects missing, is no measure of that.
    """
    if np.max(1 - richer.errors / poorer.errors) >= MATERIAL:
        return True
    return clear and bool(np.max(1 - richer.by_flight / poorer.by_flight) >= 2 * MATERIAL)


def enough(poorer: np.ndarray, better: np.ndarray, first: np.ndarray, share: float, of_first: float) -> bool:
    """Whether an error is lowered by a share, and an error by a share of what the declared model (``first``) scores."""
    return bool(np.max(1 - better / poorer) >= share and np.max((poorer - better) / first) >= of_first)


def lowered(old: np.ndarray, new: np.ndarray, first: np.ndarray) -> bool:
    """Whether what a search did not find lowers an error by a share that matters, and errors on the whole."""
    return enough(old, new, first, STRUCTURE, STRUCTURE_OF_FIRST) and np.log(new / old).sum() <= 0
