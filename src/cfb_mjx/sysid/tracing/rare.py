"""Effects that few blocks of the fit flights excite: fitted there all the same, kept if other flights bear them out.

What a drone rarely does in some flights (turning about the vertical, say) may be what others consist of. A search asks
for more than such flights can show: their few blocks are scattered like noise, or matter to no error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cfb_mjx.sysid.tracing.acceptance import implausible, lowered
from cfb_mjx.sysid.tracing.confirmation import confirm
from cfb_mjx.sysid.tracing.fits import Fit, completed, fitted, prediction_errors
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.trace import LARGEST, Trace, leave_out, rank, summary

LEAST_GAIN, LEAST_STATISTIC = 8.0, 2.0
"""Nats and statistic on blocks left out from which an effect is tried."""
TRIED = 2
"""Effects tried at most, the largest gain first."""
SURE = 4.0
"""Statistic on flights nothing was fitted to: beyond chance after a search through the catalogue."""


def with_rare(found: Trace, held_out: Search, progress: Callable[[str], None] = lambda _: None) -> Trace:
    """What was found, and rarely excited effects that held-out flights bear out.

    Args:
        found: what the search came to.
        held_out: over flights nothing is fitted to.
        progress: told what happens.
    """
    search, fit = found.search, found.fit
    before, tried, buys = fit.hypothesis, set(), {}
    while len(fit.hypothesis.present) < LARGEST:
        ranking = [
            (evidence, variant)
            for evidence, variant in rank(search, fit, tried)
            if evidence.gain > LEAST_GAIN and evidence.t > LEAST_STATISTIC
        ]
        if not ranking or len(tried) == TRIED:
            break
        evidence, variant = ranking[0]
        name = variant[0].effect
        tried.add(name)
        progress(f"trying {name} on the held-out flights")
        richer = fitted(search, search.with_candidate(fit.hypothesis, variant, evidence), whole=False)
        share = _share(held_out, fit, richer, name)
        if share is not None:
            fit, buys[name] = completed(search, richer), share
    if fit.hypothesis is before:
        return found
    kept = []
    for name in fit.hypothesis.present:
        item = summary(search, fit, name, leave_out(search, fit.hypothesis, name))
        kept.append(replace(item, buys=max(item.buys, buys.get(name, 0.0))))
    kept.sort(key=lambda item: (-item.lowers, -item.buys))
    return replace(found, hypothesis=fit.hypothesis, found=kept, errors=fit.errors, fit=fit)


def _share(held_out: Search, fit: Fit, richer: Fit, name: str) -> float | None:
    """Largest share by which an effect lowers an error of the held-out flights; None where it does not stand there."""
    if not np.isfinite(richer.errors).all() or implausible(richer.hypothesis, name):
        return None
    if confirm(held_out, fit.hypothesis, richer.hypothesis).t < SURE:
        return None
    pair = fit.hypothesis, richer.hypothesis
    old, new, first = (prediction_errors(held_out, each) for each in (*pair, held_out.nothing()))
    return float(np.max(1 - new / old)) if lowered(old, new, first) else None
