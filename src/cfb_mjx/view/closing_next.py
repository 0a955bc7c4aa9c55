"""What is left after closing the loop, what was refused and why, and which flights would tell more."""

from __future__ import annotations

from cfb_mjx.sysid.metrics import QUANTITIES
from cfb_mjx.sysid.tracing.acceptance import ALPHA, LEAST_GAIN, MATERIAL
from cfb_mjx.sysid.tracing.outcome import Outcome
from cfb_mjx.view.closing_figures import squared
from cfb_mjx.view.closing_look import Looked
from cfb_mjx.view.closing_words import FOLLOWS, experiment, numbers, probability, separating

UNSURE = 0.2
"""Relative standard deviation above which more flights of an effect's kind are asked for."""


def what_is_left(outcome: Outcome, looked: Looked) -> list[str]:
    """Paragraphs on structure that remains, and on where the remaining error comes from."""
    after = looked.structure[1]
    strongest = after.strongest(3)
    if strongest:
        named = "; ".join(
            f"{after.axes[i]} follows {after.signals[j]} ({100 * after.share[i, j]:.0f} % of what is left in it, "
            f"{_size(looked, i)} rms)"
            for i, j in strongest
        )
        first = f"Structure that remains on the held-out flights: {named}. Shown below."
    else:
        first = "No residual of the held-out flights follows any measured signal by more than 5 % of its mean square."
    return [first, _budget(outcome, looked)]


def _size(looked: Looked, index: int) -> str:
    after = looked.structure[1]
    axis = after.axes[index]
    return f"{after.rms[index]:.2g} {squared(looked.pair(axis)[1].units[axis])}"


def _budget(outcome: Outcome, looked: Looked) -> str:
    horizon = max(outcome.after.horizons)
    errors = outcome.after.metrics("commands_in")
    sensors, wandering = [], []
    for quantity, unit in QUANTITIES.items():
        key = f"{quantity}_rmse_{unit}@{horizon:g}s"
        for found, floor in ((sensors, looked.floor[key]), (wandering, max(looked.floor[key], looked.random[key]))):
            found.append(f"{quantity} {100 * min(1.0, floor**2 / errors[key] ** 2):.0f} %")
    return (
        f"Where the remaining error comes from: of its square {horizon:g} s ahead, sensor noise makes "
        f"{', '.join(sensors)}. Sensor noise together with forces and torques that wander as these residuals do makes "
        f"{', '.join(wandering)}. What wanders without following a measured signal no model predicts; any structure "
        "named above is part of it and could still be taken out."
    )


def next_flights(outcome: Outcome, looked: Looked) -> list[str]:
    """Flights that would tell what is not known well enough yet, each with its reason, the most useful first."""
    flights: dict[str, list[str]] = {}

    def fly(what: str, because: str) -> None:
        flights.setdefault(what, []).append(because)

    for item in outcome.reported:
        rivals = [] if item.found is None else item.found.confusable
        for name in [item.name, *rivals] if rivals else []:
            others = ", ".join(other for other in [item.name, *rivals] if other != name)
            fly(experiment(name), f"this shows {name}, and not {others}")
        command = separating([item.name, *rivals], "model.yaml") if rivals else None
        if command is not None:
            fly(f"what `{command}` writes", f"it looks for the flight that tells {item.name} from {', '.join(rivals)}")
        main = max(numbers(item), key=lambda number: abs(number.value))
        if main.std > UNSURE * abs(main.value):
            share = 100 * main.std / max(abs(main.value), 1e-300)
            fly(experiment(item.name), f"{item.name} is known to {share:.0f} % only")
    for item in outcome.unconfirmed:
        fly(experiment(item.name), f"{item.name} was found, but not confirmed on held-out flights")
    if outcome.unexplained is not None and outcome.unexplained.held_out_only:
        fly(
            "more flights like the held-out ones, some of them to fit to",
            f"what they show is in no model yet: {outcome.unexplained.where}",
        )
    after = looked.structure[1]
    for i, j in after.strongest(3):
        signal = after.signals[j]
        fly(next(text for key, text in FOLLOWS.items() if signal.startswith(key)), f"{after.axes[i]} follows {signal}")
    logs = [*outcome.trace.search.logs, *looked.judge.logs]
    for column, name, why in (
        ("rotor_speed", "rotor speed", "it separates the motors from the aerodynamics"),
        ("battery_voltage", "the battery's voltage", "without it battery_sag cannot be seen"),
    ):
        lacking = sum(getattr(log, column) is None for log in logs)
        if lacking:
            fly(f"any flight with {name} logged, which {lacking} of {len(logs)} lack", why)
    if not flights:
        return ["Flights unlike these: faster, lower, longer. What was not flown was not tested."]
    return [f"{what[0].upper()}{what[1:]}. Why: {'; '.join(why)}." for what, why in flights.items()]


def refused(outcome: Outcome) -> tuple[list[list[str]], list[str]]:
    """What was not reported: effect, gain, p-value and reason, most nearly found first; and names never near."""
    reported = {item.name for item in outcome.reported}
    unconfirmed = {item.name: item for item in outcome.unconfirmed}
    last: dict[str, dict] = {}
    slight: dict[str, float] = {}
    for entry in outcome.trace.tried:
        for line in entry.get("ranking", []):
            last[line["name"]] = line
        if "tried" in entry:
            slight[entry["tried"]] = max(entry.get("drop", {"": 0.0}).values())
    tried = len(outcome.trace.search.names)
    rows = []
    for name, line in sorted(last.items(), key=lambda pair: -pair[1]["gain"]):
        if name in reported:
            continue
        if name in unconfirmed:
            verdict = unconfirmed[name].verdict
            why = "found on the fit flights, not borne out by the held-out ones"
            why += "" if verdict is None else f" (p = {probability(verdict.p_value)} there)"
        elif name in slight and slight[name] < MATERIAL:
            drop = max(0.0, slight[name])
            why = f"lowers no prediction error by {100 * MATERIAL:.0f} % (at most {100 * drop:.1f} %)"
        elif name in slight:
            why = "what it explained the others explain as well or better"
        elif line["p_value"] * tried >= ALPHA or line["gain"] <= LEAST_GAIN:
            why = "not beyond chance"
        else:
            why = "less than another effect"
        rows.append([name, f"{line['gain']:.1f}", probability(line["p_value"]), why])
    others = sorted(set(outcome.trace.search.names) - set(last) - reported)
    return rows, others
