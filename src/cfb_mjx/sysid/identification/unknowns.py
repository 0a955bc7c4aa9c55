"""Which parameters a fit may change, and the unconstrained numbers it works with.

Every vector the optimiser sees is physical: positive quantities are logarithms, and the inertia is built from the
second moments of its mass distribution, whichever of its axes are free: every possible rigid body can be reached and
no impossible one.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Parameters

UNITS = {
    "mass": "kg",
    "inertia_xx": "kg m^2",
    "inertia_yy": "kg m^2",
    "inertia_zz": "kg m^2",
    "rotor_inertia": "kg m^2",
    "motor_time_constant": "s",
    "motor_gain": "rad/s",
    "motor_speed_offset": "rad/s",
    "thrust_scale": "1",
    "thrust_linear": "N",
    "torque_scale": "1",
    "cog_x": "m",
    "cog_y": "m",
    "pose_delay": "s",
    "command_hold": "s",
}
"""Names a fit knows, with their units. Motor quantities are common to the four motors; ``thrust_linear`` is the
coefficient of s in the thrust cubic: with ``thrust_scale`` it sets level and slope of the thrust near hover.
``command_hold`` is no constant of the drone but of its log, see `Unknowns.hold`."""
GROUPS = {
    "inertia": ("inertia_xx", "inertia_yy", "inertia_zz"),
    "motor": ("motor_time_constant", "motor_gain"),
    "cog": ("cog_x", "cog_y"),
    "J_m": ("rotor_inertia",),
    "observation_delay": ("pose_delay",),
}
OFFSETS = {
    "motor_speed_offset": 200.0,
    "thrust_linear": 0.05,
    "cog_x": 0.01,
    "cog_y": 0.01,
    "pose_delay": 0.004,
    "command_hold": 0.002,
}
"""Quantities that may be zero: changed by so much, not by a factor, for one unit of the optimiser's number."""
_AXES = ("inertia_xx", "inertia_yy", "inertia_zz")
HOLD = 0.002
"""How long a logged command acts where nothing else is known, s: the firmware's rate loop runs at 500 Hz."""
_FACTORS = ("mass", "rotor_inertia", "motor_time_constant", "motor_gain", "thrust_scale", "torque_scale")


class Unknowns(eqx.Module):
    """The chosen names and the parameters they start from."""

    names: tuple[str, ...] = eqx.field(static=True)
    nominal: Parameters
    # An explicit type: a weakly typed number would compile every program of a fit twice.
    timed: Float[Array, ""] = eqx.field(converter=partial(jnp.asarray, dtype=float), default=0.0)
    """1 where every command acts until the next row, whatever ``command_hold`` says."""

    @property
    def start(self) -> Float[Array, " k"]:
        """The vector of the nominal parameters: zeros."""
        return jnp.zeros(len(self.names))

    def apply(self, vector: Float[Array, " k"]) -> Parameters:
        """Parameters at ``vector``; differentiable."""
        p, change = self.nominal, dict(zip(self.names, vector, strict=True))
        factors = tuple(getattr(p, name) * jnp.exp(change.get(name, 0.0)) for name in _FACTORS)
        inertia = _inertia(p.inertia, tuple(change.get(axis) for axis in _AXES))
        moved = {name: size * change[name] for name, size in OFFSETS.items() if name in change}
        cog = [jnp.asarray(moved.get(name, 0.0)) for name in ("cog_x", "cog_y")]
        return eqx.tree_at(
            lambda q: (
                *(getattr(q, name) for name in _FACTORS),
                q.inertia,
                q.center_of_gravity,
                q.motor_speed_offset,
                q.thrust_polynomial,
                q.pose_delay,
            ),
            p,
            (
                *factors,
                inertia,
                p.center_of_gravity + jnp.stack([*cog, jnp.zeros(())]),
                p.motor_speed_offset + moved.get("motor_speed_offset", 0.0),
                p.thrust_polynomial + jnp.stack([0.0, 0.0, moved.get("thrust_linear", 0.0)]),
                p.pose_delay + moved.get("pose_delay", 0.0),
            ),
        )

    def hold(self, vector: Float[Array, " k"]) -> Float[Array, ""] | None:
        """How long a logged command acts before the next one that was sent, s; infinite where until the next row.

        None where that is not fitted.
        """
        if "command_hold" not in self.names:
            return None
        return jnp.where(self.timed > 0, jnp.inf, self._hold(vector))

    def _hold(self, vector):
        return HOLD + OFFSETS["command_hold"] * vector[self.names.index("command_hold")]

    def values(self, vector: Float[Array, " k"]) -> Float[Array, " k"]:
        """The chosen quantities at ``vector``, SI (means over the motors); differentiable."""
        p = self.apply(vector)
        known = {
            **{name: jnp.mean(getattr(p, name)) for name in (*_FACTORS, "motor_speed_offset", "pose_delay")},
            **{axis: p.inertia[i] for i, axis in enumerate(_AXES)},
            "thrust_linear": p.thrust_polynomial[2],
            "cog_x": p.center_of_gravity[0],
            "cog_y": p.center_of_gravity[1],
            "command_hold": self._hold(vector) if "command_hold" in self.names else None,
        }
        return jnp.stack([known[name] for name in self.names])

    def scale(self, vector: Float[Array, " k"]) -> np.ndarray:
        """(k,) what one unit of a relative change is in SI: the value itself, or the unit of `OFFSETS`."""
        values = np.asarray(self.values(vector))
        return np.array([OFFSETS.get(name, value) for name, value in zip(self.names, values, strict=True)])

    def slope(self, vector: Float[Array, " k"]) -> np.ndarray:
        """(k, k) derivative of the relative changes of the quantities by the vector."""
        return np.asarray(jax.jacfwd(self.values)(vector)) / self.scale(vector)[:, None]


