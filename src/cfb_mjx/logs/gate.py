"""Verdict on a log: whether its signals contradict each other, and which change of convention makes them agree."""

from __future__ import annotations

import dataclasses

import numpy as np

from cfb_mjx.logs import consistency, motor_checks
from cfb_mjx.logs.consistency import ORDER, Relation
from cfb_mjx.logs.fixes import TIMES, Fix, candidates, fix_of, motor_fixes
from cfb_mjx.logs.flight_log import FlightLog, changes

_ROWS = 6000  # rows of a long log, those with the most motion, on which changes are tried
_UNTOLD, _GONE = 0.5, 2.0  # cost of an axis that a change makes immobile, or impossible to compare
_SHORT, _RUSHED, _FARTHER = 1.0, 5.0, 0.1  # s below which a log is too short to compare; ratio of distances; m
_DISORDER = 0.2  # share of rows at which the position jumps
_UNIT = 0.13  # tolerance of a slope after a change of unit, because estimators are off by a tenth in velocity
_MUCH = 1.5  # least reduction of the cost by a change that does not resolve every contradiction
_ALIKE = 0.1  # changes within this cost of the best one are given as alternatives
_PAIRS = 3  # number of the best single changes that are tried together with a second one
_MOTORS_TELL = 0.6  # correlation from which the motors are judged
_NAMES = {
    "displacement": "the position moves {slope:.2f} times as far along {axis} as the velocity says",
    "attitude": "the attitude turns {slope:.2f} times as fast about {axis} as the gyro says",
    "velocity": "the velocity changes {slope:.2f} times as much along {axis} as the accelerometer says",
    "gravity": "the specific force ax ay az reads {slope:.3g} g upwards on average",
    "upright": "the specific force along z has a median of {slope:.3g} g (body axes are forward, left, up)",
    "drag": "the accelerometer says that the air pushes the drone along {axis} in the direction of motion, or across",
}


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Result of comparing the signals of a log with each other.

    Attributes:
        relations: comparisons of pose, velocity, gyro and accelerometer.
        agreement: mean correlation of roll and pitch with the motors in their present order, for ``rotor_speed`` and
            ``command``; without the one that has no data.
        problem: the contradiction, as a clause; None if there is none.
        remedy: changes that make the signals agree; empty if none was found.
        alternatives: other changes that do so too.
        certain: whether the log is refused even without a remedy.
        left: number of comparisons that still disagree after the remedy.
    """

    relations: list[Relation]
    agreement: dict[str, float]
    problem: str | None = None
    remedy: tuple[Fix, ...] = ()
    alternatives: tuple[Fix, ...] = ()
    certain: bool = False
    left: int = 0

    def sentence(self) -> str:
        """The problem and the remedy, without a full stop."""
        if not self.remedy:
            return str(self.problem)
        words = ", and ".join(fix.words for fix in self.remedy)
        flags = " ".join(f"--fix {fix.name}" for fix in self.remedy)
        others = "".join(f"; --fix {fix.name} would too" for fix in self.alternatives)
        all_but = f"all signals agree except in {self.left} comparisons" if self.left else "all signals agree"
        return f"{self.problem}; {words}: that makes {all_but} ({flags} does it{others})"

    def report(self) -> dict:
        """The comparisons as JSON-compatible values."""
        rows = [dataclasses.asdict(r) | {"contradicts": r.contradicts} for r in self.relations]
        return {"relations": rows, "motors": self.agreement}

    def summary(self) -> str:
        """One line: the signals that agree, and those with too little motion to be judged."""
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
        return f"{text}; too little motion to compare: {', '.join(rest)}" if rest and said else text


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
            problem += "; give the accelerometer's reading, gravity included, in m/s^2"
        return Verdict(relations, {}, problem, remedy, alternatives, heavy, left)
    if (rushed := _rushed(log)) is not None:
        return Verdict(relations, {}, *rushed, certain=True)
    if (repeated := _repeated(log)) is not None:
        return Verdict(relations, {}, repeated, certain=True)
    return _judge_motors(log, relations)


def _independent(log: FlightLog, relations: list[Relation]) -> list[Relation]:
    """The relations without those between a derived signal and its source."""
    made = log.metadata.get("variables") or {}
    derived = {name for field, name in _OF.items() if "derived" in (made.get(field) or {})}
    return [r for r in relations if r.name not in derived]


_OF = {"velocity": "displacement", "body_rate": "attitude", "specific_force": "velocity"}


def _worst(bad: list[Relation]) -> str:
    # Gravity first, because it is the easiest to understand.
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
    """Cost of the disagreement between signals, and the number of contradictions.

    ``moved`` has the axes that moved before a change: one that no longer moves, or is gone, adds to the cost.
    """
    cost = sum(min(r.unexplained, 2.0) for r in relations if r.moves)
    there = {(r.name, r.axis) for r in relations}
    still = moved & {(r.name, r.axis) for r in relations if r.moves and r.name != "drag"}
    kinds = {pair for pair in moved if pair[0] != "drag"}
    cost += _UNTOLD * len((kinds & there) - still) + _GONE * len(kinds - there)
    return cost, sum(r.contradicts for r in relations)


def _remedy(log: FlightLog) -> tuple[tuple[Fix, ...], tuple[Fix, ...], int]:
    """Search for the change that makes the signals agree.

    First a single change that resolves all contradictions, then a pair; else the best single change, if it reduces the
    cost considerably.

    Returns:
        The change or changes, alternatives, and the number of comparisons that still disagree.
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
    # Changes of another signal, or another unit of the same: similar factors (ft/s, km/h) may fit equally well.
    others = [fix for fix in others if fix.name.split("=")[0] != part or part.endswith("-unit")]
    others = [fix for fix in others if part.endswith("-unit") or fix.name.split("-")[0] != part.split("-")[0]]
    return best, tuple(others[:2]), 0


