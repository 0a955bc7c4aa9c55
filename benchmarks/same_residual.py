"""The residuals that the library minimises, as functions for other optimisers.

This is the only module outside the library that uses private functions of `cfb_mjx.sysid`: a comparison of optimisers
on the same residual needs them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from cfb_mjx.logs import FlightLog
from cfb_mjx.model.bodies import RigidBody
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification import Fit, flight_data, likelihood, shooting
from cfb_mjx.sysid.identification.solver import RIDGE
from cfb_mjx.sysid.identification.unknowns import Unknowns, choose


@dataclass(frozen=True)
class Problem:
    """A least-squares problem of the library."""

    unknowns: Unknowns
    residual: Callable[[np.ndarray], np.ndarray]
    """Compiled function from the optimiser's vector to all residuals, a flat NumPy array."""
    solve: Callable[..., np.ndarray]
    """Minimise this residual from the start with a solver of optimistix (none: the library's own), compiled."""


def of_shooting(logs: list[FlightLog], nominal: Parameters, names, use_measured: bool = True) -> Problem:
    """Return the problem of multiple shooting from measured starts, with constant weights."""
    unknowns, body = choose(names, nominal), RigidBody()
    data = shooting.batches(logs, None, float(nominal.pose_delay), use_measured)
    whiten = shooting._whitening(unknowns, unknowns.start, data, body, False)

    @eqx.filter_jit
    def residual(vector, data, whiten):
        parts = shooting._residual(vector, unknowns, data, body, whiten, False)
        return jnp.concatenate([part.ravel() for part in parts])

    return Problem(
        unknowns,
        lambda x: np.asarray(residual(jnp.asarray(x), data, whiten)),
        lambda solver=None: np.asarray(shooting._solve(unknowns, unknowns.start, data, body, whiten, False, solver)),
    )


def of_innovations(logs: list[FlightLog], found: Fit, nominal: Parameters) -> Problem:
    """Return the problem of whitened innovations, with the noise levels of a finished fit."""
    unknowns = choose(found.names, nominal)
    whole = flight_data.prepare(list(logs)).segments
    segments, parts = jax.tree.map(jnp.asarray, whole), flight_data.parts(whole)

    @eqx.filter_jit
    def residual(vector, noise, segments):
        return likelihood._residual(vector, unknowns, noise, segments, True, False).ravel()

    return Problem(
        unknowns,
        lambda x: np.asarray(residual(jnp.asarray(x), found.noise, segments)),
        lambda solver=None: np.asarray(
            likelihood._fit_vector(
                unknowns, unknowns.start, found.noise, parts, True, False, likelihood.Prior(RIDGE), solver
            )
        ),
    )


def by_scipy(residual: Callable[[np.ndarray], np.ndarray], start: np.ndarray) -> dict:
    """Minimise with the defaults of `scipy.optimize.least_squares` (2-point differences, trust region, 1e-8)."""
    calls = [0]

    def counted(x):
        calls[0] += 1
        return residual(x)

    begin = time.perf_counter()
    found = least_squares(counted, np.asarray(start))
    seconds = time.perf_counter() - begin
    return {"seconds": seconds, "evaluations": calls[0], "x": found.x, "jac": found.jac, "status": found.status}


def timed(function: Callable[[], object]) -> tuple[object, float]:
    """Call ``function``; return its result and the time, s."""
    begin = time.perf_counter()
    result = function()
    return result, time.perf_counter() - begin
