"""Residuals against the signals of a formula's terms, which are products of what drives a drone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cfb_mjx.model.effects.fields import HOVER_SPEED
from cfb_mjx.sysid.tracing.formula import Term
from cfb_mjx.sysid.tracing.structure import Pooled
from cfb_mjx.view.closing_figures import Panel


def panels_of(terms: list[Term], before: Pooled, after: Pooled, most: int) -> list[Panel]:
    """One panel for each of the first terms: its axis against its signal.

    Args:
        terms: of a formula; constants follow nothing and have no panel.
        before: residuals without them.
        after: with them.
        most: panels.
    """
    found = []
    for term in [term for term in terms if term.signal != "1"][:most]:
        name = term.signal
        pair = [replace(p, drivers=p.drivers | {name: signal_of(name, p.drivers)}) for p in (before, after)]
        found.append(Panel(_axis(term, before), name, *pair))
    return found


def signal_of(name: str, drivers: dict[str, np.ndarray]) -> np.ndarray:
    """A signal of the formulas' library (`cfb_mjx.model.effects.formula`), from the drivers of residuals (N,)."""
    known = {f"v_{a}": drivers[f"velocity {a}"] for a in "xyz"} | {f"w_{a}": drivers[f"rate {a}"] for a in "xyz"}
    known |= {f"n_{key}": drivers[f"rotor {key}"] / HOVER_SPEED for key in ("roll", "pitch", "yaw")}
    known |= {"n": drivers["rotor mean"] / HOVER_SPEED - 1, "1": np.ones_like(drivers["time"])}
    known |= {"x": drivers["position x"], "y": drivers["position y"], "z": drivers["height"]}
    known["|v|"] = np.linalg.norm([known[f"v_{a}"] for a in "xyz"], axis=0)
    factors = [known[part.removesuffix("^2")] ** (1 + part.endswith("^2")) for part in name.split()]
    return np.prod(factors, axis=0)


def _axis(term: Term, pooled: Pooled) -> str:
    """The residual axis of a term: for the world's vertical that of the body, which stands upright while it hovers."""
    name = term.axis.replace("_", " ")
    return name if name in pooled.axes else name.removeprefix("world ")