def _tried(log: FlightLog, moved: frozenset) -> list[tuple[float, int, Fix, int]]:
    """Cost, number of contradictions, change and its rank, for every candidate."""
    found = []
    for rank, fix in enumerate(candidates()):
        if not fix.name.startswith("command"):
            relations = consistency.kinematics(fix.apply(log))
            cost, bad = _cost(relations, moved)
            if np.isfinite(cost) and _exact(fix, relations):
                found.append((cost, bad, fix, rank))
    return found


def _exact(fix: Fix, relations: list[Relation]) -> bool:
    """Whether a change of scale brings the slopes to one. If not, the sensor has a scale error, not another unit."""
    if "unit" not in fix.name and "scale" not in fix.name:
        return True
    compared = [r for r in relations if r.moves and r.name in ("displacement", "attitude", "velocity")]
    return all(abs(r.slope / max(r.correlation, 0.1) - 1) < _UNIT for r in compared if r.correlation > 0.8)


def _rushed(log: FlightLog) -> tuple[str, tuple[Fix, ...]] | None:
    """Detect time in a wrong unit in a log too short to compare: it moves much further than its velocities allow."""
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
    """Detect rows that are not in order of time: the position jumps everywhere."""
    step = np.diff(log.time)
    moved = np.linalg.norm(np.diff(log.position, axis=0), axis=1)
    speed = np.linalg.norm(log.velocity[1:] + log.velocity[:-1], axis=1) / 2
    reach = float(np.linalg.norm(np.ptp(log.position, axis=0)))
    leaps = (moved > 20 * speed * step + 0.02 * reach) & (moved > 0.01)
    # A wrong unit scales all steps equally, so the path stays smooth.
    bend = np.linalg.norm(np.diff(log.position, n=2, axis=0), axis=1)
    rough = float(np.median(bend)) > 0.5 * float(np.median(moved)) and float(np.median(moved)) > 0.02 * reach
    if leaps.mean() < _DISORDER or not rough:
        return None
    return (
        f"the position jumps in {leaps.mean():.0%} of the rows, so the rows are not in order of time; sort them by time"
    )


def _repeated(log: FlightLog) -> str | None:
    """Detect rows that repeat earlier rows exactly: a part of the log was pasted twice, or rows are out of order."""
    # Make w positive, because a copy may have the other of the two quaternions of an attitude.
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
            # Inverted commands act on roll and pitch like another order; only the thrust distinguishes the two.
            likely = -1 if motor_checks.heaves_against(log, source) else 1
            best = max(found, key=lambda key: (round(found[key], 3), key[1] * likely))
            if found[best] > _MOTORS_TELL and found[best] - found[ORDER, 1] > motor_checks.BETTER:
                moving[source] = best, found[best]
    for source, ((order, sign), value) in moving.items():
        what = "rotor speeds" if source == "rotor_speed" else "commands"
        problem = (
            f"roll and pitch do not follow from the {what} in their present order (correlation "
            f"{agreement[source]:.2f}; in another order {value:.2f})"
        )
        return Verdict(relations, agreement, problem, motor_fixes(order, sign))
    problem = motor_checks.implausible(log)
    return Verdict(relations, agreement, problem, certain=problem is not None)
