"""D-optimal design of an open-loop manoeuvre: the most informative one about chosen parameters within limits.

Starting from a known manoeuvre, the commands of every motor are changed by one free variable per `KNOT` seconds, mapped
to the allowed range by a sigmoid. Adam maximises the log determinant of the information, differentiated through filter
and simulator, minus penalties for exceeding the limits. Several starts are optimised at once, because there are many
local optima. Finally, the limits are enforced by a hard check.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State
from cfb_mjx.sysid.excitation.information import log_determinant, per_relative_change, window_information
from cfb_mjx.sysid.excitation.manoeuvres import (
    MARGIN,
    STEP,
    Limits,
    all_axes,
    demand,
    flown,
    hovering,
    multisine,
    roll_pitch,
    rows,
    scaled,
    single_motor,
    stepped,
    worst,
)
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.unknowns import Unknowns

KNOT = 0.02
"""Time between the free variables of a command, s."""
_PENALTY = 300.0
_RATE = 0.03
"""Initial learning rate of Adam, in the unbounded coordinate, in which the command range is about -3 to 3."""


@dataclass(frozen=True)
class Design:
    """Result of `optimise`.

    Attributes:
        commands: (n, 4) of the manoeuvre.
        log_det: log determinant of the information of one repetition
            (`cfb_mjx.sysid.excitation.information.log_determinant`).
        history: (iterations,) best objective over the starts, including penalties.
    """

    commands: np.ndarray
    log_det: float
    history: np.ndarray


class Problem(eqx.Module):
    """Objective of the design: drone, parameters, noise and limits."""

    model: Quadrotor
    unknowns: Unknowns
    noise: Noise
    relative: Float[Array, "k k"]
    limits: Limits = eqx.field(static=True)
    measured_rotors: bool = eqx.field(static=True)
    margin: float = eqx.field(static=True, default=MARGIN)

    @classmethod
    def of(cls, model: Quadrotor, unknowns: Unknowns, noise: Noise, limits: Limits, measured_rotors: bool) -> Problem:
        """Problem for a drone, integrated with one step per row of the sequence.

        Args:
            model: the drone; its parameters are replaced by the nominal ones of ``unknowns``.
            unknowns: parameters to be fitted.
            noise: noise levels.
            limits: of the manoeuvre.
            measured_rotors: whether rotor speed is logged.
        """
        # The program for Euler with exact mean loads is a quarter the size of that for RK4; the hard check uses RK4.
        model = stepped(Quadrotor(unknowns.nominal, model.effects, model.body), integrator="euler", rotor_loads="mean")
        return cls(model, unknowns, noise, jnp.asarray(per_relative_change(unknowns)), limits, measured_rotors)

    def commands(self, change: Float[Array, "knots 4"], start: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
        """Commands within the allowed range from unbounded coordinates: ``start`` plus a change per knot."""
        low, high = self.limits.command
        knot = ((np.arange(len(start)) * STEP + 1e-9) // KNOT).astype(int)
        return low + (high - low) * jax.nn.sigmoid(start + change[knot])

    def squeezed(self, commands: np.ndarray) -> np.ndarray:
        """Unbounded coordinates of commands."""
        low, high = self.limits.command
        share = np.clip((commands - low) / (high - low), 0.01, 0.99)
        return np.log(share / (1 - share))

    def information(self, commands: Float[Array, "n 4"], path: State | None = None) -> Float[Array, "k k"]:
        """Fisher information of one repetition.

        Args:
            commands: (n, 4) of the manoeuvre.
            path: states of the flight, from `flown`; computed by default.
        """
        path = flown(self.model, commands) if path is None else path
        return window_information(
            self.model, commands, path, self.unknowns, self.noise, self.measured_rotors, self.relative
        )

    def judged(self, commands: np.ndarray) -> np.ndarray:
        """`information` as a NumPy array, compiled once for all sequences of one length."""
        return np.asarray(_information(self, jnp.asarray(commands)))

    def loss(self, change: Float[Array, "knots 4"], start: Float[Array, "n 4"]) -> Float[Array, ""]:
        """Negative log determinant of the information plus penalties."""
        commands = self.commands(change, start)
        path = flown(self.model, commands)
        asked = self.limits.shares(demand(path))
        # The penalty begins slightly inside the margin, so that the optimum keeps it.
        over = jax.tree.map(lambda x: jnp.sum(jax.nn.relu(x / self.margin - 0.98) ** 2), asked)
        return _PENALTY * sum(jax.tree.leaves(over)) - log_determinant(self.information(commands, path))


def optimise(
    problem: Problem,
    duration: float = 0.5,
    iterations: int = 1000,
    starts: int = 4,
    progress: Callable[[int, int], None] | None = None,
) -> Design:
    """Find the most informative command sequence within the limits.

    Args:
        problem: drone, parameters, noise and limits.
        duration: of the manoeuvre, 0.1 to 2 s.
        iterations: number of steps of Adam.
        starts: number of initial sequences: roll-pitch, all axes, single-motor, then multisines with seeds 0, 1, ...
        progress: called with (done, total) iterations.

    Raises:
        CfbError: the limits leave no room for any manoeuvre.
    """
    n = rows(duration)
    known = _starts(problem, duration, starts)
    start = jnp.asarray(np.stack([problem.squeezed(commands) for commands in known]))
    change = np.zeros((len(known), -(-n // round(KNOT / STEP)), 4))
    mean, square, history = 0.0, 0.0, []
    for i in range(iterations):
        loss, slope = (np.asarray(x) for x in slopes(problem, jnp.asarray(change), start))
        slope = np.where(np.isfinite(slope), slope, 0.0)
        mean, square = 0.9 * mean + 0.1 * slope, 0.99 * square + 0.01 * slope**2
        step = mean / (1 - 0.9 ** (i + 1)) / (np.sqrt(square / (1 - 0.99 ** (i + 1))) + 1e-8)
        change = change - _RATE * 0.5 * (1 + np.cos(np.pi * i / iterations)) * step
        history.append(-np.nanmin(loss))
        if progress is not None:
            progress(i + 1, iterations)
    found = np.asarray(jax.vmap(problem.commands)(jnp.asarray(change), start))
    best = _best(problem, [*found, *known])
    return Design(best[0], best[1], np.array(history))


def _starts(problem: Problem, duration: float, count: int) -> list[np.ndarray]:
    shapes = [roll_pitch(duration), all_axes(duration), single_motor(duration)]
    shapes += [multisine(duration, seed) for seed in range(max(count - 3, 0))]
    found = []
    for shape in shapes[:count]:
        try:
            found.append(scaled(problem.model, shape, problem.limits, problem.margin))
        except CfbError:
            if shape is shapes[0]:
                raise
    return found


@eqx.filter_jit
def slopes(
    problem: Problem, change: Float[Array, "starts knots 4"], start: Float[Array, "starts n 4"]
) -> tuple[Float[Array, " starts"], Float[Array, "starts knots 4"]]:
    """Loss of every start, and its gradient with respect to the changes."""
    return jax.vmap(jax.value_and_grad(problem.loss))(change, start)


def _best(problem: Problem, candidates: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """The most informative candidate; candidates beyond the limits are first scaled towards hover."""
    hover = hovering(problem.model, problem.limits)
    kept = [scaled_down(problem, hover, commands) for commands in candidates]
    values = [float(log_determinant(problem.judged(c))) for c in kept]
    index = int(np.nanargmax(values))
    return kept[index], values[index]


def scaled_down(problem: Problem, hover: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """The commands, scaled towards hover as far as necessary to keep the limits."""
    mixtures = hover + np.linspace(1.0, 0.0, 101)[:, None, None] * (commands - hover)
    return mixtures[int(np.argmax(worst(problem.model, mixtures, problem.limits) <= problem.margin))]


@eqx.filter_jit
def _information(problem: Problem, commands):
    return problem.information(commands)
