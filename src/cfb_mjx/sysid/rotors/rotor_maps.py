"""Thrust and torque of a rotor from bench points: a cubic through the origin by linear least squares (paper eqs. 8-9).

``y(Omega) = c3 s^3 + c2 s^2 + c1 s`` with ``s = Omega / sigma``. A scale that was not tared adds a constant to every
point, which would bias the whole curve, so an offset is fitted if it is significant. Optionally every motor has its own
factor on the common curve (with mean one), and outliers are down-weighted (Huber, Robust Statistics, 1981, chapter 7).

A fitted cubic must rise with rotor speed and be positive, as that of every rotor.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import cast

import numpy as np

from cfb_mjx.errors import CfbError

SIGMA = 2900.0
"""Reference rotor speed of the paper, and about the fastest a rotor turns, rad/s."""


@dataclass(frozen=True)
class Shape:
    """Ranges of rotor speed (from, to), rad/s, in which a cubic is unphysical, between standstill and ``top``.

    Attributes:
        falling: ranges in which the curve does not increase with rotor speed.
        negative: ranges in which the curve is negative.
        measured: lowest and highest measured rotor speed, rad/s.
        top: upper end of the check, rad/s.
    """

    falling: tuple[tuple[float, float], ...]
    negative: tuple[tuple[float, float], ...]
    measured: tuple[float, float]
    top: float

    @property
    def increasing_where_measured(self) -> bool:
        """Whether the curve increases over the whole measured range."""
        low, high = self.measured
        return not any(a < high and b > low for a, b in self.falling)

    def notes(self) -> list[str]:
        """Remarks on the curve, one phrase each."""
        low, high = self.measured
        found = []
        for word, stretches in (("negative", self.negative), ("does not increase", self.falling)):
            for a, b in stretches:
                inside = a < high and b > low
                place = (
                    "within the measured range" if inside else "outside the measured range, an artefact of the cubic"
                )
                found.append(f"{word} from {a:.0f} to {b:.0f} rad/s ({place})")
        return found


def shape_of(coefficients: np.ndarray, measured: tuple[float, float], sigma: float = SIGMA) -> Shape:
    """Check a cubic through the origin from standstill to full speed (2900 rad/s, or the highest measured speed).

    Args:
        coefficients: (3,) of s^3, s^2, s with ``s = Omega / sigma``.
        measured: lowest and highest measured rotor speed, rad/s.
        sigma: reference rotor speed, rad/s.
    """
    c3, c2, c1 = coefficients
    top = max(SIGMA, measured[1])
    return Shape(
        falling=_stretches([3 * c3, 2 * c2, c1], top / sigma, sigma),
        negative=_stretches([c3, c2, c1], top / sigma, sigma),
        measured=measured,
        top=top,
    )


def _stretches(polynomial: list[float], top: float, sigma: float) -> tuple[tuple[float, float], ...]:
    """Ranges in (0, top) in which a polynomial is negative, scaled by ``sigma``."""
    roots = np.roots(polynomial)
    real = [float(r.real) for r in roots if abs(r.imag) < 1e-12 and 0 < r.real < top]
    edges = [0.0, *sorted(real), top]
    found = []
    for a, b in itertools.pairwise(edges):
        if np.polyval(polynomial, 0.5 * (a + b)) < 0:
            found.append((a * sigma, b * sigma))
    return tuple(found)


HUBER = 1.345
"""Threshold of the Huber loss, in standard deviations: 95 % efficient for normal noise."""
FEWEST_POINTS = 6
"""Smallest number of points of a fit."""
TARE = 3.0
"""An offset of all points is kept if it exceeds this many of its standard deviations."""
_TARE_LEVELS = 5
"""Number of different rotor speeds required to fit an offset alongside the three coefficients, with one to spare."""
_ITERATIONS = 50
"""Maximum number of iterations of the fit."""


@dataclass(frozen=True)
class MapFit:
    """A fitted curve.

    Attributes:
        coefficients: (3,) of s^3, s^2, s, as in `Parameters.thrust_polynomial`.
        covariance: (3, 3) of the coefficients.
        scale: (m,) factor of each motor, with mean one; empty if all motors share one curve.
        scale_std: (m,) standard deviations of the factors.
        motors: (m,) numbers of the motors that have factors.
        scale_p_value: p-value of the hypothesis that all factors are one (F test); NaN without factors.
        rotor_speed: (n,) of the points, rad/s.
        value: (n,) measured value, N or N m.
        residual: (n,) measured minus fitted value, N or N m.
        offset: constant excess of all points (a scale that was not tared), N or N m; 0 unless it exceeds `TARE`
            standard deviations. Not part of the curve.
        offset_std: standard deviation of the offset; 0 if it is not fitted.
        weight: (n,) weight of each point; below 1 for outliers in a robust fit.
        motor: (n,) motor number of each point.
        noise: (n,) standard deviation of a point, from the residuals (robust if requested) or as given, N or N m.
        shape: check of monotonicity and sign.
        sigma: reference rotor speed, rad/s.
    """

    coefficients: np.ndarray
    covariance: np.ndarray
    scale: np.ndarray
    scale_std: np.ndarray
    motors: tuple[int, ...]
    scale_p_value: float
    rotor_speed: np.ndarray
    value: np.ndarray
    residual: np.ndarray
    offset: float
    offset_std: float
    weight: np.ndarray
    motor: np.ndarray
    noise: np.ndarray
    shape: Shape
    sigma: float

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (3,) of the coefficients."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def outliers(self) -> np.ndarray:
        """Indices of points more than four standard deviations off the curve."""
        return np.flatnonzero(np.abs(self.residual) > 4 * self.noise)

    def curve(self, rotor_speed: np.ndarray) -> np.ndarray:
        """Value of the common curve at rotor speeds, N or N m."""
        return powers(rotor_speed, self.sigma) @ self.coefficients

    def curve_std(self, rotor_speed: np.ndarray) -> np.ndarray:
        """Standard deviation of the common curve, N or N m."""
        design = powers(rotor_speed, self.sigma)
        return np.sqrt(np.einsum("ni,ij,nj->n", design, self.covariance, design))

    def to_json(self) -> dict:
        """The curve and its points as a JSON-compatible dictionary."""
        return {
            "coefficients": self.coefficients,
            "covariance": self.covariance,
            "reference_rotor_speed_radps": self.sigma,
            "noise": self.noise[0],
            "offset": self.offset,
            "offset_std": self.offset_std,
            "increasing_where_measured": self.shape.increasing_where_measured,
            "notes": self.shape.notes(),
            "scales_equal_p_value": self.scale_p_value,
            "points": {
                "motor": self.motor,
                "rotor_speed_radps": self.rotor_speed,
                "measured": self.value,
                "residual": self.residual,
                "weight": self.weight,
            },
        }


def powers(rotor_speed: np.ndarray, sigma: float = SIGMA) -> np.ndarray:
    """Columns s^3, s^2, s (n, 3) of the cubic."""
    s = np.asarray(rotor_speed, dtype=float) / sigma
    return np.stack([s**3, s**2, s], axis=-1)


def fit_map(
    rotor_speed: np.ndarray,
    value: np.ndarray,
    motor: np.ndarray | None = None,
    std: float | np.ndarray | None = None,
    robust: bool = False,
    per_motor: bool = False,
    sigma: float = SIGMA,
    name: str = "map",
    tared: bool = False,
) -> MapFit:
    """Fit thrust or torque as a cubic in rotor speed.

    Args:
        rotor_speed: (n,) rad/s.
        value: (n,) measured thrust, N, or torque, N m.
        motor: (n,) motor number of each point; by default all points are of one motor.
        std: standard deviation of the points, N or N m, for their weights; by default estimated from the residuals.
        robust: down-weight outliers.
        per_motor: fit a factor for each motor on the common curve.
        sigma: reference rotor speed, rad/s.
        name: of the data, for messages.
        tared: the scale is known to read zero at rest. Otherwise an offset is fitted if it exceeds `TARE` standard
            deviations; if it does not, its uncertainty is included in the covariance.

    Raises:
        CfbError: too few points or too few different speeds for a cubic.
    """
    speed, value = np.asarray(rotor_speed, float), np.asarray(value, float)
    motor = np.zeros(len(speed), int) if motor is None else np.asarray(motor, int)
    motors = tuple(sorted(set(motor.tolist()))) if per_motor else ()
    motors = motors if len(motors) > 1 else ()
    _enough(speed, motor, motors, name)
    given = None if std is None else np.broadcast_to(np.asarray(std, float), speed.shape)
    unit = np.ones(len(speed)) if given is None else given
    weight, noise = np.ones(len(speed)), unit
    member = np.array([motor == m for m in motors], float).T if motors else np.zeros((len(speed), 0))
    shared = not tared and _levels(speed) >= _TARE_LEVELS and len(speed) > FEWEST_POINTS + len(motors)
    untold = None
    while True:
        weight, noise = np.ones(len(speed)), unit
        design = np.concatenate([powers(speed, sigma), np.ones((len(speed), int(shared)))], axis=1)
        theta, scale, residual = np.zeros(design.shape[1]), np.ones(len(motors)), value
        free = len(speed) - design.shape[1] - max(len(motors) - 1, 0)
        for _ in range(_ITERATIONS):
            before = np.concatenate([theta, scale])
            theta, scale = _least_squares(design, member, value, np.sqrt(weight) / unit, scale)
            residual = value - _slopes(design, member, scale) @ theta
            noise = given if given is not None else np.full(len(speed), _spread(residual, free, robust))
            if robust:
                ratio = np.abs(residual) / noise
                weight = np.where(ratio > HUBER, HUBER / np.maximum(ratio, HUBER), 1.0)
            if np.abs(np.concatenate([theta, scale]) - before).max() <= 1e-12 * (1 + np.abs(before).max()):
                break
        covariance = _covariance(design, member, theta, scale, residual, noise, robust)
        if not shared or abs(theta[3]) > TARE * np.sqrt(covariance[3, 3]):
            break
        # An insignificant offset still adds uncertainty to the curve: that of the offset found, or of one standard
        # deviation if that is larger.
        shared, untold = False, (theta[:3], max(1.0, float(np.sqrt(covariance[3, 3]) / max(abs(theta[3]), 1e-300))))
    if untold is not None:
        moved = untold[1] * (untold[0] - theta[:3])
        covariance[:3, :3] += np.outer(moved, moved)
    spread = covariance[design.shape[1] :, design.shape[1] :]
    return MapFit(
        coefficients=theta[:3],
        covariance=covariance[:3, :3],
        scale=scale,
        scale_std=np.sqrt(np.diag(spread)),
        motors=motors,
        scale_p_value=_agreement(scale, spread, free),
        rotor_speed=speed,
        value=value,
        residual=residual,
        offset=float(theta[3]) if shared else 0.0,
        offset_std=float(np.sqrt(covariance[3, 3])) if shared else 0.0,
        weight=weight,
        motor=motor,
        noise=noise,
        shape=shape_of(theta[:3], (float(speed.min()), float(speed.max())), sigma),
        sigma=sigma,
    )


def _levels(speed: np.ndarray) -> int:
    """Number of different rotor speeds; points closer than 2 % of full speed count as one setting."""
    ordered = np.sort(speed[speed > 0])
    return 1 + int(np.sum(np.diff(ordered) > 0.02 * SIGMA)) if len(ordered) else 0


def _enough(speed: np.ndarray, motor: np.ndarray, motors: tuple[int, ...], name: str) -> None:
    if len(speed) < FEWEST_POINTS:
        raise CfbError(f"{name}: has {len(speed)} points, a cubic needs at least {FEWEST_POINTS}; measure more.")
    levels = _levels(speed)
    if levels < 3:
        raise CfbError(
            f"{name}: holds {levels} different rotor speeds, the three coefficients of a cubic need at least 3; "
            "measure between idle and full speed."
        )
    for m in motors:
        if np.sum(motor == m) < 2:
            raise CfbError(f"{name}: motor {m} has a single point; measure more, or fit without --per-motor.")


def _slopes(design, member, scale) -> np.ndarray:
    """Derivatives (n, 3 or 4) with respect to the coefficients, scaled by the motor's factor, and to the offset."""
    factor = member @ scale if member.shape[1] else np.ones(len(member))
    return np.concatenate([factor[:, None] * design[:, :3], design[:, 3:]], axis=1)


