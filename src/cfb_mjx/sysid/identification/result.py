"""Result of a fit, and its conversion to a model file."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.parameters import SPECIFICATIONS, Entry, ModelFile, Parameters
from cfb_mjx.sysid.fitted import Estimate, numbers_of
from cfb_mjx.sysid.identification.filters import Feedback
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.uncertainty import Uncertainty, power_product
from cfb_mjx.sysid.identification.unknowns import GROUPS, OFFSETS, UNITS, Unknowns, at_the_border


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    Attributes:
        estimator: ``innovation`` or ``shooting``.
        estimates: identified parameters.
        unidentifiable: parameters that the data do not determine: name to explanation.
        combinations: products of powers that are known better than their factors, such as ``inertia_xx / mass``; SI.
        parameters: parameters of the drone with all fitted values, including those not identified alone; together they
            describe the flights.
        uncertainty: covariance and unidentified directions.
        names: of the fitted parameters.
        values: all fitted values, SI, identified or not.
        vector: (k,) all unknowns in the optimiser's units (`cfb_mjx.sysid.identification.unknowns`).
        rows: number of measured rows (innovation) or windows (shooting) that were fitted.
        hold: how long a logged command acted, s (innovation); None: until the next row.
        contradicted: parameters that were not requested but are fitted too, because the flights contradict their fixed
            values.
        unexplained: parameters whose fixed values the flights contradict, but for which no possible value fits them:
            the model lacks something else.
        noise: noise levels (innovation).
        whiteness: lag-one correlation of the innovations per channel; near 0 if the noise model is right (innovation).
        feedback: test of whether the commands responded to the gyro (innovation).
    """

    estimator: str
    estimates: dict[str, Estimate]
    unidentifiable: dict[str, str]
    combinations: dict[str, Estimate]
    parameters: Parameters
    uncertainty: Uncertainty
    names: tuple[str, ...]
    values: dict[str, float]
    vector: np.ndarray
    rows: int
    hold: float | None = None
    contradicted: tuple[str, ...] = ()
    unexplained: tuple[str, ...] = ()
    noise: Noise | None = None
    whiteness: dict[str, float] | None = None
    feedback: Feedback | None = None

    def model_file(self, base: ModelFile, source: str) -> ModelFile:
        """Write the fitted constants and their uncertainty into a copy of a model file.

        Args:
            base: the model file to copy.
            source: origin of the fitted constants, for the file.

        Raises:
            CfbError: a fitted value is impossible; the message names it.

        Warns:
            CfbWarning: a fitted value is unusual.
        """
        return _describe(base, self, source)

    def to_json(self) -> dict:
        """All results as a JSON-compatible dictionary."""
        return {
            "parameters": numbers_of(self.estimates),
            "unidentifiable": list(self.unidentifiable),
            "unidentifiable_because": self.unidentifiable,
            "combinations": numbers_of(self.combinations),
            "held_fixed_contradicted": list(self.contradicted),
            "held_fixed_unexplained": list(self.unexplained),
            "command_hold_s": self.hold,
            "correlation": {"names": self.uncertainty.order, "matrix": self.uncertainty.correlation},
            "estimator": self.estimator,
            "feedback": self.feedback and {"correlation": self.feedback.correlation, "p_value": self.feedback.p_value},
            "innovation_lag_one_correlation": self.whiteness,
            "noise": None if self.noise is None else vars(self.noise),
            "rows": self.rows,
        }


def summarise(
    unknowns: Unknowns,
    vector,
    uncertainty: Uncertainty,
    estimator: str,
    rows: int,
    names: tuple[str, ...] | None = None,
    impossible: dict[str, str] | None = None,
    **more,
) -> Fit:
    """Assemble a `Fit` at the optimum ``vector`` (k,), with estimates only of parameters that the data determine.

    Only ``names`` are reported, by default all unknowns. Those in ``impossible`` get its reason instead of an estimate.
    """
    impossible = impossible or {}
    names = unknowns.names if names is None else names
    every = dict(zip(unknowns.names, map(float, np.asarray(unknowns.values(vector))), strict=True))
    preset = dict(zip(unknowns.names, map(float, np.asarray(unknowns.values(unknowns.start))), strict=True))
    scale = dict(zip(unknowns.names, unknowns.scale(vector), strict=True))
    std = dict(zip(uncertainty.order, uncertainty.std, strict=True))
    return Fit(
        estimator=estimator,
        estimates={
            name: Estimate(every[name], float(std[name] * scale[name]), UNITS[name], preset[name])
            for name in names
            if name not in uncertainty.names and name not in impossible
        },
        unidentifiable={name: reason for name, reason in (_reasons(uncertainty) | impossible).items() if name in names},
        combinations=_combinations(uncertainty, every, tuple(name for name in names if name not in impossible)),
        parameters=unknowns.apply(vector),
        uncertainty=uncertainty,
        names=names,
        values={name: every[name] for name in names},
        vector=np.asarray(vector),
        rows=rows,
        hold=every["command_hold"] if "command_hold" in std else None,
        **more,
    )


