"""When an effect counts: the rules of a search in one place. Beyond chance, plausible, and worth something.

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
    """What is tried, what is taken in, and what is reported.

    Shares are of a prediction error unless said otherwise; *t* is a statistic that is standard normal by chance; nats
    are of log-likelihood on blocks left out.
    """

    # Any effect.
    alpha: float = 1e-2
    """An effect's p-value, times the number of effects tried, must be below this."""
    least_gain: float = 5.0
    """And it must gain so many nats."""
    material: float = 0.05
    """And lower at least one prediction error (four quantities, two horizons) by this share."""
    of_first: float = 0.02
    """And by this share of what the declared model scores, so that the last crumbs of a large error are not chased."""
    clear: float = 8.0
    """An effect whose t is above this need only be material in one flight: what few flights excite (yaw, most of all)
    drowns in the errors of the others, and no chance brings such a t about."""
    implausible: float = 2.0
    """An effect stretched to so many times its plausible strength stands in for another."""
    smallest_shift: float = 0.0015
    """Motor columns less late or early than this, s, are commands between rows rather than a fault."""
    doubtful: float = 2.3
    """An effect whose t on held-out flights is below this is not reported."""

    # One effect after another.
    largest: int = 6
    """Effects at most."""
    contenders: int = 3
    """So many effects of a ranking are fitted."""
    contender: float = 0.5
    """If they gain this share of the first's nats."""
    parsimony: float = 0.02
    """A rival with fewer numbers is preferred if it gains all but this share of the nats."""
    close: float = 0.1
    """A rival that gains all but this share of the winner's nats is named as confusable with it."""
    same_errors: float = 0.03
    """Of such rivals those are tried first whose prediction errors (mean logarithm) are the lowest but for this."""
    rivals: int = 3
    """So many effects are tried alone in place of several."""
    as_good: float = 0.03
    """In place of several, if no error grows by more than this share."""
    patience: int = 3
    """Candidates in a row that stand against chance but lower no error: then the search ends."""

    # Much missing at once.
    many: int = 3
    """So many that stand clearly beside each other and what was found are taken in together."""
    far_off: float = 1 / 3
    """A model lacks much if, after half a second, it errs by more than this share of what hold errs."""
    looks: int = 5
    """Looks at the inner products at most."""
    look_steps: int = 12
    """Of a fit at most: what is half way there makes others seem needless."""
    a_look: int = 20
    """Effects taken in at most in a look."""

    # What few blocks excite.
    rare_gain: float = 8.0
    """Nats from which such an effect is tried."""
    rare_t: float = 2.0
    """And t."""
    rare_tried: int = 2
    """Tried at most, the largest gain first."""
    rare_sure: float = 4.0
    """t on flights nothing was fitted to: beyond chance after a search through the catalogue."""

    # A formula, where the catalogue fails.
    structure: float = 0.06
    """What a search did not find (a formula, a rarely excited effect) counts when it lowers an error by this share."""
    structure_of_first: float = 0.05
    """And by this share of what the declared model scores: an effect of slightly another shape leaves crumbs."""
    term_alpha: float = 1e-3
    """A term's p-value, times the number of terms, must be below this."""
    term_gain: float = 8.0
    """And it must gain so many nats."""
    term_rare: float = 2.0
    """Least t of a term that few blocks excite."""
    term_needless: float = 2.0
    """A term that gains fewer nats beside the others is left out again."""
    per_axis: int = 3
    """Terms or families along one axis at most."""
    of_family: float = 0.9
    """A single term is preferred if it gains this share of what a family gains."""
    formula_sure: float = 3.0
    """A formula counts when its t on flights nothing was fitted to is above this."""
    there_alone: float = 0.2
    """Terms that only those flights show must lower an error by this share, and by as much of the declared model's."""
    line_alpha: float = 1e-4
    """A spectral line's p-value, times the number of places looked at, must be below this."""
    line_flights: int = 3
    """Held-out flights from which lines are looked for there too."""
    same_line: float = 0.1
    """Hz by which the two may differ."""

    # All at once, by predictions; shares of the loss, an error over what hold errs.
    better: float = 0.2
    """The whole must lower a search's error beside hold by this share, or the search's own findings stand."""
    steps: int = 12
    """Of a fit at most."""
    tried: int = 2
    """Absent effects tried at a time, the likeliest first."""
    rounds: int = 3
    """Of trials at most."""
    trial_steps: int = 5
    """Of a trial at most."""
    motor_rows: int = 12_000
    """That the motors are fitted to, about: the middles of flights."""
    motor_searched: int = 12_000
    """Rows in which effects of the motors are looked for, about: whole flights."""
    motor_looks: int = 2
    """Looks for them at most."""
    motor_piece: float = 3.0
    """Seconds of a flight at least, of so many flights evenly spread as that allows."""
    windows: int = 400
    """Predicted at most in a fit."""
    gain: float = 0.05
    """A candidate must lower the loss by this share, half of it in its first step."""
    worth: float = 0.005
    """An effect must lower it by this share beside all others."""
    confused: float = 0.9
    """Correlation of two effects' numbers from which they are hardly told apart."""
    spreads: float = 2.0
    """Standard deviations between drones that a declared number may move."""
    contradicts: float = 4.0
    """Standard deviations from which innovations contradict predictions, if they differ by ``differs`` at least."""
    differs: float = 0.5
    """As a share of the larger of both."""

    def significant(self, found: Evidence, tried: int) -> bool:
        """Whether evidence stands after so many tries."""
        return found.p_value * tried < self.alpha and found.gain > self.least_gain

    def stretched(self, hypothesis: Hypothesis, name: str) -> bool:
        """Whether an effect had to be stretched beyond what is plausible: then it stands in for another."""
        if name == SHIFT:
            return False
        effect, kind = hypothesis.effect(name), KNOWN[name]
        values = {field: np.asarray(getattr(effect, field)) for field in kind.strengths}
        ranges = {field: self.implausible * np.asarray(kind.prior[field]) for field in values}
        return any(np.any((v > ranges[f][1]) | (v < ranges[f][0])) for f, v in values.items())

    def worth_it(self, name: str, fit: Fit, richer: Fit, nothing: Fit, clear: bool) -> bool:
        """Whether an effect that stands against chance also predicts better, and is no other one in disguise.

        Args:
            name: the effect.
            fit: without it.
            richer: with it.
            nothing: the declared model.
            clear: whether its t is above `clear`.
        """
        if not np.isfinite(richer.errors).all() or self.stretched(richer.hypothesis, name):
            return False
        if name == SHIFT and abs(richer.hypothesis.shift) < self.smallest_shift:
            return False
        return np.log(richer.errors / fit.errors).sum() <= 0 and self.lowers(fit, richer, nothing, clear)

    def lowers(self, fit: Fit, richer: Fit, nothing: Fit, clear: bool) -> bool:
        """Whether the richer fit lowers an error by a share that matters, of all flights or, if ``clear``, of one."""
        shares = self.material, self.of_first
        if enough(fit.errors, richer.errors, nothing.errors, *shares):
            return True
        return clear and enough(fit.by_flight, richer.by_flight, nothing.by_flight, *shares)

    def missed(self, poorer: Fit, richer: Fit, clear: bool) -> bool:
        """Whether one effect of many matters beside all others, in all flights or, if ``clear``, twice as much in one.

        What the declared model scores, far off with many effects missing, is no measure of that.
        """
        if np.max(1 - richer.errors / poorer.errors) >= self.material:
            return True
        return clear and bool(np.max(1 - richer.by_flight / poorer.by_flight) >= 2 * self.material)

    def lowered(self, old: np.ndarray, new: np.ndarray, first: np.ndarray) -> bool:
        """Whether what a search did not find lowers an error by a share that matters, and errors on the whole."""
        return enough(old, new, first, self.structure, self.structure_of_first) and np.log(new / old).sum() <= 0


def enough(poorer: np.ndarray, better: np.ndarray, first: np.ndarray, share: float, of_first: float) -> bool:
    """Whether an error is lowered by a share, and an error by a share of what the declared model (``first``) scores."""
    return bool(np.max(1 - better / poorer) >= share and np.max((poorer - better) / first) >= of_first)


RULES = Rules()
