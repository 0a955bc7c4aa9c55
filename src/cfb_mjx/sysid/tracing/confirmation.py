"""Judging what a search found on flights it never saw."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from cfb_mjx.sysid.flight import Flight, prepare_flight
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.whitening import Blocks, Signals, innovations, levels_from


@dataclass(frozen=True)
class Verdict:
    """How a richer hypothesis does beside a poorer one on held-out flights.

    Attributes:
        gain: drop of half the sum of squared innovations, nats; None where predictions judged.
        t: standard normal where the richer one explains nothing.
        p_value: one-sided.
    """

    gain: float | None
    t: float
    p_value: float


def confirm(search: Search, poorer: Hypothesis, richer: Hypothesis) -> Verdict:
    """Compare two fitted hypotheses on the flights of ``search``, at the noise levels of the poorer one."""
    levels = levels_from(jnp.asarray(poorer.levels), search.noise)
    score, power, noise = 0.0, 0.0, 0.0
    for less, more in _flights(search, poorer, richer):
        pair = search.residual(poorer, less)[0], search.residual(richer, more)[0]
        both = Signals(
            *(jnp.stack([getattr(p.signals, k) for p in pair], axis=-1) for k in ("quantity", "acceleration"))
        )
        e, _, _ = innovations(Blocks(both, pair[0].interval, pair[0].valid), levels)
        left, said = np.asarray(e[..., 0]), np.asarray(e[..., 0] - e[..., 1])
        rz, zz = (np.sum(x * said, axis=(1, 2)) for x in (left, said))
        score, power = score + rz.sum(), power + zz.sum()
        noise += np.sum((rz - zz) ** 2)
    t = score / np.sqrt(max(noise, power, 1e-30))
    return Verdict(float(score - 0.5 * power), float(t), float(norm.sf(t)))


def _flights(search: Search, poorer: Hypothesis, richer: Hypothesis) -> Iterator[tuple[Flight, Flight]]:
    """Every flight as both read it, row by row: a shift of the motor columns costs rows at the ends and at gaps."""
    if poorer.shift == richer.shift:
        yield from zip(search.flights(poorer), search.flights(richer), strict=True)
        return
    for log in search.logs:
        logs = [hypothesis.faults.repaired(log) for hypothesis in (poorer, richer)]
        both = np.intersect1d(logs[0].time, logs[1].time)
        yield tuple(prepare_flight(one.rows(np.isin(one.time, both)), *search.delays) for one in logs)
