"""Refitting a model's parameters to flights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from cfb_mjx.devices import Devices
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight import with_gyro_in_time
from cfb_mjx.sysid.identification.filters import detect
from cfb_mjx.sysid.identification.flight_data import Segments, parts, prepare
from cfb_mjx.sysid.identification.innovation import CHANNELS
from cfb_mjx.sysid.identification.likelihood import ROUNDS, Prior, joined, scores_of, settled, surprise_of
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.result import Fit, impossible, summarise
from cfb_mjx.sysid.identification.shooting import shoot
from cfb_mjx.sysid.identification.solver import RIDGE
from cfb_mjx.sysid.identification.uncertainty import Scores, assess, most_contradicted
from cfb_mjx.sysid.identification.unknowns import GROUPS, OFFSETS, UNITS, Unknowns, at_the_border, choose

FEW = 4
"""Number of `parts`, spread over the flights, to which long flights are fitted first: from there all of them need few
steps."""
MASS_STD = 0.05
"""Of the mass as stated, relative, where nothing else is said: decks, batteries and guards come and go, and no flight
tells the mass from the thrust."""
BLUR = 0.0025
"""What commands between rows 10 ms apart, put on a parabola, leave wrong in the constants, relative: found on flights
of known drones (`docs/coverage.md`); it grows with the square of the interval."""
NEARLY = 0.75
"""Share of the interval between rows from which on it is asked whether commands act until the next row."""
HELD = 1e5
"""Ridge of what is held: a prior of 1e-5 units."""
PRIORS = {"thrust_scale": 0.3, "torque_scale": 0.5, "command_hold": 1.0}
"""Standard deviations about the start, in the optimiser's units: they steady a fit where the flights say little. Real
drones pull 11 to 15 % less than the paper's curve; published torque curves differ by a factor of two."""
NEED_ROTOR_SPEED = ("motor_speed_offset", "thrust_linear")
"""Held, and not tried, where rotor speed was not measured: on real motors the steady speed is affine in the command,
and the thrust's slope near hover is not the paper's, but commands alone hardly tell them from gain and scale."""


def default_parameters(logs: list[FlightLog]) -> str:
    """What is fitted where nothing is asked for: inertia, J_m, motors, trim, and the scales of thrust and torque."""
    return "inertia,rotor_inertia,motor_time_constant,motor_gain,cog,thrust_scale,torque_scale"


