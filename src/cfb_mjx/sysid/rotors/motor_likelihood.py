"""Maximum likelihood of a motor's constants and noise levels together, and how sure the data make them."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from cfb_mjx.sysid.identification.uncertainty import Uncertainty, assess
from cfb_mjx.sysid.rotors.motor_filter import (
    DEAD_TIME_UNIT,
    NAMES,
    OFFSET_UNIT,
    Motor,
    innovations,
    negative_log_likelihood,
)
from cfb_mjx.sysid.rotors.motor_filter import simulate as simulate_tracks
from cfb_mjx.sysid.rotors.motor_tracks import ROWS, MotorData, Tracks

ROUNDS, STEPS = 12, 8
"""Few steps between updates of the Fisher information: far from the optimum it changes a lot."""
BLOCK = 256
"""Events (two for each row) of a bootstrap block."""
# One unit of `assess` each; a constant that is free by more than half of it counts as unknown: K and the time constants
# by 25 %, the offset by 250 rad/s, the dead time by 5 ms.
_GRAIN = {"motor_gain": 0.5, "motor_speed_offset": 500.0, "dead_time": 0.01}
_SIZE, _NOISE = 8, 5
PRIOR = 3.0
"""Standard deviation of the weak prior about the first guess on all unknowns but the gain: a factor 20 in lags and
noise levels, 3000 rad/s of offset, 30 ms of dead time."""


@dataclass(frozen=True)
class Optimum:
    """Where the likelihood of one model variant is largest.

    Attributes:
        names: constants that were free; ``motor_time_constant`` moves spin-up and spin-down together.
        vector: (8,) of `Motor.from_vector`.
        loss: negative log-likelihood, nats.
        rows: that were judged.
        uncertainty: of the free constants, in units of `grain`; from command-driven changes only.
        directions: (8, k) change of the vector by one grain of each free constant.
        inflation: (k,) by how much the bootstrap widened the standard deviations.
        whiteness: lag-one correlation of the innovations, near 0 when the noise model fits.
        outliers: share of the innovations beyond five standard deviations.
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
        """Constants and noise levels, as numbers."""
        return jax.tree.map(float, Motor.from_vector(jnp.asarray(self.vector)))

    def value(self, name: str) -> float:
        """A constant, SI."""
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
    """(8,) vector to start from: the model's constants, K and the reading noise as the data show them."""
    seen = data.speed_per_command
    gain = seen if np.isfinite(seen) and seen > 100 and offset == 0 else gain
    noise = np.clip(data.noise, 0.1, 100.0)
    return np.array([np.log(gain), offset / OFFSET_UNIT, *np.log([time_constant] * 2), 0.0, *np.log([noise, 10, 20])])


def maximise(data: MotorData, names: tuple[str, ...], start: np.ndarray) -> Optimum:
    """Free the constants ``names`` and the noise levels from ``start`` on; the rest keeps its value.

    The search runs in coordinates in which the Fisher information is the identity: the constants differ by orders of
    magnitude in how well they are known, and a quasi-Newton method is slow until it has learnt that.
    """
    tracks = jax.tree.map(jnp.asarray, data.tracks)
    basis = np.stack([_direction(name) for name in names] + list(np.eye(_SIZE)[_NOISE:]), axis=1)
    vector, loss = np.array(start), np.inf
    if "dead_time" in names and vector[4] == 0.0:
        # The likelihood has a kink where commands coincide with rows; a search that starts on it may stay there.
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
        # What does not matter would otherwise wander off without end.
        prior = 0.5 * jnp.sum((x[1:] - start[1:]) ** 2) / PRIOR**2
        return negative_log_likelihood(Motor.from_vector(x), tracks) + prior

    # Few unknowns and many rows: forward mode costs half of what storing every step for the reverse does.
    loss = jax.custom_jvp(plain)

    @loss.defjvp
    def _(primals, tangents):
        slope, value = jax.jacfwd(lambda z: (plain(z),) * 2, has_aux=True)(*primals)
        return value, slope @ tangents[0]

    # z counts standard deviations, so the tolerance is a hundredth of one.
    solver = optx.BFGS(rtol=1e-9, atol=1e-2)
    found = optx.minimise(lambda z, _: loss(z), solver, jnp.zeros(_SIZE), max_steps=STEPS, throw=False)
    return vector + whitener @ found.value, plain(found.value), found.stats["num_steps"]


@eqx.filter_jit
def _sensitivity(vector, tracks: Tracks):
    """Innovations, variances, which are judged, and the derivatives of the first two by the vector; pieces first."""

    def whole(x):
        error, variance, judged = innovations(Motor.from_vector(x), tracks)
        return (error.T, variance.T), (error.T, variance.T, judged.T)

    slopes, found = jax.jacfwd(whole, has_aux=True)(vector)
    return *found, *slopes


@eqx.filter_jit
def undisturbed(vector, tracks: Tracks) -> Tracks:
    """The tracks as they would have been measured without any noise."""
    return eqx.tree_at(lambda t: t.rotor_speed, tracks, simulate_tracks(Motor.from_vector(vector), tracks))


def _whitener(vector, basis, tracks) -> np.ndarray:
    """(8, 8) map from unit-information coordinates to changes of the vector; columns beyond the free ones are zero."""
    _, s, _, de, ds = (np.asarray(x) for x in _sensitivity(jnp.asarray(vector), tracks))
    de, ds = de @ basis, ds @ basis
    information = np.einsum("sni,snj->ij", de / s[..., None], de)
    information += 0.5 * np.einsum("sni,snj->ij", ds / s[..., None] ** 2, ds)
    # A step of the search may not exceed a factor e^2 in what the data do not see.
    factor = np.linalg.cholesky(information + np.eye(basis.shape[1]) / 4)
    directions = np.linalg.solve(factor, basis.T).T
    return np.pad(directions, ((0, 0), (0, _SIZE - basis.shape[1])))


def _judge(data, tracks, names, basis, vector, loss) -> Optimum:
    """Uncertainty from the response to the commands alone.

    The colour of the noise also depends on the lag, but only if the noise is exactly as modelled; a recording in which
    the commands never move must not yield a time constant.
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
    uncertainty = assess(residual.reshape(-1, BLOCK)[used], jacobian_blocks, names)
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
