"""Maximum-likelihood estimate of a motor's constants and noise levels, and its uncertainty."""

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
    return eqx.tree_at(lambda t: t.rotor_speed, tracks, simulate_tracks(Motor.from_vector(vector), tracks))


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