def fit(
    logs: list[FlightLog],
    nominal: Parameters,
    parameters: str | tuple[str, ...] | None = None,
    use_measured: bool = True,
    robust: bool = False,
    estimator: Literal["auto", "innovation", "shooting"] = "auto",
    progress: Callable[[int, int], None] | None = None,
    over: Devices | None = None,
    mass_std: float | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
) -> Fit:
    """Fit parameters to flights; what the flights cannot tell gets no number.

    What is held is tested (innovation only): a value that the flights contradict by `CLEAR` standard deviations is
    freed and named in ``contradicted``; if no possible value fits the flights, it stays and is named in
    ``unexplained``. How long a logged command acted is always fitted, see `as_held`.

    Args:
        logs: flights; run with x64 enabled.
        nominal: where to start, and the values of all that is not fitted.
        parameters: names or groups (`unknowns.choose`); None takes `default_parameters`.
        use_measured: drive the body with measured rotor speeds where a log has them.
        robust: let outliers count linearly instead of squared.
        estimator: ``innovation``, safe under feedback (`innovation`), or ``shooting``
            (`shooting`), which is not. ``auto`` takes the first, which is right with and without
            feedback, unless the observation delay is asked for: that shows in the pose only, which it does not read.
        progress: called with (done, total).
        over: devices to divide the segments of the flights over.
        mass_std: standard deviation of the nominal mass, kg, which the intervals of all that scales with it take up
            (innovation only); None takes `MASS_STD` of the mass, 0 an exact one. Without meaning if the mass is fitted.
        solver: least-squares solver of optimistix, such as ``optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)``, which
            knows no bounds; None takes `solver.descended`.

    Raises:
        CfbError: unknown parameters, or logs without enough contiguous data.
    """
    logs = [with_gyro_in_time(log, float(nominal.gyro_delay)) for log in logs]
    asked = choose(default_parameters(logs) if parameters is None else parameters, nominal).names
    if estimator == "auto":
        estimator = "shooting" if "pose_delay" in asked else "innovation"
    if estimator == "shooting":
        how = {"use_measured": use_measured, "robust": robust, "progress": progress, "over": over, "solver": solver}
        return shoot(logs, nominal, asked, **how)
    data = prepare(list(logs))
    if data.segments is None or data.rows < 100:
        names = ", ".join(log.name for log in logs)
        raise CfbError(f"{names}: too short a flight to fit; at least a second without a gap is needed.")
    interval = data.segments.interval
    flights = _Flights(
        segments=parts(data.segments, over),
        asked=asked,
        interval=float(np.median(interval[interval > 0])),
        slowest=max(float(np.median(each[each > 0])) for each in interval),
        measured=np.asarray(data.segments.measured) if use_measured else np.zeros(1),
        use_measured=use_measured,
        robust=robust,
        solver=solver,
        progress=progress,
        over=over,
    )
    unknowns = choose(_playing(asked), nominal)
    found = flights.freed(_At(unknowns, Noise.first(data), unknowns.start))
    if progress is not None:
        progress(ROUNDS, ROUNDS)
    (unknowns, noise, vector), names = found.at, unknowns.names
    is_timed = float(unknowns.timed) > 0
    fitted = tuple(name for name in names if name in found.free and not (is_timed and name == "command_hold"))
    deviation = MASS_STD if mass_std is None else mass_std / float(nominal.mass)
    stated = {} if "mass" in asked or deviation == 0 else {"mass": deviation}
    judged = tuple(name for name in names if name in (*fitted, *stated))
    columns = [names.index(name) for name in judged]
    priors = {"command_hold": PRIORS["command_hold"]} | stated
    blur = np.array([_blur(name, float(v)) for name, v in zip(names, unknowns.values(vector), strict=True)])
    # Only where some commands were not logged, and nothing else says how fast the rotors turned.
    missing = 1 - min(max(found.at.hold / flights.interval, 0.0), 1.0) ** 2
    blur *= (flights.interval / 0.01) ** 2 * missing * (not np.all(flights.measured))
    uncertainty = assess(found.scores.columns(columns), judged, priors, blur[columns])
    axes = set(GROUPS["inertia"]) & set(fitted)
    # An axis that the flights cannot tell may have wandered to the border: they do not ask for that.
    asks = axes and not axes & set(uncertainty.names)
    refused = at_the_border(found.at.drone) if asks else {}
    return summarise(
        unknowns,
        vector,
        uncertainty,
        "innovation",
        data.rows,
        names=tuple(name for name in fitted if name != "command_hold" or name in asked),
        impossible=refused,
        contradicted=found.contradicted,
        unexplained=found.unexplained,
        noise=noise,
        whiteness=dict(zip(CHANNELS, map(float, _lag_one(found.residual)), strict=True)),
        feedback=detect(joined(flights.segments), found.residual),
    )


class _At(NamedTuple):
    """A point of a fit."""

    unknowns: Unknowns
    noise: Noise
    vector: Array

    @property
    def drone(self) -> Parameters:
        """The drone at this point."""
        return self.unknowns.apply(self.vector)

    @property
    def hold(self) -> float:
        """Time for which a logged command acted, s."""
        return float(not_none(self.unknowns.hold(self.vector)))

    def timed(self, is_timed: bool) -> _At:
        """The same, with every command acting until the next row or not."""
        return self._replace(unknowns=replace(self.unknowns, timed=float(is_timed)))


class _Found(NamedTuple):
    """A fit of all that was asked for, and of what the flights contradict."""

    at: _At
    free: tuple[str, ...]
    contradicted: tuple[str, ...]
    unexplained: tuple[str, ...]
    residual: np.ndarray
    scores: Scores


