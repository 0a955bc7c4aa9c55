"""One-step innovations of a motor with first-order lag, separate spin-up and spin-down time constants, and dead time.

``Omega' = (K u(t - d) + offset + b - Omega) / T``, where ``T`` is the spin-up constant if the steady speed is above the
rotor speed and the spin-down constant if it is below (paper eq. 5: one T, d = 0). ``b`` is an Ornstein-Uhlenbeck
process: battery and load change the steady speed, and the controller responds to the consequences, so the commands are
correlated with it. This does not bias the likelihood of one-step innovations; see
`cfb_mjx.sysid.identification.innovation`, whose rotor filter this one generalises.

Between two events (a row, or a command that takes effect) the command is constant and the speed never crosses its
target. So the exponential solution is exact for any sampling. Events are sorted by time rather than counted in rows, so
the dead time is continuous.

Recordings of single motors are cut at gaps into pieces of equal shape. The constants and noise levels are
maximum-likelihood estimates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from cfb_mjx.logs.bench_tables import MotorRecord
from cfb_mjx.model.state import AnyArray
from cfb_mjx.sysid.identification.flight_data import white_noise
from cfb_mjx.sysid.identification.uncertainty import Scores, Uncertainty, assess

ROWS = 512
"""Rows per piece. As the number of pieces is rounded up to a power of two, most fits share one compiled program."""
FEWEST_PIECES = 32
"""Smallest number of pieces, with padding."""
WARM_UP = 0.2
"""Maximum warm-up of the filter, s, and at most a quarter of a piece; its rows do not count in the likelihood."""
FEWEST_ROWS = 24
"""Smallest number of measured rows in a piece."""


class Tracks(eqx.Module):
    """S pieces of N rows, each of one motor; short pieces are padded with their last row."""

    time: Float[AnyArray, "s n"]
    """Since the piece's first row, s."""
    command: Float[AnyArray, "s n"]
    rotor_speed: Float[AnyArray, "s n"]
    """rad/s; 0 where not measured."""
    measured: Float[AnyArray, "s n"]
    """1 where a rotor speed was measured, except in the padding and in the first row, which initialises the filter."""
    judged: Float[AnyArray, "s n"]
    """1 for measured rows after the warm-up, which count in the likelihood."""


@dataclass(frozen=True)
class MotorData:
    """Tracks of several recordings.

    Attributes:
        tracks: with padding.
        motor: (pieces,) motor number of each piece that is not padding.
        noise: white noise of the rotor speed per row, rad/s, from third differences.
        speed_per_command: median of rotor speed over command, rad/s.
        interval: median time between rows, s.
    """

    tracks: Tracks
    motor: np.ndarray
    noise: float
    speed_per_command: float
    interval: float

    @property
    def rows(self) -> int:
        """Number of rows that count in the likelihood."""
        return int(self.tracks.judged.sum())


def gather(records: Sequence[MotorRecord], motor: int | None = None) -> MotorData | None:
    """Cut recordings into tracks.

    Args:
        records: recordings.
        motor: number of the motor to pick; None: all motors.

    Returns:
        The tracks; None if no stretch is long enough.
    """
    pieces, owners, noise, ratio, interval = [], [], [], [], []
    for record in records:
        for column, number in enumerate(record.motors):
            if motor not in (None, number):
                continue
            command, speed = record.command[:, column], record.rotor_speed[:, column]
            turning = np.isfinite(speed) & (command > 0.05)
            if turning.any():
                ratio.append(np.median(speed[turning] / command[turning]))
            # The noise estimate is a median of differences, so bursts do not affect it.
            noise.append(float(white_noise(speed[np.isfinite(speed), None])[0]))
            for segment in record.segments():
                found = _cut(record.time[segment], command[segment], speed[segment])
                pieces += found
                owners += [number] * len(found)
                interval += [np.median(np.diff(piece["time"])[: piece["rows"] - 1]) for piece in found]
    if not pieces:
        return None
    width = max(FEWEST_PIECES, 1 << (len(pieces) - 1).bit_length())
    blank = {key: np.zeros((width - len(pieces), ROWS)) for key in Tracks.__annotations__}
    tracks = Tracks(**{key: np.concatenate([np.stack([p[key] for p in pieces]), blank[key]]) for key in blank})
    level = np.nanmedian(noise) if np.isfinite(noise).any() else np.nan
    return MotorData(
        tracks,
        np.array(owners),
        float(level) if np.isfinite(level) else 10.0,
        float(np.median(ratio)) if ratio else np.nan,
        float(np.median(interval)),
    )


