"""A formula for the residual of flights that no known effect explains: a sum of products of signals.

Torque and force along each body axis are linear combinations of a fixed library of signals. Forces that depend on the
place (a tether, a wall) are combinations along the world's axes. The coefficients are found by sparse regression
(`cfb_mjx.sysid.tracing.formula`) and printed with their units. A formula is a description, not an explanation.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import HOVER_SPEED, number
from cfb_mjx.model.rotors import TORQUE_SIGNS
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters.parameters import Limits

_V, _W, _P = ("v_x", "v_y", "v_z"), ("w_x", "w_y", "w_z"), ("x", "y", "z")
_SPEEDS = ("n", "n_roll", "n_pitch", "n_yaw")
TERMS: dict[str, str] = (
    {"1": "1"}
    | {v: "m/s" for v in _V}
    | {f"|v| {v}": "m^2/s^2" for v in _V}
    | {w: "rad/s" for w in _W}
    | {"w_y w_z": "rad^2/s^2", "w_z w_x": "rad^2/s^2", "w_x w_y": "rad^2/s^2"}
    | {f"{v} {w}": "m rad/s^2" for v in _V for w in _W}
    | {n: "1" for n in _SPEEDS}
    | {
        "n_roll^2": "1",
        "n_pitch^2": "1",
        "n_yaw^2": "1",
        "n_roll n_pitch": "1",
        "n_roll n_yaw": "1",
        "n_pitch n_yaw": "1",
    }
    | {p: "m" for p in _P}
)
"""Signals along the body's axes, with units: velocity v and rate w in body axes, rotor speeds n relative to hover (mean
above hover, and the patterns that roll, pitch and yaw the drone), position in the world."""
PLACES: dict[str, str] = {"1": "1"} | {p: "m" for p in _P} | {f"{p}^2": "m^2" for p in _P}
"""Signals of the forces along the world's axes, with units."""
AXES = ("torque_x", "torque_y", "torque_z", "force_x", "force_y", "force_z")


def _matrix(shape: tuple[int, int]):
    def convert(value) -> Array:
        value = number(value)
        return value if value.ndim >= 2 else value * np.ones(shape)

    return convert


class ResidualFormula(Effect):
    """torque_i = sum_j body[i, j] term_j; force_i likewise, plus R^T (sum_j place[:, j] place_j)."""

    name: ClassVar[str] = "residual_formula"
    units: ClassVar[dict[str, str]] = {"body_terms": "N m or N per unit of the term", "place": "N per unit of the term"}
    source: ClassVar[str] = "regression on the residual of flights; no physics claimed"
    prior: ClassVar[dict[str, tuple[float, float]]] = {"body_terms": (-1.0, 1.0), "place": (-1.0, 1.0)}
    limits: ClassVar[dict[str, Limits]] = {
        "body_terms": Limits(-1000.0, 1000.0, -10.0, 10.0),
        "place": Limits(-1000.0, 1000.0, -10.0, 10.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("body_terms", "place")

    body_terms: Float[Array, "*batch 6 n"] = eqx.field(converter=_matrix((6, len(TERMS))))
    place: Float[Array, "*batch 3 m"] = eqx.field(converter=_matrix((3, len(PLACES))))

    @classmethod
    def neutral(cls) -> ResidualFormula:
        return cls(body_terms=0.0, place=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        signals = list(body_signals(condition))
        rows = [sum(self.body_terms[..., i, j] * s for j, s in enumerate(signals)) for i in range(6)]
        places = list(place_signals(condition))
        pull = Vec(*(sum(self.place[..., i, j] * s for j, s in enumerate(places)) for i in range(3)))
        force = Vec(*rows[3:]) + rotate_inverse(condition.quaternion, pull)
        return Wrench(wrench.force + force, wrench.torque + Vec(*rows[:3]))


def body_signals(condition: Condition):
    """Values of `TERMS`, in their order."""
    v, w, p = condition.velocity_body, condition.body_rate, condition.position
    speed = condition.rotor_speed * (1 / HOVER_SPEED)
    roll, pitch, yaw = (0.25 * speed.dot(signs) for signs in TORQUE_SIGNS)
    size = (v.dot(v) + 1e-12) ** 0.5
    yield 1.0 + 0.0 * size
    yield from v
    yield from (size * x for x in v)
    yield from w
    yield from (w[1] * w[2], w[2] * w[0], w[0] * w[1])
    yield from (a * b for a in v for b in w)
    yield from (0.25 * speed.sum() - 1.0, roll, pitch, yaw)
    yield from (roll * roll, pitch * pitch, yaw * yaw, roll * pitch, roll * yaw, pitch * yaw)
    yield from p


def place_signals(condition: Condition):
    """Values of `PLACES`, in their order."""
    p = condition.position
    yield 1.0 + 0.0 * p[0]
    yield from p
    yield from (x * x for x in p)
