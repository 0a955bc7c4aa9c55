"""Products of inertia: the principal axes of inertia are not the body's axes.

    J_ij = relative_ij sqrt(J_i J_j),   J omega' = tau - omega x J omega with the whole tensor J

The cause is for example a battery that lies askew; it couples roll into yaw. tau is the torque of all forces except the
tension of a string and the forces of the floor.

`cfb close-loop` does not search for it: in a drone that lacks many effects it absorbs the residuals of several of them.
Name it to fit it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import INERTIAL, Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import vector
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits


class InertiaProducts(Effect):
    """J_ij = relative_ij sqrt(J_i J_j)."""

    name: ClassVar[str] = "inertia_products"
    meaning: ClassVar[str] = "the mass lies askew: the principal axes of inertia are not the body's axes"
    experiment: ClassVar[str] = "cfb excite roll-pitch: doublets about roll and pitch, and yaw turns both ways"
    units: ClassVar[dict[str, str]] = {"relative": "1"}
    source: ClassVar[str] = "J. L. Meriam, L. G. Kraige, Engineering Mechanics: Dynamics, sec. 7/7 and app. B"
    prior: ClassVar[dict[str, tuple[float, float]]] = {"relative": (-0.2, 0.2)}
    # Up to one half, any three values give a positive definite tensor.
    limits: ClassVar[dict[str, Limits]] = {"relative": Limits(-0.49, 0.49, -0.3, 0.3)}
    strengths: ClassVar[tuple[str, ...]] = ("relative",)
    rank: ClassVar[int] = INERTIAL
    searched: ClassVar[bool] = False

    relative: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))
    """Elements xy, xz and yz of the tensor, each divided by the geometric mean of its two moments."""

    @classmethod
    def neutral(cls) -> InertiaProducts:
        return cls(relative=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        parameters, omega = condition.parameters, condition.body_rate
        center, inertia = Vec.unstack(parameters.center_of_gravity), Vec.unstack(parameters.inertia)
        (x, y, z), share = inertia, Vec.unstack(self.relative)
        xy, xz, yz = share * Vec(jnp.sqrt(x * y), jnp.sqrt(x * z), jnp.sqrt(y * z))

        def across(turning: Vec) -> Vec:
            a, b, c = turning
            return Vec(xy * b + xz * c, xy * a + yz * c, xz * a + yz * b)

        about_center = wrench.torque - center.cross(wrench.force)
        left = about_center - omega.cross(inertia * omega + across(omega))
        rows = Vec(x, xy, xz), Vec(xy, y, yz), Vec(xz, yz, z)
        minors = rows[1].cross(rows[2]), rows[2].cross(rows[0]), rows[0].cross(rows[1])
        inverse_determinant = 1 / rows[0].dot(minors[0])
        turning = Vec(*(minor.dot(left) * inverse_determinant for minor in minors))
        # The body computes the diagonal part; add only the momentum of the products.
        return replace(wrench, torque=wrench.torque - across(turning) - omega.cross(across(omega)))