def _least_squares(design, member, value, root, scale):
    """One iteration: fit the curve given the factors, then the factors given the curve, and normalise their mean."""
    rows = root[:, None] * _slopes(design, member, scale)
    theta = np.linalg.lstsq(rows, root * value, rcond=None)[0]
    if member.shape[1]:
        curve = root * (design[:, :3] @ theta[:3])
        scale = (member.T @ (curve * root * (value - design[:, 3:] @ theta[3:]))) / (member.T @ curve**2)
        theta, scale = np.concatenate([theta[:3] * scale.mean(), theta[3:]]), scale / scale.mean()
    return theta, scale


def _spread(residual: np.ndarray, free: int, robust: bool) -> float:
    if robust:
        # Correct for the degrees of freedom; otherwise the noise of a small table is underestimated.
        return max(1.4826 * np.median(np.abs(residual)) * np.sqrt(len(residual) / free), 1e-12)
    return max(float(np.sqrt(residual @ residual / free)), 1e-12)


def _covariance(
    design: np.ndarray,
    member: np.ndarray,
    theta: np.ndarray,
    scale: np.ndarray,
    residual: np.ndarray,
    noise: np.ndarray,
    robust: bool,
) -> np.ndarray:
    """Covariance of the coefficients, the offset if there is one, and the factors, whose mean is fixed."""
    count, k = member.shape[1], design.shape[1]
    curve = (design[:, :3] @ theta[:3])[:, None]
    slopes = np.concatenate([_slopes(design, member, scale), member * curve], axis=1)
    # Restrict the factors to the space orthogonal to a common change.
    basis = np.eye(k + count)
    if count:
        within = np.linalg.svd(np.ones((1, count)))[2][1:].T
        basis = np.block([[np.eye(k), np.zeros((k, count - 1))], [np.zeros((count, k)), within]])
    triangle = cast(np.ndarray, np.linalg.qr((slopes / noise[:, None]) @ basis, mode="r"))
    inverse = np.linalg.inv(triangle)
    covariance = basis @ (inverse @ inverse.T) @ basis.T
    if not robust:
        return covariance
    ratio = residual / noise
    psi, slope = np.clip(ratio, -HUBER, HUBER), np.mean(np.abs(ratio) <= HUBER)
    return covariance * (psi @ psi / (len(psi) - triangle.shape[0])) / max(slope, 0.1) ** 2


def _agreement(scale: np.ndarray, covariance: np.ndarray, free: int) -> float:
    if not len(scale):
        return np.nan
    from jax.scipy.special import betainc

    freedom = len(scale) - 1
    f = float((scale - 1) @ np.linalg.pinv(covariance) @ (scale - 1)) / freedom
    return float(betainc(free / 2, freedom / 2, free / (free + freedom * f)))
