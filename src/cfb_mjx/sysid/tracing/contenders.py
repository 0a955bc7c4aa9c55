"""Which of the effects that explain flights about as well is tried first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cfb_mjx.sysid.tracing.acceptance import implausible
from cfb_mjx.sysid.tracing.columns import SHIFT, Column
from cfb_mjx.sysid.tracing.confirmation import confirm
from cfb_mjx.sysid.tracing.evidence import Evidence
from cfb_mjx.sysid.tracing.fits import Fit, fitted, prediction_errors
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis
from cfb_mjx.sysid.tracing.search import Search

CONTENDERS, CONTENDER = 3, 0.5
"""So many effects of a ranking are fitted, if they gain this share of the first."""
PARSIMONY = 0.02
"""A rival with fewer numbers is preferred if it gains all but this share."""
CLOSE = 0.1
"""A rival that gains all but this share of the winner's gain is named as confusable with it."""
SAME_ERRORS = 0.03
"""Of such rivals those are tried first whose prediction errors (mean logarithm) are the lowest but for this."""


def contenders(
    search: Search, fit: Fit, ranking: list[tuple[Evidence, list[Column]]], progress: Callable[[str], None]
) -> tuple[list[tuple[str, Fit]], set[str]]:
    """The candidates that explain the flights best, fitted beside what is there.

    The ranking rests on slopes at neutral, which say little of effects whose shape is still to be fitted: those that
    come near the best there are fitted too. Of those that gain nearly the same, the ones that predict best come first,
    and of those the one with the fewest numbers.

    Returns:
        Their names and the fits with them, in the order to try them, and the names of those that would have to be
        implausibly strong.
    """
    fits = {}
    for found, variant in ranking[:CONTENDERS]:
        if found.gain < CONTENDER * ranking[0][0].gain:
            break
        name = variant[0].effect
        progress(f"trying {name} beside {', '.join(fit.hypothesis.present) or 'nothing'}")
        fits[name] = fitted(search, search.with_candidate(fit.hypothesis, variant, found), whole=False)
    plausible = [name for name, richer in fits.items() if not implausible(richer.hypothesis, name)]
    if len(plausible) > 1:
        gains = {name: confirm(search, fit.hypothesis, fits[name].hypothesis).gain for name in plausible}
        plausible = [name for name in plausible if np.isfinite(gains[name])]
    stretched = set(fits) - set(plausible)
    if len(plausible) < 2:
        name = (plausible or list(fits))[-1]
        return [(name, fits[name])], stretched
    numbers = {variant[0].effect: len(variant) for _, variant in ranking}
    most = max(gains[name] for name in plausible)
    rivals = [name for name in plausible if _near(gains[name], most, CLOSE)]
    if len(rivals) > 1:
        # Innovations hardly tell a lag from a delay beside the unknown age of commands; half a second of flight does.
        errors = {name: _without_lead(search, fits[name].hypothesis) for name in rivals}
        rivals = [name for name in rivals if errors[name] <= min(errors.values()) + SAME_ERRORS]
    most = max(gains[name] for name in rivals)
    close = [name for name in rivals if _near(gains[name], most, PARSIMONY)]
    first = min(close, key=numbers.get)
    delayed = "command_delay"
    if first == SHIFT and fits[first].hypothesis.shift < 0 and delayed in plausible:
        # Commands logged early and commands that act late look the same unless rotor speeds were logged: the
        # physical cause comes first, and the report names both.
        first = delayed if gains[delayed] > (1 - CLOSE) * gains[first] else first
    order = sorted(plausible, key=lambda name: (name != first, -gains[name]))
    return [(name, fits[name]) for name in order], stretched


def _near(gain: float, most: float, share: float) -> bool:
    """Whether a gain is the largest but for a share; all may be negative, where fits do not converge."""
    return gain >= most - share * abs(most)


def _without_lead(search: Search, hypothesis: Hypothesis) -> float:
    """Mean logarithm of the prediction errors, commands held until the next row in the fit as in predictions.

    A delay is longer by what a lead takes back, and a lag that wants no lead would seem to predict better.
    Infinite where predictions diverge.
    """
    held = search.settled(replace(hypothesis, lead=0.0), lead_free=False)
    found = float(np.log(prediction_errors(search, held)).mean())
    return found if np.isfinite(found) else np.inf