def _combinations(uncertainty: Uncertainty, values: dict[str, float], names: tuple[str, ...]) -> dict[str, Estimate]:
    """Products of powers that are known better than their factors."""
    order, covariance, found = uncertainty.order, uncertainty.covariance, {}

    def put(powers: dict[str, float], std: float):
        value = float(np.prod([values[name] ** power for name, power in powers.items()]))
        found[power_product(powers)] = Estimate(value, value * std, "SI", np.nan)

    for powers, std in uncertainty.products:
        if all(name in names and name not in OFFSETS for name in powers):
            put(powers, std)
    if "mass" in order and "mass" not in names:
        m = order.index("mass")
        for i, name in enumerate(order):
            slope = covariance[i, m] / covariance[m, m]
            shared = slope * covariance[i, m]
            told = name in names and name not in uncertainty.names and name not in OFFSETS
            if told and shared > 0.5 * covariance[i, i]:
                put({name: 1.0, "mass": -float(f"{slope:.3g}")}, float(np.sqrt(covariance[i, i] - shared)))
    return found


def _reasons(uncertainty: Uncertainty) -> dict[str, str]:
    """Reasons why the unidentified parameters have no estimate."""
    reasons = {}
    for name in uncertainty.names:
        known = [text for text in uncertainty.combinations if name in text.split() or f"{name}," in text.split()]
        reasons[name] = f"{name} alone; they tell {', '.join(known)}" if known else f"{name}: they do not depend on it"
    return {name: f"these flights cannot tell {reason}" for name, reason in reasons.items()}


_FILE_KEYS = (
    "mass",
    "rotor_inertia",
    "motor_time_constant",
    "motor_gain",
    "motor_speed_offset",
    "thrust_scale",
    "torque_scale",
    "pose_delay",
)
_AXES = GROUPS["inertia"]
_KEYS = {
    **dict.fromkeys(_AXES, "inertia"),
    **dict.fromkeys(GROUPS["cog"], "center_of_gravity"),
    "thrust_linear": "thrust_polynomial",
}
"""Keys of a model file, where they are not the names in a fit."""


def impossible(names: tuple[str, ...], parameters: Parameters) -> set[str]:
    """Those parameters of a fit (`unknowns.UNITS`) that have values which no drone has."""
    border = set(GROUPS["inertia"]) & set(at_the_border(parameters))
    return {name for name in names if name in border or not _is_possible(name, parameters)}


def _is_possible(name: str, parameters: Parameters) -> bool:
    key = _KEYS.get(name, name)
    if key not in SPECIFICATIONS:  # of the log, not of the drone
        return True
    try:
        SPECIFICATIONS[key].check(np.asarray(getattr(parameters, key)), name)
    except CfbError:
        return False
    return True


def _describe(base: ModelFile, result: Fit, source: str) -> ModelFile:
    entries = dict(base.entries)

    def put(key, value, std, note=""):
        try:
            SPECIFICATIONS[key].check(value, f"the fit's parameters.{key}", warn=True)
        except CfbError as error:
            raise CfbError(f"{error} Leave it out of --parameters, or fit flights that determine it.") from None
        entries[key] = Entry(np.asarray(value, dtype=float), source + note, std)

    def deviation(name):
        return result.estimates[name].std if name in result.estimates else None

    for name in _FILE_KEYS:
        if name in result.names:
            std = deviation(name)
            value = np.asarray(getattr(result.parameters, name))
            put(
                name, value, None if std is None else np.full(value.shape, std), "" if std else "; not identified alone"
            )
    axes = [name for name in _AXES if name in result.names]
    if axes:
        std = np.array([deviation(name) or np.nan for name in _AXES])
        put("inertia", result.parameters.inertia, std if np.isfinite(std).all() else None, f" ({', '.join(axes)})")
    if "thrust_linear" in result.names:
        put("thrust_polynomial", result.parameters.thrust_polynomial, None, " (linear coefficient)")
    if "cog_x" in result.names or "cog_y" in result.names:
        std = np.array([deviation(name) or np.nan for name in ("cog_x", "cog_y")] + [0.0])
        put("center_of_gravity", result.parameters.center_of_gravity, std if np.isfinite(std).all() else None)
    return replace(base, entries=entries)