def _cut(time: np.ndarray, command: np.ndarray, speed: np.ndarray) -> list[dict]:
    """Cut a gap-free stretch of one motor into pieces that overlap by the warm-up; each row counts at most once."""
    found, first, judged_from = [], 0, None
    known = np.isfinite(speed)
    while first < len(time) and known[first:].any():
        first += int(np.argmax(known[first:]))
        last = min(first + ROWS, len(time))
        lead = min(int(np.searchsorted(time[first:last] - time[first], WARM_UP)), ROWS // 4)
        if judged_from is None:
            judged_from = first + min(lead, (last - first) // 4)
        if known[first:last].sum() >= FEWEST_ROWS:
            rows = slice(first, last)
            skipped = max(judged_from - first, 2)
            found.append(_pad(time[rows] - time[first], command[rows], speed[rows], skipped))
        if last == len(time):
            break
        first, judged_from = last - lead, last
    return found


def _pad(time: np.ndarray, command: np.ndarray, speed: np.ndarray, lead: int) -> dict:
    count = len(time)

    def pad(values):
        return np.concatenate([values, np.full(ROWS - count, values[-1])])

    measured = np.isfinite(speed).astype(float)
    measured[0] = 0.0
    flags = np.concatenate([measured, np.zeros(ROWS - count)])
    return {
        "time": pad(time),
        "command": pad(command),
        "rotor_speed": pad(np.nan_to_num(speed)),
        "measured": flags,
        "judged": flags * (np.arange(ROWS) >= lead),
        "rows": count,
    }


NAMES = ("motor_gain", "motor_speed_offset", "spin_up_time_constant", "spin_down_time_constant", "dead_time")
OFFSET_UNIT, DEAD_TIME_UNIT = 1000.0, 0.01
"""Units of the unknowns for offset, rad/s, and dead time, s; the unknowns are then of order one."""
CORRELATION_TIME = 0.5
"""Correlation time of the error of the steady speed, s; the corner frequency is 1/(2 pi 0.5 s) = 0.3 Hz."""


class Motor(eqx.Module):
    """Constants and noise levels of a motor, all scalars."""

    gain: Float[Array, ""]
    """K, rad/s."""
    offset: Float[Array, ""]
    """Steady speed at zero command, rad/s."""
    spin_up: Float[Array, ""]
    """Time constant while the steady speed is above the rotor speed, s."""
    spin_down: Float[Array, ""]
    """Time constant while the steady speed is below the rotor speed, s."""
    dead_time: Float[Array, ""]
    """Time from a command to its first effect, s. Negative if rotor speeds are stamped earlier than commands."""
    reading: Float[Array, ""]
    """White measurement noise of the rotor speed per row, rad/s."""
    walk: Float[Array, ""]
    """White angular acceleration of the rotor, rad/s per square root of a second."""
    wander: Float[Array, ""]
    """Standard deviation of the slowly varying error of the steady speed, rad/s."""

    @staticmethod
    def from_vector(x: Float[Array, "8"]) -> Motor:
        """Motor from the vector of unknowns: logarithms, except offset and dead time, which are in their units.

        The noise levels have a floor, because the likelihood is flat where a level vanishes.
        """
        up, down = jnp.exp(jnp.clip(x[2:4], jnp.log(1e-4), jnp.log(10.0)))
        return Motor(
            jnp.exp(x[0]),
            OFFSET_UNIT * x[1],
            up,
            down,
            DEAD_TIME_UNIT * x[4],
            jnp.exp(x[5]) + 1e-2,
            jnp.exp(x[6]) + 1e-1,
            jnp.exp(x[7]) + 1e-1,
        )


class Events(eqx.Module):
    """Rows and commands that take effect, sorted by time: arrays (2N, S), with time as the first axis for the scan."""

    time: Array
    """Since the piece's first row, s."""
    command: Array
    """Command that takes effect where ``switches`` is 1."""
    switches: Array
    """1 where a command takes effect, 0 for a row."""
    rotor_speed: Array
    measured: Array
    judged: Array

    @property
    def interval(self) -> Array:
        """Time since the previous event, s."""
        return jnp.diff(self.time, axis=0, prepend=self.time[:1])


def events(motor: Motor, tracks: Tracks) -> Events:
    """Merge the rows with the commands, which take effect ``dead_time`` later; differentiable in the dead time."""
    zero = jnp.zeros(tracks.time.shape)
    # Commands before the first row are unknown; assume that the first command was held.
    effect = jnp.maximum(tracks.time + motor.dead_time, 0.0)
    commands = (effect, tracks.command, zero + 1, zero, zero, zero)
    rows = (tracks.time, zero, zero, tracks.rotor_speed, tracks.measured, tracks.judged)
    columns = [jnp.concatenate(pair, axis=1) for pair in zip(commands, rows, strict=True)]
    return Events(*(c.T for c in jax.lax.sort(columns, dimension=1, is_stable=True, num_keys=1)))


def innovations(motor: Motor, tracks: Tracks) -> tuple[Float[Array, "e s"], Float[Array, "e s"], Float[Array, "e s"]]:
    """One-step prediction errors of the rotor speeds, rad/s, their variances, and the mask of those that count.

    The order is that of the events. Errors that do not count are zero, with variance one.
    """
    happening = events(motor, tracks)
    r, q, d = motor.reading**2, motor.walk**2, motor.wander**2

    def step(carry, inputs):
        x, b, pxx, pxb, pbb, command = carry
        interval, event = inputs
        goal = motor.gain * command + motor.offset + b
        lag = jnp.where(goal > x, motor.spin_up, motor.spin_down)
        keep, decay = jnp.exp(-interval / CORRELATION_TIME), jnp.exp(-interval / lag)
        gain = 1 - decay
        x, b = goal + decay * (x - goal), keep * b
        pxx, pxb, pbb = (
            decay**2 * pxx + 2 * decay * gain * pxb + gain**2 * pbb + q * lag / 2 * (1 - decay**2),
            keep * (decay * pxb + gain * pbb),
            keep**2 * pbb + d * (1 - keep**2),
        )
        s, e = pxx + r, event.rotor_speed - x
        kx, kb = event.measured * pxx / s, event.measured * pxb / s
        x, b = x + kx * e, b + kb * e
        pxx, pxb, pbb = (1 - kx) * pxx, (1 - kx) * pxb, pbb - kb * pxb
        command = jnp.where(event.switches > 0, event.command, command)
        return (x, b, pxx, pxb, pbb, command), (e, s)

    zero = jnp.zeros(tracks.time.shape[0])
    start = (tracks.rotor_speed[:, 0], zero, zero + r, zero, zero + d, tracks.command[:, 0])
    _, (error, variance) = jax.lax.scan(step, start, (happening.interval, happening))
    judged = happening.judged
    return jnp.where(judged > 0, error, 0.0), jnp.where(judged > 0, variance, 1.0), judged


def negative_log_likelihood(motor: Motor, tracks: Tracks) -> Float[Array, ""]:
    """Negative log-likelihood of all innovations, nats, up to a constant."""
    error, variance, _ = innovations(motor, tracks)
    return 0.5 * jnp.sum(jnp.log(variance) + error**2 / variance)


def simulate(motor: Motor, tracks: Tracks) -> Float[Array, "s n"]:
    """Simulate rotor speeds from the commands, starting at the measured first row of every piece, rad/s."""
    happening = events(motor, tracks)

    def step(carry, event):
        x, command = carry
        interval, new, switches = event
        goal = motor.gain * command + motor.offset
        lag = jnp.where(goal > x, motor.spin_up, motor.spin_down)
        x = goal + jnp.exp(-interval / lag) * (x - goal)
        return (x, jnp.where(switches > 0, new, command)), x

    start = (tracks.rotor_speed[:, 0], tracks.command[:, 0])
    _, speed = jax.lax.scan(step, start, (happening.interval, happening.command, happening.switches))
    # Select the events that are rows, in their order.
    rows = jnp.argsort(happening.switches.T, axis=1, stable=True)[:, : tracks.time.shape[1]]
    return jnp.take_along_axis(speed.T, rows, axis=1)


ROUNDS, STEPS = 12, 8
"""Maximum number of updates of the Fisher information, and of steps between them. The steps are few, because far from
the optimum the information changes a lot."""
BLOCK = 256
"""Events (two per row) in a bootstrap block."""
_GRAIN = {"motor_gain": 0.5, "motor_speed_offset": 500.0, "dead_time": 0.01}
"""Units of the constants for `assess`. A constant counts as unidentified if it is free by more than half a unit: K and
the time constants by 25 %, the offset by 250 rad/s, the dead time by 5 ms."""
_SIZE, _NOISE = 8, 5
PRIOR = 3.0
"""Standard deviation of the weak prior about the first guess, for all unknowns but the gain: a factor of 20 for lags
and noise levels, 3000 rad/s for the offset, 30 ms for the dead time."""


@dataclass(frozen=True)
class Optimum:
    """Maximum-likelihood estimate of one model variant with k free constants.

    Attributes:
        names: of the free constants; ``motor_time_constant`` moves spin-up and spin-down together.
        vector: (8,) unknowns, as of `Motor.from_vector`.
        loss: negative log-likelihood, nats.
        rows: number of rows in the likelihood.
        uncertainty: of the free constants, in their units for `assess`; from the response to commands only.
        directions: (8, k) change of the vector per unit of each free constant.
        inflation: (k,) factor by which the bootstrap widened the standard deviations.
        whiteness: lag-one correlation of the innovations; near 0 if the noise model is right.
        outliers: share of innovations beyond five standard deviations.
    """

    names: tuple[str, ...]
    vector: np.ndarray
    loss: float
    rows: int
    uncertainty: Uncertainty
    directions: np.ndarray
    inflation: np.ndarray
    whiteness: float
    outliers: float

    @property
    def motor(self) -> Motor:
        """Constants and noise levels as plain numbers."""
        return jax.tree.map(float, Motor.from_vector(jnp.asarray(self.vector)))

    def value(self, name: str) -> float:
        """Value of a constant, SI."""
        motor = self.motor
        found = {
            "motor_gain": motor.gain,
            "motor_speed_offset": motor.offset,
            "motor_time_constant": motor.spin_up,
            "spin_up_time_constant": motor.spin_up,
            "spin_down_time_constant": motor.spin_down,
            "dead_time": motor.dead_time,
        }
        return float(found[name])

    def std(self, name: str) -> float:
        """Standard deviation of a free constant, SI."""
        return float(self.uncertainty.std[self.names.index(name)] * self._unit(name))

    def _unit(self, name: str) -> float:
        return _GRAIN[name] if name in ("motor_speed_offset", "dead_time") else _GRAIN.get(name, 0.5) * self.value(name)


def first_guess(data: MotorData, time_constant: float, gain: float, offset: float) -> np.ndarray:
    """Initial vector (8,): the model's constants, with K and the reading noise estimated from the data."""
    seen = data.speed_per_command
    gain = seen if np.isfinite(seen) and seen > 100 and offset == 0 else gain
    noise = np.clip(data.noise, 0.1, 100.0)
    return np.array([np.log(gain), offset / OFFSET_UNIT, *np.log([time_constant] * 2), 0.0, *np.log([noise, 10, 20])])


def maximise(data: MotorData, names: tuple[str, ...], start: np.ndarray) -> Optimum:
    """Maximise the likelihood over some constants and all noise levels.

    The search runs in coordinates in which the Fisher information is the identity. Otherwise a quasi-Newton method
    would be slow, because the curvature differs by orders of magnitude between the constants.

    Args:
        data: recordings of the motor.
        names: of the free constants; the others keep their value.
        start: (8,) initial vector, as of `Motor.from_vector`.
    """
    tracks = jax.tree.map(jnp.asarray, data.tracks)
    basis = np.stack([_direction(name) for name in names] + list(np.eye(_SIZE)[_NOISE:]), axis=1)
    vector, loss = np.array(start), np.inf
    if "dead_time" in names and vector[4] == 0.0:
        # The likelihood has a kink where commands coincide with rows, so do not start there.
        vector[4] = 0.25 * data.interval / DEAD_TIME_UNIT
    for _ in range(ROUNDS):
        found, value, steps = _search(
            jnp.asarray(vector), jnp.asarray(_whitener(vector, basis, tracks)), jnp.asarray(start), tracks
        )
        vector, before, loss = np.asarray(found), loss, float(value)
        if before - loss < 0.05 or int(steps) < STEPS:
            break
    return _judge(data, tracks, names, basis[:, : len(names)], vector, loss)


def _direction(name: str) -> np.ndarray:
    if name == "motor_time_constant":
        return np.eye(_SIZE)[2] + np.eye(_SIZE)[3]
    return np.eye(_SIZE)[NAMES.index(name)]


@eqx.filter_jit
def _search(vector, whitener, start, tracks: Tracks):
    def plain(z):
        x = vector + whitener @ z
        # Without a prior, unknowns that do not affect the likelihood would diverge.
        prior = 0.5 * jnp.sum((x[1:] - start[1:]) ** 2) / PRIOR**2
        return negative_log_likelihood(Motor.from_vector(x), tracks) + prior

    # With few unknowns and many rows, forward mode is twice as fast as reverse mode, which stores every step.
    loss = jax.custom_jvp(plain)

    @loss.defjvp
    def _(primals, tangents):
        slope, value = jax.jacfwd(lambda z: (plain(z),) * 2, has_aux=True)(*primals)
        return value, slope @ tangents[0]

    # z is in standard deviations, so the tolerance is a hundredth of one.
    solver = optx.BFGS(rtol=1e-9, atol=1e-2)
    found = optx.minimise(lambda z, _: loss(z), solver, jnp.zeros(_SIZE), max_steps=STEPS, throw=False)
    return vector + whitener @ found.value, plain(found.value), found.stats["num_steps"]


@eqx.filter_jit
def _sensitivity(vector, tracks: Tracks):
    """Innovations, variances, mask, and the derivatives of the first two with respect to the vector; pieces first."""

    def whole(x):
        error, variance, judged = innovations(Motor.from_vector(x), tracks)
        return (error.T, variance.T), (error.T, variance.T, judged.T)

    slopes, found = jax.jacfwd(whole, has_aux=True)(vector)
    return *found, *slopes


@eqx.filter_jit
def undisturbed(vector, tracks: Tracks) -> Tracks:
    """The tracks with rotor speeds simulated from the commands, without noise."""
    return eqx.tree_at(lambda t: t.rotor_speed, tracks, simulate(Motor.from_vector(vector), tracks))


def _whitener(vector, basis, tracks) -> np.ndarray:
    """Matrix (8, 8) from unit-information coordinates to changes of the vector; columns of fixed ones are zero."""
    _, s, _, de, ds = (np.asarray(x) for x in _sensitivity(jnp.asarray(vector), tracks))
    de, ds = de @ basis, ds @ basis
    information = np.einsum("sni,snj->ij", de / s[..., None], de)
    information += 0.5 * np.einsum("sni,snj->ij", ds / s[..., None] ** 2, ds)
    # Limit the steps in directions that the data do not determine to a factor e^2.
    factor = np.linalg.cholesky(information + np.eye(basis.shape[1]) / 4)
    directions = np.linalg.solve(factor, basis.T).T
    return np.pad(directions, ((0, 0), (0, _SIZE - basis.shape[1])))


def _judge(data, tracks, names, basis, vector, loss) -> Optimum:
    """Assess the optimum; its uncertainty uses the response to the commands only.

    The spectrum of the noise also depends on the lag, but only if the noise is exactly as modelled. A recording with
    constant commands must not determine a time constant.
    """
    error, variance, judged, _, _ = (np.asarray(x) for x in _sensitivity(jnp.asarray(vector), tracks))
    clean = undisturbed(jnp.asarray(vector), tracks)
    _, _, _, slope, _ = (np.asarray(x) for x in _sensitivity(jnp.asarray(vector), clean))
    grain = np.array([_GRAIN.get(name, 0.5) for name in names])
    grain = grain / [{"motor_speed_offset": OFFSET_UNIT, "dead_time": DEAD_TIME_UNIT}.get(n, 1.0) for n in names]
    root = np.sqrt(variance)
    residual, jacobian = error / root, (slope / root[..., None]) @ basis * grain * judged[..., None]
    used = judged.reshape(-1, BLOCK).any(axis=1)
    jacobian_blocks = jacobian.reshape(-1, BLOCK, len(names))[used]
    uncertainty = assess(Scores.of(residual.reshape(-1, BLOCK)[used], jacobian_blocks), names)
    flat = jacobian_blocks.reshape(-1, len(names))
    plain = np.sqrt(np.maximum(np.diag(np.linalg.pinv(flat.T @ flat)), 1e-300))
    white = [row[mask > 0] for row, mask in zip(residual, judged, strict=True)]
    power = sum(np.sum(w**2) for w in white)
    return Optimum(
        names=names,
        vector=vector,
        loss=loss,
        rows=data.rows,
        uncertainty=uncertainty,
        directions=basis * grain,
        inflation=np.maximum(uncertainty.std / plain, 1.0),
        whiteness=float(sum(w[1:] @ w[:-1] for w in white) / max(power, 1e-300)),
        outliers=float(np.mean(np.abs(np.concatenate(white)) > 5.0)),
    )


assert 2 * ROWS % BLOCK == 0
