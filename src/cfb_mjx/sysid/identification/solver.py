"""The one nonlinear least-squares solver of the fits."""

from __future__ import annotations

from collections.abc import Callable

import lineax as lx
import optimistix as optx
from jaxtyping import Array, Float, PyTree

RIDGE = 0.1
"""Every unknown has a prior of 1 / RIDGE = 10 units about the preset (a factor of e^10): far too wide to matter where
data say anything, and enough to keep the normal equations regular where they say nothing."""


def least_squares(residual: Callable[[Array], PyTree], start: Float[Array, "k"]) -> Float[Array, "k"]:
    """Levenberg-Marquardt from ``start``; forward-mode Jacobian, for few unknowns and many residuals.

    Normal equations, not QR: with k of about ten and residuals by the hundred thousand they are what costs, and the
    uncertainty, which condition numbers would spoil, is computed elsewhere by QR (`uncertainty`).
    """
    solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6, linear_solver=lx.Normal(lx.Cholesky()))

    def whole(x, _):
        return residual(x), RIDGE * x

    return optx.least_squares(whole, solver, start, options={"jac": "fwd"}, max_steps=60, throw=False).value
