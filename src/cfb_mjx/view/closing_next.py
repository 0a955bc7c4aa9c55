"""What is left after closing the loop, what was refused and why, and which flights would tell more."""

from __future__ import annotations

from cfb_mjx.sysid.metrics import QUANTITIES
from cfb_mjx.sysid.tracing.outcome import Outcome
from cfb_mjx.sysid.tracing.trace import ALPHA, LEAST_GAIN, MATERIAL
from cfb_mjx.view.closing_look import Looked
from cfb_mjx.view.closing_words import EXPERIMENTS, FOLLOWS, probability, values

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
    return f"{after.rms[index]:.2g} {looked.pair(axis)[1].units[axis]}"


def _budget(outcome: Outcome, looked: Looked) -> str:
    horizon = max(outcome.after.horizons)
    errors, parts = outcome.after.metrics("commands_in"), []
    for quantity, unit in QUANTITIES.items():
        key = f"{quantity}_rmse_{unit}@{horizon:g}s"
        total = errors[key] ** 2
        sensors = min(1.0, looked.floor[key] ** 2 / total)
        disturbed = min(1.0, max(looked.random[key], looked.floor[key]) ** 2 / total)
        parts.append(
            f"{quantity} {100 * sensors:.0f} / {100 * (disturbed - sensors):.0f} / {100 * (1 - disturbed):.0f} %"
        )
    return (
        f"Of the squared error {horizon:g} s ahead: sensor noise / random disturbances of the size seen / the rest: "
        + ", ".join(parts)
        + ". Only the rest is left to a better model; disturbances are what varies without following any signal, and "
        "would shrink if their cause were measured."
    )


def next_flights(outcome: Outcome, looked: Looked) -> tuple[str, list[str], list[list[str]]]:
    """A table: what is not known well enough yet, and the flight that would tell."""
    rows: list[list[str]] = []

    def ask(why: str, flight: str) -> None:
        if flight not in [row[1] for row in rows]:
            rows.append([why, flight])

    for item in outcome.reported:
        rivals = [] if item.found is None else item.found.confusable
        for name in [item.name, *rivals] if rivals else []:
            ask(f"{', '.join([item.name, *rivals])} look alike: show {name}", EXPERIMENTS.get(name, ""))
        for label, value, std, _ in values(item):
            if std > UNSURE * abs(value) and label == max(values(item), key=lambda v: abs(v[1]))[0]:
                ask(f"{item.name} {label} is known to {100 * std / abs(value):.0f} % only", EXPERIMENTS[item.name])
    for item in outcome.unconfirmed:
        ask(f"{item.name} was not confirmed on held-out flights", EXPERIMENTS[item.name])
    after = looked.structure[1]
    for i, j in after.strongest(3):
        signal = after.signals[j]
        flight = next(text for key, text in FOLLOWS.items() if signal.startswith(key))
        ask(f"{after.axes[i]} still follows {signal}", flight)
    logs = [*outcome.trace.search.logs, *looked.judge.logs]
    if any(log.rotor_speed is None for log in logs):
        count = sum(log.rotor_speed is None for log in logs)
        ask(f"{count} of {len(logs)} flights lack rotor speed", "log it: it separates the motors from the aerodynamics")
    if any(log.battery_voltage is None for log in logs):
        ask("some flights lack the battery's voltage", "log it: without it battery_sag cannot be seen")
    if not rows:
        ask("nothing is open", "flights unlike these: faster, lower, longer; what was not flown was not tested")
    return "In the order they would help", ["open", "fly"], rows


def refused_rows(outcome: Outcome) -> list[list[str]]:
    """Effect, gain, p-value and reason of everything that was looked at and not reported, most nearly found first."""
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
    if others:
        rows.append([", ".join(others), "", "", "never among the first"])
    return rows
