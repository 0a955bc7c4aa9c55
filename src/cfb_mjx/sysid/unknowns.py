"""Which parameters a fit may change, and the unconstrained numbers it works with.

Every vector the optimiser sees is physical: positive quantities are logarithms, and the inertia is built from the three
second moments of its mass distribution, so that every possible rigid body can be reached and no impossible one.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.parameters import Parameters

UNITS = {
    "mass": "kg",
    "inertia_xx": "kg m^2",
    "inertia_yy": "kg m^2",
    "inertia_zz": "kg m^2",
    "rotor_inertia": "kg m^2",
    "motor_time_constant": "s",
    "motor_gain": "rad/s",
    "thrust_scale": "1",
    "torque_scale": "1",
    "cog_x": "m",
    "cog_y": "m",
}
"""Names a fit knows, with their units. Motor quantities are common factors of the four motors."""
GROUPS = {
    "inertia": ("inertia_xx", "inertia_yy", "inertia_zz"),
    "motor": ("motor_time_constant", "motor_gain"),
    "cog": ("cog_x", "cog_y"),
    "J_m": ("rotor_inertia",),
}
_AXES = ("inertia_xx", "inertia_yy", "inertia_zz")
_LENGTH = 0.01
"""Centre-of-gravity offsets are counted in cm, so that all unknowns are of order one."""


class Unknowns(eqx.Module):
    """The chosen names and the parameters they start from."""

    names: tuple[str, ...] = eqx.field(static=True)
    nominal: Parameters

    @property
    def start(self) -> Float[Array, "k"]:
        """The vector of the nominal parameters: zeros."""
        return jnp.zeros(len(self.names))

    def apply(self, vector: Float[Array, "k"]) -> Parameters:
        """Parameters at ``vector``; differentiable."""
        p, change = self.nominal, dict(zip(self.names, vector, strict=True))

        def factor(name):
            return jnp.exp(change.get(name, 0.0))

        free = [axis in change for axis in _AXES]
        if all(free):
            # Second moments a, b, c: J_xx = b + c and so on. One logarithm each.
            moments = 0.5 * jnp.sum(p.inertia) - p.inertia
            moments = moments * jnp.stack([factor(axis) for axis in _AXES])
            inertia = jnp.sum(moments) - moments
        else:
            inertia = p.inertia * jnp.stack([factor(axis) for axis in _AXES])
        cog = p.center_of_gravity + _LENGTH * jnp.stack(
            [jnp.asarray(change.get("cog_x", 0.0)), jnp.asarray(change.get("cog_y", 0.0)), jnp.asarray(0.0)]
        )
        return eqx.tree_at(
            lambda q: (
                q.mass,
                q.inertia,
                q.rotor_inertia,
                q.motor_time_constant,
                q.motor_gain,
                q.thrust_scale,
                q.torque_scale,
                q.center_of_gravity,
            ),
            p,
            (
                p.mass * factor("mass"),
                inertia,
                p.rotor_inertia * factor("rotor_inertia"),
                p.motor_time_constant * factor("motor_time_constant"),
                p.motor_gain * factor("motor_gain"),
                p.thrust_scale * factor("thrust_scale"),
                p.torque_scale * factor("torque_scale"),
                cog,
            ),
        )

    def values(self, vector: Float[Array, "k"]) -> Float[Array, "k"]:
        """The chosen quantities at ``vector``, SI (means over the motors); differentiable."""
        p = self.apply(vector)
        known = {
            "mass": p.mass,
            "inertia_xx": p.inertia[0],
            "inertia_yy": p.inertia[1],
            "inertia_zz": p.inertia[2],
            "rotor_inertia": p.rotor_inertia,
            "motor_time_constant": jnp.mean(p.motor_time_constant),
            "motor_gain": jnp.mean(p.motor_gain),
            "thrust_scale": jnp.mean(p.thrust_scale),
            "torque_scale": jnp.mean(p.torque_scale),
            "cog_x": p.center_of_gravity[0],
            "cog_y": p.center_of_gravity[1],
        }
        return jnp.stack([known[name] for name in self.names])

    def scale(self, vector: Float[Array, "k"]) -> np.ndarray:
        """(k,) what one unit of a relative change is in SI: the value itself, or a cm for offsets."""
        values = np.asarray(self.values(vector))
        return np.array([_LENGTH if n.startswith("cog") else v for n, v in zip(self.names, values, strict=True)])

    def slope(self, vector: Float[Array, "k"]) -> np.ndarray:
        """(k, k) derivative of the relative changes of the quantities by the vector."""
        return np.asarray(jax.jacfwd(self.values)(vector)) / self.scale(vector)[:, None]


def choose(request: str | tuple[str, ...], nominal: Parameters) -> Unknowns:
    """Unknowns from names and group names (``inertia``, ``motor``, ``cog``, ``J_m``), comma separated or as a tuple.

    Raises:
        CfbError: an unknown name, or nothing asked for.
    """
    parts = [part.strip() for part in (request.split(",") if isinstance(request, str) else request)]
    names: list[str] = []
    for part in parts:
        for name in GROUPS.get(part, (part,)):
            if name not in UNITS:
                known = ", ".join([*UNITS, *GROUPS])
                raise CfbError(f"--parameters {part}: not a parameter that can be fitted; choose from {known}.")
            if name not in names:
                names.append(name)
    if not names:
        raise CfbError("--parameters: name at least one parameter.")
    order = list(UNITS)
    return Unknowns(tuple(sorted(names, key=order.index)), nominal)
