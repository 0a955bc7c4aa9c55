"""Refitting a model's parameters to flights."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from cfb_mjx.devices import Devices, over_cores
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight import with_gyro_in_time
from cfb_mjx.sysid.identification.filters import detect
from cfb_mjx.sysid.identification.flight_data import Segments, parts, prepare
from cfb_mjx.sysid.identification.innovation import (
    CHANNELS,
    Drive,
    Weights,
    as_held,
    drive,
    innovations,
    weights,
    whitened,
)
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.result import Fit, is_possible, summarise
from cfb_mjx.sysid.identification.shooting import shoot
from cfb_mjx.sysid.identification.solver import (
    RIDGE,
    SOLVED,
    UNBOUNDED,
    Bounds,
    Quadratic,
    descended,
    least_squares,
    likelihood,
    linearised,
    surprise,
    tempered,
)
from cfb_mjx.sysid.identification.uncertainty import Scores, assess, most_contradicted
from cfb_mjx.sysid.identification.unknowns import GROUPS, OFFSETS, UNITS, Unknowns, at_the_border, choose

ROUNDS = 8
"""Noise levels and parameters are found in turns, at most so often."""
ACCURACY = (1e-2, 1e-4, SOLVED)
"""Squared error of a round's parameters, in standard deviations of the estimate; the last also of later rounds."""
LEVELS = 1e-3
"""Least squared error of noise levels: a few per cent of a standard deviation do not move the parameters."""
FEW = 4
"""Number of `parts`, spread over the flights, to which long flights are fitted first: from there all of them need few
steps."""
SETTLED = 5e-4
"""A round that changes no parameter by more than this share is the last."""
BLOCK = 128
"""Rows the bootstrap keeps together: half a second at 250 Hz, longer than the disturbance stays correlated."""
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
        solver: least-squares solver of optimistix, such as ``optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)``; None
            takes `GaussNewton`.

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
    segments = parts(data.segments, over)
    unknowns = choose(_playing(asked), nominal)
    tried = [name for name in unknowns.names if name not in (*asked, "mass", "command_hold")]
    if not (use_measured and bool(np.any(data.segments.measured))):
        tried = [name for name in tried if name not in NEED_ROTOR_SPEED]
    contradicted: list[str] = []
    unexplained: list[str] = []
    interval = float(np.median(data.segments.interval[data.segments.interval > 0]))
    bounds = unknowns.bounds(max(float(np.median(each[each > 0])) for each in data.segments.interval))

    def settled(free: tuple[str, ...], unknowns: Unknowns, vector, noise: Noise, some: list[Segments] | None = None):
        ridge = jnp.asarray([1 / PRIORS.get(n, 1 / RIDGE) if n in free else HELD for n in unknowns.names])
        prior = Prior(ridge, bounds)
        if over is not None:  # placed as the rounds return it, or the second would compile anew
            vector, noise, prior = over.whole((vector, noise, prior))
        how = use_measured, robust, prior, solver, progress
        return unknowns, *_settled(unknowns, vector, noise, some or segments, *how)

    def in_time_or_not(free: tuple[str, ...], at: tuple[Unknowns, Array, Noise]):
        # A free hold takes every step of a command for uncertain, and so the rotors' own readings for better than they
        # are: where commands come in time with the rows, all motor constants lean by several deviations.
        if "command_hold" in asked:
            return at
        is_timed = float(at[0].timed) > 0
        held = settled(free, replace(at[0], timed=jnp.zeros(())), *at[1:]) if is_timed else at
        if float(not_none(held[0].hold(held[1]))) <= NEARLY * interval:
            return held
        timed = at if is_timed else settled(free, replace(at[0], timed=jnp.ones(())), *at[1:])
        return min(timed, held, key=lambda fit: _surprise(*fit, segments, use_measured, robust))

    free, at = (*asked, "command_hold"), (unknowns, unknowns.start, Noise.first(data))
    if len(segments) > FEW:
        at = settled(free, *at, segments[:: -(-len(segments) // FEW)])
    at = settled(free, *at)
    while True:
        at, asked_with = in_time_or_not(free, at), free
        residual, scores = _scores(*at, segments, use_measured, robust)
        while (name := most_contradicted(scores, unknowns.names, free, tried)) is not None:
            # With none of its axes asked for, what moves one axis of the inertia moves the others (`unknowns`).
            names = GROUPS["inertia"] if name in GROUPS["inertia"] else (name,)
            tried = [n for n in tried if n not in names]
            moved = settled((*free, *names), *at)
            if not all(is_possible(n, unknowns.apply(moved[1])) for n in (*contradicted, *names)):
                unexplained += names
                continue
            contradicted += names
            free, at = (*free, *names), moved
            residual, scores = _scores(*at, segments, use_measured, robust)
        if free == asked_with:  # what was freed may change whether commands acted until the next row
            break
    unknowns, vector, noise = at
    if progress is not None:
        progress(ROUNDS, ROUNDS)
    is_timed = float(unknowns.timed) > 0
    fitted = tuple(name for name in unknowns.names if name in free and not (is_timed and name == "command_hold"))
    deviation = MASS_STD if mass_std is None else mass_std / float(nominal.mass)
    stated = {} if "mass" in asked or deviation == 0 else {"mass": deviation}
    judged = tuple(name for name in unknowns.names if name in (*fitted, *stated))
    columns = [unknowns.names.index(name) for name in judged]
    priors = {"command_hold": PRIORS["command_hold"]} | stated
    blur = np.array([_blur(name, float(v)) for name, v in zip(unknowns.names, unknowns.values(vector), strict=True)])
    # Only where some commands were not logged, and nothing else says how fast the rotors turned.
    missing = 1 - min(max(float(not_none(unknowns.hold(vector))) / interval, 0.0), 1.0) ** 2
    blur *= (interval / 0.01) ** 2 * missing * (use_measured is False or not np.all(np.asarray(data.segments.measured)))
    uncertainty = assess(scores.columns(columns), judged, priors, blur[columns])
    axes = set(GROUPS["inertia"]) & set(fitted)
    # An axis that the flights cannot tell may have wandered to the border: they do not ask for that.
    asks = axes and not axes & set(uncertainty.names)
    impossible = at_the_border(unknowns.apply(vector)) if asks else {}
    return summarise(
        unknowns,
        vector,
        uncertainty,
        "innovation",
        data.rows,
        names=tuple(name for name in fitted if name != "command_hold" or name in asked),
        impossible=impossible,
        contradicted=tuple(contradicted),
        unexplained=tuple(unexplained),
        noise=noise,
        whiteness=dict(zip(CHANNELS, map(float, _lag_one(residual)), strict=True)),
        feedback=detect(_joined(segments), residual),
    )


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


class Prior(NamedTuple):
    """What is known of the unknowns beside the flights: see `solver.descended`."""

    ridge: Float[Array, " k"]
    bounds: Bounds = UNBOUNDED


def _settled(
    unknowns: Unknowns,
    vector,
    noise: Noise,
    segments: list[Segments],
    use_measured,
    robust,
    prior: Prior,
    solver,
    progress,
) -> tuple[Array, Noise]:
    """Vector and noise levels of largest likelihood, found in turns."""
    for done in range(ROUNDS):
        before, levels = vector, noise
        accuracy = ACCURACY[min(done, len(ACCURACY) - 1)]
        noise = fit_noise(unknowns, vector, noise, segments, use_measured, robust, max(accuracy, LEVELS))
        vector = _fit_vector(unknowns, vector, noise, segments, use_measured, robust, prior, solver, accuracy)
        if progress is not None:
            progress(min(done + 1, ROUNDS - 1), ROUNDS)
        # A vector that the flights hardly tell may creep for ever; what creeps under the same noise is of no matter.
        changed = max(
            float(jnp.max(jnp.abs(a / b - 1))) for a, b in zip(*map(jax.tree.leaves, (noise, levels)), strict=True)
        )
        still = changed < SETTLED or float(jnp.max(jnp.abs(vector - before))) < SETTLED
        if still and accuracy == ACCURACY[-1]:
            break
    return vector, noise


def _at(unknowns: Unknowns, vector, segments: Segments) -> tuple[Parameters, Segments]:
    """The drone of a vector, and its commands as it says they acted."""
    parameters = unknowns.apply(vector)
    return parameters, as_held(parameters, unknowns.hold(vector), segments)


def _each(function: Callable, *pieces: Sequence) -> Iterator:
    """Results of a compiled function of the parts of the data and what belongs to them, one after the other.

    All cores compute them, unless the parts are divided over devices.
    """
    several = any(piece.over is not None for piece in pieces[0])
    along = zip(*pieces, strict=True)
    return (function(*each) for each in along) if several else over_cores(lambda each: function(*each), along)


def fit_noise(
    unknowns: Unknowns,
    vector,
    noise: Noise,
    segments: Sequence[Segments],
    use_measured: bool,
    robust: bool,
    accuracy: float = SOLVED,
) -> Noise:
    """Noise levels of largest likelihood at ``vector``, from ``noise`` on; ``segments`` in `parts`."""
    # The smoothed rotor speeds stay those of the last round's noise: the rotors' own readings say how noisy they are.
    driven = list(_each(lambda part: _driven(unknowns, vector, noise, part, use_measured, robust), segments))

    def about(levels):
        return _each(
            lambda part, own: _likelihood(levels, unknowns, vector, part, own, use_measured, robust), segments, driven
        )

    return Noise.from_vector(descended(about, noise.to_vector(), levels=True, bounds=Noise.bounds(), accuracy=accuracy))


@eqx.filter_jit
def _driven(unknowns: Unknowns, vector, noise: Noise, part: Segments, use_measured: bool, robust: bool) -> Drive:
    parameters, part = _at(unknowns, vector, part)
    return drive(parameters, noise, part, use_measured, robust)


@eqx.filter_jit
def _likelihood(
    levels, unknowns: Unknowns, vector, part: Segments, driven: Drive, use_measured: bool, robust: bool
) -> Quadratic:
    parameters, part = _at(unknowns, vector, part)

    def predicted(x):
        error, variance = innovations(parameters, Noise.from_vector(x), part, driven, use_measured, robust)
        return error, jnp.log(variance)

    return likelihood(predicted, levels, robust)


def _residual(
    vector,
    unknowns: Unknowns,
    noise: Noise,
    segments: Segments,
    use_measured: bool,
    robust: bool,
    weighed: Weights | None = None,
):
    parameters, segments = _at(unknowns, vector, segments)
    return tempered(whitened(parameters, noise, segments, use_measured, robust, weighed), robust)


@eqx.filter_jit
def _weights(unknowns: Unknowns, vector, noise: Noise, segments: Segments, use_measured: bool, robust: bool) -> Weights:
    parameters, segments = _at(unknowns, vector, segments)
    return weights(parameters, noise, segments, use_measured, robust)


def _surprise(
    unknowns: Unknowns, vector, noise: Noise, segments: Sequence[Segments], use_measured: bool, robust: bool
) -> float:
    """Negative logarithm of the likelihood per row, of commands that are what `as_held` makes of them and no other."""
    found = list(_each(lambda part: _surprises(unknowns, vector, noise, part, use_measured, robust), segments))
    return float(sum(nats for nats, _ in found)) / float(sum(rows for _, rows in found))


@eqx.filter_jit
def _surprises(unknowns: Unknowns, vector, noise: Noise, part: Segments, use_measured: bool, robust: bool):
    parameters, part = _at(unknowns, vector, part)
    part = eqx.tree_at(lambda s: s.doubt, part, jnp.zeros_like(part.doubt))
    driven = drive(parameters, noise, part, use_measured, robust)
    error, variance = innovations(parameters, noise, part, driven, use_measured, robust)
    return 0.5 * jnp.sum(jnp.log(variance) + surprise(error / jnp.sqrt(variance), robust)), jnp.sum(part.valid)


def _fit_vector(
    unknowns: Unknowns,
    vector,
    noise: Noise,
    segments: Sequence[Segments],
    use_measured: bool,
    robust: bool,
    prior: Prior,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    accuracy: float = SOLVED,
):
    weighed = list(_each(lambda part: _weights(unknowns, vector, noise, part, use_measured, robust), segments))
    if solver is not None:
        return _solved(unknowns, vector, noise, list(segments), weighed, use_measured, robust, prior.ridge, solver)

    def about(x):
        return _each(lambda part, own: _squares(x, unknowns, noise, part, own, use_measured, robust), segments, weighed)

    factors = jnp.asarray([name not in OFFSETS for name in unknowns.names])
    return descended(about, vector, prior.ridge, factors, prior.bounds, accuracy)


@eqx.filter_jit
def _squares(
    x, unknowns: Unknowns, noise: Noise, part: Segments, weighed: Weights, use_measured: bool, robust: bool
) -> Quadratic:
    return linearised(lambda x: _residual(x, unknowns, noise, part, use_measured, robust, weighed), x)


@eqx.filter_jit
def _solved(unknowns: Unknowns, vector, noise: Noise, segments, weighed, use_measured, robust, ridge, solver):
    """The vector by a solver of optimistix, which needs all residuals at once."""
    (_, doubt, variance), whole = zip(*weighed, strict=True), _joined(segments)
    own = Weights(weighed[0].parameters, jnp.concatenate(doubt), jnp.concatenate(variance))
    return least_squares(
        lambda x: _residual(x, unknowns, noise, whole, use_measured, robust, own), vector, ridge, solver
    )


def _joined(segments: Sequence[Segments]) -> Segments:
    """All parts in one, with what was added to divide them evenly."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *segments)


def _scores(
    unknowns: Unknowns, vector, noise: Noise, segments: Sequence[Segments], use_measured: bool, robust: bool
) -> tuple[np.ndarray, Scores]:
    """Residuals (s, n, 8) of a fit, and its scores with respect to relative changes of the parameters."""
    found = slopes_in_blocks(unknowns, vector, noise, segments, use_measured, robust)
    residuals, scores = zip(*((residual, Scores.of(*blocks)) for residual, *blocks in found), strict=True)
    return np.concatenate(residuals), Scores.joined(scores)


def slopes_in_blocks(
    unknowns: Unknowns, vector, noise: Noise, segments: Sequence[Segments], use_measured: bool, robust: bool
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each part of the data its residuals (s, n, 8), and `in_blocks` residuals and their derivatives with respect
    to relative changes of the parameters."""
    relative = np.linalg.inv(unknowns.slope(vector))

    def one(part: Segments) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        residual, jacobian = map(np.asarray, fit_slopes(unknowns, vector, noise, part, use_measured, robust))
        return residual, *in_blocks(part, residual, jacobian @ relative)

    return _each(one, segments)


@eqx.filter_jit
def fit_slopes(unknowns: Unknowns, vector, noise: Noise, segments: Segments, use_measured: bool, robust: bool):
    """Residuals (s, n, 8) of a part of the data at ``vector``, and their derivatives (s, n, 8, k) by it."""

    def residual(x):
        return _residual(x, unknowns, noise, segments, use_measured, robust)

    return residual(vector), jax.jacfwd(residual)(vector)


def in_blocks(segments: Segments, residual: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and Jacobians cut into blocks of `BLOCK` rows, without those in which nothing counts."""
    counts = np.asarray(segments.valid * (1 - segments.warm_up))[:, 1:].reshape(-1, BLOCK).any(axis=1)
    channels, k = jacobian.shape[-2:]
    return residual.reshape(-1, BLOCK, channels)[counts], jacobian.reshape(-1, BLOCK, channels, k)[counts]


def _lag_one(residual: np.ndarray) -> np.ndarray:
    now, before = residual[:, 1:], residual[:, :-1]
    both = np.sum(now * before, axis=(0, 1))
    return both / np.maximum(np.sqrt(np.sum(now**2, axis=(0, 1)) * np.sum(before**2, axis=(0, 1))), 1e-300)
