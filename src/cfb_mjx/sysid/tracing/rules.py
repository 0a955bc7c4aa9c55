"""Thresholds of the search: when an effect is significant, plausible and worth adding.

For example:

    close_loop(fit, held_out, base, rules=replace(RULES, alpha=1e-3))
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cfb_mjx.model.effects import KNOWN
from cfb_mjx.sysid.tracing.evidence import Evidence
from cfb_mjx.sysid.tracing.hypothesis import SHIFT, Fit, Hypothesis


@dataclass(frozen=True)
class Rules:
    """Thresholds for trying, accepting and reporting effects.

    A share is a fraction of a prediction error unless stated otherwise. *t* is a statistic that is standard normal if
    the effect explains nothing. Nats are units of log-likelihood on cross-validation blocks.
    """

    # All effects.
    alpha: float = 1e-2
    """An effect's p-value, multiplied by the number of effects tried (Bonferroni), must be below this."""
    least_gain: float = 5.0
    """An effect must gain more nats than this."""
    material: float = 0.05
    """An effect must lower at least one prediction error (four quantities, two horizons) by this share."""
    of_first: float = 0.02
    """An effect must also lower an error by this share of the declared model's error, so that the search does not
    pursue the small remainder of a large error."""
    clear: float = 8.0
    """An effect with a t above this needs to be material in one flight only. An effect that few flights excite (yaw
    above all) is hidden by the errors of the other flights, and such a t cannot arise by chance."""
    implausible: float = 2.0
    """An effect fitted beyond this multiple of its plausible strength is rejected: it stands in for another one."""
    smallest_shift: float = 0.0015
    """A time shift of the motor columns smaller than this, s, is due to commands between rows and is no fault."""
    doubtful: float = 2.3
    """An effect with a t on the held-out flights below this is not reported."""

    # Adding one effect after another.
    largest: int = 6
    """Maximum number of effects."""
    contenders: int = 3
    """Number of effects at the top of a ranking that are fitted."""
    contender: float = 0.5
    """Those effects must gain at least this share of the first one's nats."""
    parsimony: float = 0.02
    """A rival with fewer parameters is preferred if its gain falls short of the largest by at most this share."""
    close: float = 0.1
    """A rival whose gain falls short of the winner's by at most this share is reported as confusable with it."""
    same_errors: float = 0.03
    """Among such rivals, those whose prediction error (mean logarithm) exceeds the lowest by at most this are tried
    first."""
    rivals: int = 3
    """Number of effects that are tried alone in place of several."""
    as_good: float = 0.03
    """One effect replaces several if no error grows by more than this share."""
    patience: int = 3
    """The search ends after this many rounds in a row in which no significant candidate was accepted."""

    # Many effects missing at once.
    many: int = 3
    """If at least this many effects are clearly jointly significant, they are added together."""
    far_off: float = 1 / 3
    """A model is far off if its error after half a second exceeds this share of the error of `hold`."""
    looks: int = 5
    """Maximum number of linearisations in the selection of several effects."""
    look_steps: int = 12
    """Limit of the iterations of a fit then. In a fit that has not converged, other effects seem needless."""
    a_look: int = 20
    """Maximum number of effects selected per linearisation."""

    # Effects that few blocks excite.
    weakly_excited_gain: float = 8.0
    """Such an effect is tried if it gains more nats than this."""
    weakly_excited_t: float = 2.0
    """Such an effect is tried if its t is above this."""
    weakly_excited_tried: int = 2
    """Maximum number of trials, the largest gain first."""
    weakly_excited_sure: float = 4.0
    """Required t on the held-out flights: significant after a search through the whole catalogue."""

    # A formula, if the catalogue does not explain the residual.
    structure: float = 0.06
    """A formula or a rarely excited effect is accepted if it lowers an error by this share."""
    structure_of_first: float = 0.05
    """It must also lower an error by this share of the declared model's error, because an effect of a slightly wrong
    shape leaves a small residual."""
    term_alpha: float = 1e-3
    """A term's p-value, multiplied by the number of terms (Bonferroni), must be below this."""
    term_gain: float = 8.0
    """A term must gain more nats than this."""
    term_weakly_excited: float = 2.0
    """A term that few blocks excite must have a t above this."""
    term_needless: float = 2.0
    """A term that gains fewer nats than this in addition to the others is removed."""
    per_axis: int = 3
    """Maximum number of terms or families of terms along one axis."""
    of_family: float = 0.9
    """A single term is preferred to a family if it gains at least this share of the family's gain."""
    formula_sure: float = 3.0
    """A formula is accepted if its t on the held-out flights is at least this."""
    there_alone: float = 0.2
    """Terms that only the held-out flights show must lower an error by this share, and by this share of the declared
    model's error."""
    line_alpha: float = 1e-4
    """A spectral line's p-value, multiplied by the number of frequencies and axes examined, must be below this."""
    line_flights: int = 3
    """With at least this many held-out flights, a line must appear in these too."""
    same_line: float = 0.1
    """Maximum difference of the two frequencies, Hz."""

    # All effects fitted together, judged by predictions. Here shares are of the loss: errors divided by those of hold.
    better: float = 0.2
    """The joint fit must lower the search's error relative to `hold` by this share; otherwise the search's result is
    kept."""
    steps: int = 12
    """Maximum number of iterations of the fit."""
    tried: int = 2
    """Number of absent effects tried per round, the likeliest first."""
    rounds: int = 3
    """Maximum number of rounds of trials."""
    trial_steps: int = 5
    """Maximum number of iterations of a trial."""
    motor_rows: int = 12_000
    """Approximate number of rows to which the motor constants are fitted, from the middle of each flight."""
    motor_searched: int = 12_000
    """Approximate number of rows in which effects of the motors are searched for, in whole flights."""
    motor_looks: int = 2
    """Maximum number of linearisations in that search."""
    motor_piece: float = 3.0
    """Minimum duration of the piece used of each flight, s; it limits the number of flights (evenly spread)."""
    windows: int = 400
    """Maximum number of prediction windows in a fit."""
    gain: float = 0.05
    """A candidate must lower the loss by this share, and its first Gauss-Newton step must predict half of it."""
    worth: float = 0.005
    """An effect must lower the loss by this share in addition to all others."""
    confused: float = 0.9
    """Two effects are confusable if parameters of theirs have at least this correlation."""
    spreads: float = 2.0
    """Number of standard deviations between drones by which a declared parameter may move."""
    contradicts: float = 4.0
    """Innovations contradict predictions if the two values of a parameter differ by more than this many standard
    deviations and by more than ``differs``."""
    differs: float = 0.5
    """Required difference, as a share of the larger of the two values."""

    def significant(self, found: Evidence, tried: int) -> bool:
        """Whether evidence is significant, corrected for the number of effects ``tried``."""
        return found.p_value * tried < self.alpha and found.gain > self.least_gain

    def stretched(self, hypothesis: Hypothesis, name: str) -> bool:
        """Whether a strength of the effect is implausible; the effect then stands in for another one."""
        if name == SHIFT:
            return False
        effect, kind = hypothesis.effect(name), KNOWN[name]
        values = {field: np.asarray(getattr(effect, field)) for field in kind.strengths}
        ranges = {field: self.implausible * np.asarray(kind.prior[field]) for field in values}
        return any(np.any((v > ranges[f][1]) | (v < ranges[f][0])) for f, v in values.items())

    def worth_it(self, name: str, fit: Fit, richer: Fit, nothing: Fit, clear: bool) -> bool:
        """Whether a significant effect is plausible and improves predictions.

        Args:
            name: of the effect.
            fit: fit without the effect.
            richer: fit with the effect.
            nothing: fit of the declared model.
            clear: whether the effect's t is above `clear`.
        """
        if not np.isfinite(richer.errors).all() or self.stretched(richer.hypothesis, name):
            return False
        if name == SHIFT and abs(richer.hypothesis.shift) < self.smallest_shift:
            return False
        return np.log(richer.errors / fit.errors).sum() <= 0 and self.lowers(fit, richer, nothing, clear)

    def lowers(self, fit: Fit, richer: Fit, nothing: Fit, clear: bool) -> bool:
        """Whether the richer fit lowers an error materially, over all flights or, if ``clear``, in one of them."""
        shares = self.material, self.of_first
        if enough(fit.errors, richer.errors, nothing.errors, *shares):
            return True
        return clear and enough(fit.by_flight, richer.by_flight, nothing.by_flight, *shares)

    def missed(self, poorer: Fit, richer: Fit, clear: bool) -> bool:
        """Whether one of many effects lowers an error materially in addition to all others.

        It must do so over all flights or, if ``clear``, by twice the share in one flight. The declared model's error is
        not a useful reference here, because with many effects missing it is very large.
        """
        if np.max(1 - richer.errors / poorer.errors) >= self.material:
            return True
        return clear and bool(np.max(1 - richer.by_flight / poorer.by_flight) >= 2 * self.material)

    def lowered(self, old: np.ndarray, new: np.ndarray, first: np.ndarray) -> bool:
        """Whether a formula or a rarely excited effect lowers an error materially and does not raise the mean error.

        Args:
            old: errors without it.
            new: errors with it.
            first: errors of the declared model.
        """
        return enough(old, new, first, self.structure, self.structure_of_first) and np.log(new / old).sum() <= 0


def enough(poorer: np.ndarray, better: np.ndarray, first: np.ndarray, share: float, of_first: float) -> bool:
    """Whether an error drops by ``share`` of itself, and one by ``of_first`` of the declared model's (``first``)."""
    return bool(np.max(1 - better / poorer) >= share and np.max((poorer - better) / first) >= of_first)


RULES = Rules()
