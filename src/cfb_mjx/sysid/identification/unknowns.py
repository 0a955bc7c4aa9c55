"""Parameters that a fit may change, and their mapping to unknowns of the optimiser.

Every vector of unknowns is physically possible. Positive quantities are fitted as logarithms. The inertia is
parametrised by the second moments of the mass distribution, so every possible rigid body can be reached and no
impossible one, whichever axes are free.
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
from cfb_mjx.sysid.identification.solver import Bounds, bounded_one

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
"""Parameters that can be fitted, with their units. Motor quantities are common to the four motors. ``thrust_linear`` is
the coefficient of s in the thrust cubic; with ``thrust_scale`` it determines level and slope of the thrust near hover.
``command_hold`` is a property of the log, not of the drone (`Unknowns.hold`)."""
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
"""Quantities that may be zero, with the additive change per unit of the optimiser's unknown; the others change by a
factor."""
_AXES = GROUPS["inertia"]
HOLD = 0.002
"""Initial value of the time for which a logged command acts, s: the firmware's rate loop runs at 500 Hz."""
_FACTORS = ("mass", "rotor_inertia", "motor_time_constant", "motor_gain", "thrust_scale", "torque_scale")


class Unknowns(eqx.Module):
    """The chosen parameters, and the mapping from a vector of unknowns to their values."""

    names: tuple[str, ...] = eqx.field(static=True)
    nominal: Parameters
    """Parameters at the zero vector."""
    # Explicit dtype: with a weakly typed number every program of a fit would be compiled twice.
    timed: Float[Array, ""] = eqx.field(converter=partial(jnp.asarray, dtype=float), default=0.0)
    """1 if every command acts until the next row, regardless of ``command_hold``."""

    @property
    def start(self) -> Float[Array, " k"]:
        """The vector of the nominal parameters, which is zero."""
        return jnp.zeros(len(self.names))

    def apply(self, vector: Float[Array, " k"]) -> Parameters:
        """Parameters of the drone at ``vector``; differentiable."""
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
        """Time for which a logged command acts, s; infinite if until the next row; None if it is not fitted."""
        if "command_hold" not in self.names:
            return None
        return jnp.where(self.timed > 0, jnp.inf, self._hold(vector))

    def bounds(self, interval: float) -> Bounds:
        """Smallest and largest vector: a command acts for -0.5 to 1.5 intervals between rows, s.

        Beyond 0 to 1 only so that an estimate near them is not pushed to one side.
        """
        ends = ((share * interval - HOLD) / OFFSETS["command_hold"] for share in (-0.5, 1.5))
        return bounded_one(len(self.names), self.names.index("command_hold"), *ends)

    def _hold(self, vector):
        return HOLD + OFFSETS["command_hold"] * vector[self.names.index("command_hold")]

    def values(self, vector: Float[Array, " k"]) -> Float[Array, " k"]:
        """Values (k,) of the chosen quantities at ``vector``, SI (means over the motors); differentiable."""
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
        """Size (k,) of one unit of relative change, SI: the value itself, or the unit in `OFFSETS`."""
        values = np.asarray(self.values(vector))
        return np.array([OFFSETS.get(name, value) for name, value in zip(self.names, values, strict=True)])

    def slope(self, vector: Float[Array, " k"]) -> np.ndarray:
        """Derivatives (k, k) of the quantities' relative changes with respect to the vector."""
        return np.asarray(jax.jacfwd(self.values)(vector)) / self.scale(vector)[:, None]


def _inertia(nominal: Float[Array, "3"], change: tuple[Array | None, ...]) -> Float[Array, "3"]:
    """Principal inertia with the free axes changed and the other axes fixed; always physically possible.

    With the second moments m of the mass about the three coordinate planes, J_xx = m_y + m_z etc. A body is possible if
    no m is negative.

    Args:
        nominal: (3,) kg m^2.
        change: unknown of each axis; None for a fixed axis.
    """
    # The lower bound is for a flat plate, whose zero moment could not be changed by a factor.
    moments = jnp.maximum(0.5 * jnp.sum(nominal) - nominal, 1e-6 * jnp.sum(nominal))
    free = [i for i in range(3) if change[i] is not None]
    if not free:
        return nominal
    if len(free) == 3:
        moments = moments * jnp.exp(jnp.stack([not_none(x) for x in change]))
    elif len(free) == 2:
        # The fixed axis k determines m_i + m_j. The ratio of these two is one unknown, m_k the other. The unknowns are
        # rotated so that each mainly changes its own axis.
        i, j = free
        k = 3 - i - j
        own, other = not_none(change[i]), not_none(change[j])
        split, rest = other - own, own + other
        share = jax.nn.sigmoid(jnp.log(moments[i] / moments[j]) + split)
        moments = moments.at[i].set(nominal[k] * share).at[j].set(nominal[k] * (1 - share))
        moments = moments.at[k].multiply(jnp.exp(rest))
    else:
        # J_j and J_k are fixed: m_k = J_j - m_i and m_j = J_k - m_i, so J_i = J_j + J_k - 2 m_i with m_i in (0, min).
        i = free[0]
        j, k = (n for n in range(3) if n != i)
        most = jnp.minimum(nominal[j], nominal[k])
        own = most * jax.nn.sigmoid(jnp.log(moments[i] / (most - moments[i])) - not_none(change[i]))
        moments = moments.at[i].set(own).at[j].set(nominal[k] - own).at[k].set(nominal[j] - own)
    return jnp.sum(moments) - moments


BORDER = 0.01
"""An inertia is at the border of the possible if a second moment of the mass is below this share of their sum."""


def at_the_border(parameters: Parameters) -> dict[str, str]:
    """Parameters without a meaningful estimate, with the reason, if the inertia is at the border of the possible.

    Otherwise the result is empty. Yaw determines J_zz, J_m and the torque scale only as ratios, so these are included.
    """
    inertia = np.asarray(parameters.inertia)
    worst = int(np.argmax(inertia))
    if 0.5 * inertia.sum() - inertia[worst] > BORDER * 0.5 * inertia.sum():
        return {}
    others = [axis for i, axis in enumerate(_AXES) if i != worst]
    reason = (
        f"these flights require {_AXES[worst]} > {others[0]} + {others[1]}, which no rigid body has: another torque on "
        "the drone is missing in the model"
    )
    return dict.fromkeys((*_AXES, "rotor_inertia", "torque_scale"), reason)


def choose(request: str | tuple[str, ...], nominal: Parameters) -> Unknowns:
    """Create the unknowns of a fit from names of parameters.

    Args:
        request: names of parameters (`UNITS`) and of groups (`GROUPS`), comma-separated or as a tuple.
        nominal: parameters to start from.

    Raises:
        CfbError: a name is unknown, or there is none.
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