@dataclass(frozen=True)
class _Flights:
    """Flights, and how they are fitted; see `fit`."""

    segments: list[Segments]
    asked: tuple[str, ...]
    interval: float
    """Median time between rows, s."""
    slowest: float
    """That of the segment whose rows are farthest apart, s."""
    measured: np.ndarray
    """Whether rotor speed is used, of each segment."""
    use_measured: bool
    robust: bool
    solver: optx.AbstractLeastSquaresSolver | None
    progress: Callable[[int, int], None] | None
    over: Devices | None

    def freed(self, at: _At) -> _Found:
        """Fit what was asked for, and what proves to be contradicted."""
        tried = [name for name in at.unknowns.names if name not in (*self.asked, "mass", "command_hold")]
        if not np.any(self.measured):
            tried = [name for name in tried if name not in NEED_ROTOR_SPEED]
        free, contradicted, unexplained = (*self.asked, "command_hold"), (), {}
        # Where only some flights say how fast the rotors turned, a few parts may say nothing of it.
        alike = np.all(self.measured) or not np.any(self.measured)
        if len(self.segments) > FEW and alike and self.solver is None:
            at = self.settled(free, at, self.segments[:: -(-len(self.segments) // FEW)])
        at = self.settled(free, at)
        while True:
            at, timed_with = self.timed_or_not(free, at), free
            residual, scores = self.scores(at)
            while (name := most_contradicted(scores, at.unknowns.names, free, tried)) is not None:
                # With none of its axes asked for, what moves one axis of the inertia moves the others (`unknowns`).
                names = GROUPS["inertia"] if name in GROUPS["inertia"] else (name,)
                tried = [n for n in tried if n not in names]
                moved = self.settled((*free, *names), at)
                if impossible((*free, *names), moved.drone) - impossible(free, at.drone):
                    unexplained |= dict.fromkeys(names, free)
                    continue
                free, contradicted, at = (*free, *names), (*contradicted, *names), moved
                residual, scores = self.scores(at)
            # What was freed later may change whether a value is explained, and whether commands acted until the next
            # row.
            tried = [*tried, *(name for name, then in unexplained.items() if then != free)]
            unexplained = {name: then for name, then in unexplained.items() if then == free}
            if free == timed_with:
                return _Found(at, free, contradicted, tuple(unexplained), residual, scores)

    def settled(self, free: tuple[str, ...], at: _At, some: list[Segments] | None = None) -> _At:
        """The likeliest noise levels and parameters, of which those that are ``free`` move."""
        unknowns, noise, vector = at
        ridge = jnp.asarray([1 / PRIORS.get(n, 1 / RIDGE) if n in free else HELD for n in unknowns.names])
        prior = Prior(ridge, unknowns.bounds(self.slowest))
        if self.over is not None:  # placed as the rounds return it, or the second would compile anew
            vector, noise, prior = self.over.whole((vector, noise, prior))
        how = self.use_measured, self.robust, prior, self.solver, self.progress
        vector, noise = settled(unknowns, vector, noise, some or self.segments, *how)
        return _At(unknowns, noise, vector)

    def timed_or_not(self, free: tuple[str, ...], at: _At) -> _At:
        """The likelier of two fits: how long a command acted is free, or every command acted until the next row.

        A free hold takes every step of a command for uncertain, and so the rotors' own readings for better than they
        are: where commands come in time with the rows, all motor constants lean by several deviations.
        """
        if "command_hold" in self.asked:
            return at
        is_timed = float(at.unknowns.timed) > 0
        held = self.settled(free, at.timed(False)) if is_timed else at
        if held.hold <= NEARLY * self.interval:
            return held
        timed = at if is_timed else self.settled(free, at.timed(True))
        return timed if self.surprise(timed) <= self.surprise(held) else held

    def surprise(self, at: _At) -> float:
        """Negative logarithm of the likelihood per row, of commands that are what they are taken for and no other."""
        return surprise_of(at.unknowns, at.vector, at.noise, self.segments, self.use_measured, self.robust)

    def scores(self, at: _At) -> tuple[np.ndarray, Scores]:
        """Residuals (s, n, 8), and their scores with respect to relative changes of the parameters."""
        return scores_of(at.unknowns, at.vector, at.noise, self.segments, self.use_measured, self.robust)


def _blur(name: str, value: float) -> float:
    """`BLUR` in the optimiser's units: of the value, a tenth of it for what slow torques tell, nothing for the log."""
    if name in ("mass", "command_hold"):
        return 0.0
    return 0.1 * BLUR * abs(value) / OFFSETS[name] if name in OFFSETS else BLUR


def _playing(asked: tuple[str, ...]) -> tuple[str, ...]:
    """All that may move: one list for all requests, so that they share compiled programs."""
    left = {"pose_delay"} - set(asked)
    # The coordinates of the inertia depend on which of its axes may move (`unknowns`).
    axes = set(GROUPS["inertia"])
    if axes & set(asked):
        left |= axes - set(asked)
    return tuple(name for name in UNITS if name not in left)


def _lag_one(residual: np.ndarray) -> np.ndarray:
    now, before = residual[:, 1:], residual[:, :-1]
    both = np.sum(now * before, axis=(0, 1))
    return both / np.maximum(np.sqrt(np.sum(now**2, axis=(0, 1)) * np.sum(before**2, axis=(0, 1))), 1e-300)