def _inertia(nominal: Float[Array, "3"], change: tuple[Array | None, ...]) -> Float[Array, "3"]:
    """Principal inertia whose free axes (those with a change) moved, and whose other axes stayed, always possible.

    With m the second moments of the mass about the three coordinate planes, J_xx = m_y + m_z and so on; a body is
    possible when no m is negative.
    """
    # A flat plate has a moment of zero, which no factor could change.
    moments = jnp.maximum(0.5 * jnp.sum(nominal) - nominal, 1e-6 * jnp.sum(nominal))
    free = [i for i in range(3) if change[i] is not None]
    if not free:
        return nominal
    if len(free) == 3:
        moments = moments * jnp.exp(jnp.stack([not_none(x) for x in change]))
    elif len(free) == 2:
        # The fixed axis k holds m_i + m_j: the ratio of these two is one unknown, m_k the other. The unknowns are
        # turned so that each moves its own axis first.
        i, j = free
        k = 3 - i - j
        own, other = not_none(change[i]), not_none(change[j])
        split, rest = other - own, own + other
        share = jax.nn.sigmoid(jnp.log(moments[i] / moments[j]) + split)
        moments = moments.at[i].set(nominal[k] * share).at[j].set(nominal[k] * (1 - share))
        moments = moments.at[k].multiply(jnp.exp(rest))
    else:
        # J_j and J_k stay: m_k = J_j - m_i and m_j = J_k - m_i, so J_i = J_j + J_k - 2 m_i with m_i in (0, min).
        i = free[0]
        j, k = (n for n in range(3) if n != i)
        most = jnp.minimum(nominal[j], nominal[k])
        own = most * jax.nn.sigmoid(jnp.log(moments[i] / (most - moments[i])) - not_none(change[i]))
        moments = moments.at[i].set(own).at[j].set(nominal[k] - own).at[k].set(nominal[j] - own)
    return jnp.sum(moments) - moments


BORDER = 0.01
"""A second moment of the mass below this share of their sum is at the border of what a rigid body can be."""


def at_the_border(parameters: Parameters) -> dict[str, str]:
    """What no number can be given of an inertia that only the possibility of the body stopped, with the reason.

    Empty for a body well inside. Yaw tells J_zz, J_m and the torque scale as ratios, so these go together.
    """
    inertia = np.asarray(parameters.inertia)
    worst = int(np.argmax(inertia))
    if 0.5 * inertia.sum() - inertia[worst] > BORDER * 0.5 * inertia.sum():
        return {}
    others = [axis for i, axis in enumerate(_AXES) if i != worst]
    reason = (
        f"these flights ask for {_AXES[worst]} > {others[0]} + {others[1]}, which no rigid body has: something "
        "else that turns the drone is not in the model"
    )
    return dict.fromkeys((*_AXES, "rotor_inertia", "torque_scale"), reason)


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
