"""Gusts: a random velocity of the air, the same everywhere, with the spectrum of a first-order Gauss-Markov process.

    one-sided spectrum of axis k:  intensity_k^2 (2 / pi) time_scale / (1 + (time_scale w)^2),  w in rad/s
    autocorrelation:               intensity_k^2 exp(-|t| / time_scale)

This is the Dryden spectrum (MIL-F-8785C) of the gust along the wind, with time_scale = L / V for a length scale L and
an airspeed V. Near the ground L is about the height, and the vertical intensity a tenth of the mean wind. The gust is a
sum of `HARMONICS` cosines of equal variance, one from each quantile of the spectrum, with frequencies and phases given
by the ``seed``. It is a function of time, so that every integrator, step and machine flies through the same air. Every
whole number gives another gust; over many of them the autocorrelation is the one above within 0.04 intensity^2. The
memory holds the time since the flight began and the gust, which is constant during a step.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Memory
from cfb_mjx.model.effects.fields import number, vector
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters

HARMONICS = 12
"""Number of cosines per axis."""
# The share of the variance below w is (2 / pi) atan(time_scale w). The last quantile is unbounded: cut at 3 times its
# lower edge.
_EDGES = np.tan(np.pi / 2 * np.arange(HARMONICS) / HARMONICS)
_SPANS = np.diff(_EDGES, append=3 * _EDGES[-1])
# Frequencies and phases: their values for seed 0, and how far each moves from one seed to the next.
_FIRST, _STEPS = np.random.default_rng(0).uniform(size=(2, 2, 3, HARMONICS)).round(4)


class Gust(Effect):
    """Velocity of the air with autocorrelation intensity^2 exp(-|t| / time_scale)."""

    name: ClassVar[str] = "gust"
    meaning: ClassVar[str] = "the velocity of the air varies randomly about its mean"
    experiment: ClassVar[str] = "minutes of hover, outdoors or before a fan, and the same indoors"
    units: ClassVar[dict[str, str]] = {"intensity": "m/s", "time_scale": "s", "seed": "1"}
    source: ClassVar[str] = (
        "MIL-F-8785C, 1980, 3.7 (Dryden, low altitude); M. Shinozuka, G. Deodatis, Simulation of stochastic processes "
        "by spectral representation, Appl. Mech. Rev. 44(4), 1991"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "intensity": (0.0, 2.0),
        "time_scale": (0.2, 10.0),
        "seed": (0.0, 100.0),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "intensity": Limits(0.0, 30.0, 0.0, 5.0),
        "time_scale": Limits(1e-3, 1e4, 0.05, 100.0),
        "seed": Limits(0.0, 1e6, 0.0, 1e6),
    }
    strengths: ClassVar[tuple[str, ...]] = ("intensity",)
    searched: ClassVar[bool] = False
    assumed: ClassVar[tuple[str, ...]] = ("seed",)

    intensity: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))
    """Standard deviation along the world's axes."""
    time_scale: Float[Array, "*batch"] = eqx.field(converter=number, default=1.0)
    """Correlation time of the gust."""
    seed: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0)
    """Number of the gust; a whole number."""

    @classmethod
    def neutral(cls) -> Gust:
        return cls(intensity=0.0)

    def at(self, time: Any) -> Vec:
        """Velocity of the air, world, ``time`` seconds after the flight began."""
        scaled = time / self.time_scale

        def drawn(which, axis, k):
            turns = float(_FIRST[which, axis, k]) + float(_STEPS[which, axis, k]) * self.seed
            return turns - jnp.floor(turns)

        def wave(axis, k):
            rate = float(_EDGES[k]) + float(_SPANS[k]) * drawn(0, axis, k)
            return jnp.cos(rate * scaled + 2 * np.pi * drawn(1, axis, k))

        size = Vec.unstack(self.intensity) * (2 / HARMONICS) ** 0.5
        return size * Vec(*(sum(wave(axis, k) for k in range(HARMONICS)) for axis in range(3)))

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        time = jnp.zeros_like(rotor_speed[0])
        return Vec(time), self.at(time)

    def air(self, condition: Condition) -> Vec:
        return condition.memory[1]

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        ((time,), _) = condition.memory
        return Vec(time + dt), self.at(time + dt)
