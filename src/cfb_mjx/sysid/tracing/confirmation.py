"""Judging what a search found on flights it never saw."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from cfb_mjx.sysid.tracing.gram import driven_by, residual_blocks
from cfb_mjx.sysid.tracing.search import Hypothesis, Search
from cfb_mjx.sysid.tracing.whitening import Blocks, Signals, innovations, levels_from


@dataclass(frozen=True)
class Verdict:
    """How a richer hypothesis does beside a poorer one on held-out flights.

    Attributes:
        gain: drop of half the sum of squared innovations, nats.
        t: standard normal where the richer one explains nothing.
        p_value: one-sided.
    """

    gain: float
    t: float
    p_value: float


def confirm(search: Search, poorer: Hypothesis, richer: Hypothesis) -> Verdict:
    """Compare two fitted hypotheses on the flights of ``search``, at its noise levels."""
    levels = levels_from(jnp.asarray(search.levels), search.noise)
    score, power, noise, count = 0.0, 0.0, 0.0, 0
    for index in range(len(search.logs)):
        pair = [_residual(search, hypothesis, index) for hypothesis in (poorer, richer)]
        both = Signals(
            *(jnp.stack([getattr(p.signals, k) for p in pair], axis=-1) for k in ("quantity", "acceleration"))
        )
        e, _, _ = innovations(Blocks(both, pair[0].interval, pair[0].valid), levels)
        less, more = np.asarray(e[..., 0]), np.asarray(e[..., 1])
        said = less - more
        rz, zz = (np.sum(x * said, axis=(1, 2)) for x in (less, said))
        score, power = score + rz.sum(), power + zz.sum()
        noise += np.sum((rz - zz) ** 2)
        count += len(rz)
    t = score / np.sqrt(max(noise, power, 1e-30))
    return Verdict(float(score - 0.5 * power), float(t), float(norm.sf(t)))


def _residual(search: Search, hypothesis: Hypothesis, index: int) -> Blocks:
    flight = search.flights(hypothesis)[index]
    model = hypothesis.model(search.parameters)
    driven = driven_by(model, flight, hypothesis.lead)
    return residual_blocks(model, flight, driven, jnp.asarray(hypothesis.lead))
