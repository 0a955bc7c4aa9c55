"""The gate behind every reader: a log that contradicts itself is named, with the change that mends it."""

from __future__ import annotations

import dataclasses

import numpy as np

from cfb_mjx.logs import consistency, motor_checks
from cfb_mjx.logs.consistency import ORDER, Relation
from cfb_mjx.logs.fixes import TIMES, Fix, candidates, fix_of, motor_fixes
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.gaps import changes

_ROWS = 6000  # of a long log that decide: the liveliest stretch
_UNTOLD, _GONE = 0.5, 2.0  # cost of an axis that moved before a change and does not after it, or cannot be compared
_SHORT, _RUSHED, _FARTHER = 1.0, 5.0, 0.1  # s that are too short to compare; ratio; m
_DISORDER = 0.2  # share of rows whose position leaps
_UNIT = 0.13  # by which a slope may be off after a change of unit: estimators stretch velocities by a tenth
_MUCH = 1.5  # of the cost that a change takes off without mending all
_ALIKE = 0.1  # changes that leave about as little are told as alternatives
_PAIRS = 3  # of the best single changes are tried with a second one
_MOTORS_TELL = 0.6
_NAMES = {
    "displacement": "the position moves {slope:.2f} times as far along {axis} as the velocity says",
    "attitude": "the attitude turns {slope:.2f} times as fast about {axis} as the gyro says",
    "velocity": "the velocity changes {slope:.2f} times as much along {axis} as the accelerometer says",
    "gravity": "the specific force ax ay az reads {slope:.3g} g upwards in the mean",
    "upright": "the specific force along z has a median of {slope:.3g} g (body axes are forward, left, up)",
    "drag": "the accelerometer says that the air pushes along {axis} the way the drone moves, or across it",
}


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What the signals of a log say about each other.

    Attributes:
        relations: of pose, velocity, gyro, accelerometer.
        agreement: mean correlation of roll and pitch with the motors as they stand, by ``rotor_speed`` and
            ``command``; what does not tell is left out.
        problem: the contradiction, as half a sentence; None where there is none.
        remedy: changes that make all agree; empty where none was found.
        alternatives: other changes that do so as well.
        left: how many comparisons still disagree with the remedy.
        certain: that it is a fault though no change mends it.
    """

    relations: list[Relation]
    agreement: dict[str, float]
    problem: str | None = None
    remedy: tuple[Fix, ...] = ()
    alternatives: tuple[Fix, ...] = ()
    certain: bool = False
    left: int = 0

    def sentence(self) -> str:
        """The problem and what to do, without a full stop."""
        if not self.remedy:
            return str(self.problem)
        words = ", and ".join(fix.words for fix in self.remedy)
        flags = " ".join(f"--fix {fix.name}" for fix in self.remedy)
        others = "".join(f"; --fix {fix.name} would too" for fix in self.alternatives)
        all_but = f"all signals agree but for {self.left} comparisons" if self.left else "all signals agree"
        return f"{self.problem}; {words}: that makes {all_but} ({flags} does it{others})"

    def report(self) -> dict:
        """In JSON terms."""
        rows = [dataclasses.asdict(r) | {"contradicts": r.contradicts} for r in self.relations]
        return {"relations": rows, "motors": self.agreement}

    def summary(self) -> str:
        """One line: what agrees, and what moves too little to tell."""
        agree, gentle = {}, {}
        for r in self.relations:
            if r.name not in ("gravity", "upright", "drag") and not r.contradicts:
                (agree if r.moves else gentle).setdefault(r.name, []).append(r.axis)
        said = [f"{name} {' '.join(axes)}" for name, axes in agree.items()]
        motors = [name for name, value in self.agreement.items() if value > _MOTORS_TELL]
        if motors:
            said.append("motors")
        text = f"signals agree: {', '.join(said)}" if said else "signals: nothing moves enough to compare them"
        rest = [f"{name} {' '.join(axes)}" for name, axes in gentle.items()]
        rest += [] if motors or self.problem else ["motors"]
        return f"{text}; too gentle to tell: {', '.join(rest)}" if rest and said else text


def judge(log: FlightLog) -> Verdict:
    """Compare all signals of a log with each other."""
    relations = _independent(log, consistency.kinematics(log))
    bad = [r for r in relations if r.contradicts]
    if bad and (disorder := _disorder(log)) is not None:
        return Verdict(relations, {}, disorder, certain=True)
    if bad:
        problem = _worst(bad)
        remedy, alternatives, left = _remedy(_liveliest(log))
        heavy = any(r.name in ("gravity", "upright") for r in bad)
        if not remedy:
            problem += consistency.when(log, max(bad, key=lambda r: r.unexplained))
        if heavy and not remedy:
            problem += "; give what the accelerometer reads, gravity included, in m/s^2"
        return Verdict(relations, {}, problem, remedy, alternatives, heavy, left)
    if (rushed := _rushed(log)) is not None:
        return Verdict(relations, {}, *rushed, certain=True)
    if (repeated := _repeated(log)) is not None:
        return Verdict(relations, {}, repeated, certain=True)
    return _judge_motors(log, relations)


def _independent(log: FlightLog, relations: list[Relation]) -> list[Relation]:
    """Without those between a signal and what was derived from it."""
    made = log.metadata.get("variables") or {}
    derived = {name for field, name in _OF.items() if "derived" in (made.get(field) or {})}
    return [r for r in relations if r.name not in derived]


_OF = {"velocity": "displacement", "body_rate": "attitude", "specific_force": "velocity"}


def _worst(bad: list[Relation]) -> str:
    # Gravity first, it is the plainest.
    worst = max(bad, key=lambda r: (r.name in ("gravity", "upright"), r.name == "upright", min(r.unexplained, 4.0)))
    text = _NAMES[worst.name].format(slope=worst.slope, axis=worst.axis)
    if worst.name not in ("gravity", "upright"):
        text += f" (correlation {worst.correlation:.2f})"
    more = len(bad) - 1
    return f"{text}, and {more} more comparison{'s' * (more > 1)} disagree" if more else text


def _liveliest(log: FlightLog) -> FlightLog:
    if len(log) <= _ROWS:
        return log
    activity = np.cumsum(np.sum(log.body_rate**2, axis=1) + np.sum(log.velocity**2, axis=1))
    start = int(np.argmax(activity[_ROWS:] - activity[:-_ROWS]))
    return log.rows(slice(start, start + _ROWS))


def _cost(relations: list[Relation], moved: frozenset) -> tuple[float, int]:
    """How little the relations agree, and how many contradict."""
    cost = sum(min(r.unexplained, 2.0) for r in relations if r.moves)
    there = {(r.name, r.axis) for r in relations}
    still = moved & {(r.name, r.axis) for r in relations if r.moves and r.name != "drag"}
    kinds = {pair for pair in moved if pair[0] != "drag"}
    cost += _UNTOLD * len((kinds & there) - still) + _GONE * len(kinds - there)
    return cost, sum(r.contradicts for r in relations)


def _remedy(log: FlightLog) -> tuple[tuple[Fix, ...], tuple[Fix, ...], int]:
    """Changes that make signals agree, others that do as well, and how many comparisons still disagree.

    One change that mends all, else two; else the one that mends most, if that is much.
    """
    relations = consistency.kinematics(log)
    moved = frozenset((r.name, r.axis) for r in relations if r.moves)
    before, many = _cost(relations, moved)
    with np.errstate(all="ignore"):
        tried = sorted(_tried(log, moved), key=lambda t: (round(t[0] / 0.02), t[3]))
        found = [((fix,), cost) for cost, bad, fix, _ in tried if not bad]
        if not found:
            for _, _, first, _ in tried[:_PAIRS]:
                found += [((first, fix), cost) for cost, bad, fix, _ in _tried(first.apply(log), moved) if not bad]
            found.sort(key=lambda f: round(f[1] / 0.02))
    if not found:
        cost, left, fix, _ = tried[0]
        return ((fix,), (), left) if cost < before - _MUCH and left < many else ((), (), 0)
    if found[0][1] > before - 0.2:
        return (), (), 0
    best, least = found[0]
    part = best[-1].name.split("=")[0]
    others = [f[0] for f, cost in found[1:] if len(best) == 1 and cost < least + _ALIKE]
    # Of another part, or another unit of the same: a velocity that is 10 % off is feet or kilometres an hour.
    others = [fix for fix in others if fix.name.split("=")[0] != part or part.endswith("-unit")]
    others = [fix for fix in others if part.endswith("-unit") or fix.name.split("-")[0] != part.split("-")[0]]
    return best, tuple(others[:2]), 0


def _tried(log: FlightLog, moved: frozenset) -> list[tuple[float, int, Fix, int]]:
    found = []
    for rank, fix in enumerate(candidates()):
        if not fix.name.startswith("command"):
            relations = consistency.kinematics(fix.apply(log))
            cost, bad = _cost(relations, moved)
            if np.isfinite(cost) and _exact(fix, relations):
                found.append((cost, bad, fix, rank))
    return found


def _exact(fix: Fix, relations: list[Relation]) -> bool:
    """Whether a change of scale brings slopes to one: a sensor that is 40 % off is a fault to find, not knots."""
    if "unit" not in fix.name and "scale" not in fix.name:
        return True
    compared = [r for r in relations if r.moves and r.name in ("displacement", "attitude", "velocity")]
    return all(abs(r.slope / max(r.correlation, 0.1) - 1) < _UNIT for r in compared if r.correlation > 0.8)


def _rushed(log: FlightLog) -> tuple[str, tuple[Fix, ...]] | None:
    """A log too short to compare, whose path is many times as long as its velocities allow: time in another unit."""
    if log.duration > _SHORT or len(log) < 20:
        return None
    steps = np.diff(log.time)[:, None]
    travelled = np.cumsum((log.velocity[1:] + log.velocity[:-1]) / 2 * steps, axis=0)
    moved, told = (float(np.linalg.norm(np.ptp(x, axis=0))) for x in (log.position, travelled))
    if moved < _FARTHER or moved < _RUSHED * told:
        return None
    ratio = moved / max(told, 1e-9)
    known = {f"time-unit={unit}": scale for unit, scale in TIMES.items()} | {"time-scale=10": 10.0}
    fixes = tuple(fix_of(name) for name, scale in known.items() if 0.5 < ratio / scale < 2.0)
    return f"in {log.duration:.2g} s the position moves {ratio:.0f} times as far as the velocity says", fixes


def _disorder(log: FlightLog) -> str | None:
    """Rows that do not follow each other: the position leaps everywhere."""
    step = np.diff(log.time)
    moved = np.linalg.norm(np.diff(log.position, axis=0), axis=1)
    speed = np.linalg.norm(log.velocity[1:] + log.velocity[:-1], axis=1) / 2
    reach = float(np.linalg.norm(np.ptp(log.position, axis=0)))
    leaps = (moved > 20 * speed * step + 0.02 * reach) & (moved > 0.01)
    # A unit that is wrong stretches all steps alike, and leaves the path smooth.
    bend = np.linalg.norm(np.diff(log.position, n=2, axis=0), axis=1)
    rough = float(np.median(bend)) > 0.5 * float(np.median(moved)) and float(np.median(moved)) > 0.02 * reach
    if leaps.mean() < _DISORDER or not rough:
        return None
    return (
        f"the position leaps in {leaps.mean():.0%} of the rows, so rows do not stand in order of time; sort them by it"
    )


def _repeated(log: FlightLog) -> str | None:
    """Rows that come again, to the last bit: a copy pasted behind the original, or rows out of order."""
    # Of one attitude's two quaternions the same: a copy may have got the other sign.
    q = log.quaternion * np.where(log.quaternion[:, :1] < 0, -1.0, 1.0)
    rows = np.concatenate([log.position, log.velocity, q, log.body_rate, log.specific_force], axis=1)
    kept = np.flatnonzero(changes(rows))
    # Only rows in which something moves: a simulated hover repeats itself.
    kept = kept[np.abs(log.body_rate[kept]).max(axis=1) > 1e-3]
    if len(kept) < 20:
        return None
    _, first, inverse = np.unique(rows[kept], axis=0, return_index=True, return_inverse=True)
    again = np.flatnonzero(first[np.ravel(inverse)] != np.arange(len(kept)))
    if len(again) < max(5, 0.01 * len(kept)):
        return None
    row = kept[again[0]]
    return (
        f"{len(again)} rows from {log.time[row]:.2f} s on repeat earlier rows to the last bit, so a part of the log "
        "was copied; delete the copy"
    )


def _judge_motors(log: FlightLog, relations: list[Relation]) -> Verdict:
    if (unfollowed := motor_checks.followed(log)) is not None:
        return Verdict(relations, {}, *unfollowed)
    agreement, moving = {}, {}
    for source in ("rotor_speed", "command"):
        found = consistency.agreement(log, source)
        if found:
            agreement[source] = found[ORDER, 1]
            # Inverted commands turn the drone as another order does; only its thrust tells them apart.
            likely = -1 if motor_checks.heaves_against(log, source) else 1
            best = max(found, key=lambda key: (round(found[key], 3), key[1] * likely))
            if found[best] > _MOTORS_TELL and found[best] - found[ORDER, 1] > motor_checks.BETTER:
                moving[source] = best, found[best]
    for source, ((order, sign), value) in moving.items():
        what = "rotor speeds" if source == "rotor_speed" else "commands"
        problem = (
            f"roll and pitch do not follow from the {what} as they stand (correlation {agreement[source]:.2f}; in "
            f"another order {value:.2f})"
        )
        return Verdict(relations, agreement, problem, motor_fixes(order, sign))
    problem = motor_checks.implausible(log)
    return Verdict(relations, agreement, problem, certain=problem is not None)
