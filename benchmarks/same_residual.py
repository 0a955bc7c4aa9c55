"""The residuals the library minimises, as functions other optimisers can call.

The only place outside the library that reaches into `cfb_mjx.sysid`'s private functions: a comparison of optimisers on
*the same* residual cannot do without. Each function returns a `Problem`.
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
from cfb_mjx.sysid.identification import fitting, flight_data, shooting, shooting_data
from cfb_mjx.sysid.identification.solver import RIDGE
from cfb_mjx.sysid.identification.unknowns import Unknowns, choose


@dataclass(frozen=True)
class Problem:
    """A least-squares problem of the library."""

    unknowns: Unknowns
    residual: Callable[[np.ndarray], np.ndarray]
    """Compiled: the optimiser's vector to all residuals, flat NumPy."""
    solve: Callable[..., np.ndarray]
    """A solver of optimistix (none: the library's own) on this residual, compiled, from the start."""


def of_shooting(logs: list[FlightLog], nominal: Parameters, names, use_measured: bool = True) -> Problem:
    """Multiple shooting from the measured starts, whose weights are constant."""
    unknowns, body = choose(names, nominal), RigidBody()
    data = shooting_data.batches(logs, None, float(nominal.pose_delay), use_measured)
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


def of_innovations(logs: list[FlightLog], found: fitting.Fit, nominal: Parameters) -> Problem:
    """Whitened innovations with the noise levels of a finished fit held fixed."""
    unknowns = choose(found.names, nominal)
    segments = jax.tree.map(jnp.asarray, flight_data.prepare(list(logs)).segments)

    @eqx.filter_jit
    def residual(vector, noise, segments):
        return fitting._residual(vector, unknowns, noise, segments, True, False).ravel()

    return Problem(
        unknowns,
        lambda x: np.asarray(residual(jnp.asarray(x), found.noise, segments)),
        lambda solver=None: np.asarray(
            fitting._fit_vector(unknowns, unknowns.start, found.noise, segments, True, False, RIDGE, solver)
        ),
    )


def by_scipy(residual: Callable[[np.ndarray], np.ndarray], start: np.ndarray) -> dict:
    """`scipy.optimize.least_squares` with its defaults: 2-point differences, trust region, tolerances 1e-8."""
    calls = [0]

    def counted(x):
        calls[0] += 1
        return residual(x)

    begin = time.perf_counter()
    found = least_squares(counted, np.asarray(start))
    seconds = time.perf_counter() - begin
    return {"seconds": seconds, "evaluations": calls[0], "x": found.x, "jac": found.jac, "status": found.status}


def timed(function: Callable[[], object]) -> tuple[object, float]:
    """What it returned, and how long it took, s."""
    begin = time.perf_counter()
    result = function()
    return result, time.perf_counter() - begin
