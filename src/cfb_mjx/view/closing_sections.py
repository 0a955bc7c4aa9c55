"""Sections of the report of a model correction: the effects found, the remaining error, and the next flights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.evaluation import Evaluation
from cfb_mjx.sysid.metrics import QUANTITIES
from cfb_mjx.sysid.tracing.diagnosis import Diagnosis, HeldOut, Reported, Unexplained
from cfb_mjx.sysid.tracing.structure import noise_floor
from cfb_mjx.view.closing_figures import Figures, key_of, squared
from cfb_mjx.view.closing_words import (
    FOLLOWS,
    change,
    documented,
    experiment,
    is_fault,
    meaning,
    numbers,
    probability,
    separating,
    strength,
    with_error,
)
from cfb_mjx.view.page import Section

Table = tuple[str, list[str], list[list[str]]]
UNIT = {"m": "m", "mps": "m/s", "deg": "deg", "radps": "rad/s"}


def sections(
    diagnosis: Diagnosis, figures: Figures, logs_fit: list[FlightLog], logs_held_out: list[FlightLog]
) -> list[Section]:
    """All sections, in the order of the report."""
    found = [_short(logs_fit, logs_held_out), _missing(diagnosis, figures), _errors(figures)]
    if diagnosis.unexplained is not None:
        found.append(_unexplained(diagnosis.unexplained, figures))
    found += [
        Section("What is left", what_is_left(diagnosis), figures=figures.get("left", [])),
        Section("What to fly next", next_flights(diagnosis)),
        _numbers(diagnosis),
        _residuals(diagnosis.held_out, figures),
        _measured(diagnosis, logs_fit, logs_held_out),
        _refused(diagnosis),
        _per_log(diagnosis),
    ]
    return found


def _short(logs_fit: list[FlightLog], logs_held_out: list[FlightLog]) -> Section:
    logs = [*logs_fit, *logs_held_out]
    seconds = [sum(log.duration for log in group) for group in (logs_fit, logs_held_out)]
    speed = max(np.linalg.norm(log.velocity, axis=1).max() for log in logs)
    turn = max(np.linalg.norm(log.body_rate, axis=1).max() for log in logs)
    low, high = min(log.position[:, 2].min() for log in logs), max(log.position[:, 2].max() for log in logs)
    rows = np.median([1 / log.nominal_interval for log in logs])
    text = (
        f"{len(logs_fit)} fit flights ({seconds[0]:.0f} s) and {len(logs_held_out)} held-out flights "
        f"({seconds[1]:.0f} s), {rows:.0f} rows per second; up to {speed:.1f} m/s and {turn:.1f} rad/s, at heights of "
        f"{low:.2f} to {high:.2f} m. Rotor speed was measured in {_how_many(logs, 'rotor_speed')} of them, the battery "
        f"voltage in {_how_many(logs, 'battery_voltage')}. Each flight is listed below."
    )
    return Section("What was measured", [text])


TOGETHER = (
    "No single effect made predictions better than holding velocity and body rate. Therefore all effects that most "
    "drones have were fitted together, effects that only some drones have were tried in addition, and effects that did "
    "not improve the model enough were removed again. Motors were fitted to commands and measured rotor speeds, "
    "everything else to predictions, commands in and rotor speeds in. The growth of an error without an effect is "
    "measured after the other effects were fitted again. Standard deviations come from the scatter between stretches "
    "of flight; declared constants, above all the mass, are taken as exact. Flights cannot distinguish more mass from "
    "less thrust: if thrust_scale is fitted, payload is not searched for; if it is declared, an error of one per cent "
    "in it changes a load by one per cent of the drone's weight. Predictions of flights under feedback overestimate "
    "inertia and damping. Accelerations, computed from row to row, do not; where the two contradict each other, the "
    "number compensates for something else."
)


def _how_many(logs: list[FlightLog], column: str) -> str:
    count = sum(getattr(log, column) is not None for log in logs)
    return {len(logs): "all", 0: "none"}.get(count, f"{count} of {len(logs)}")


def _missing(diagnosis: Diagnosis, figures: Figures) -> Section:
    if not diagnosis.reported:
        count = len(diagnosis.trace.search.names)
        text = f"None of the {count} effects of the catalogue and no sensor fault was both significant and material."
        return Section("What was found", [text])
    paragraphs, rows = [], []
    for item in diagnosis.reported:
        paragraphs.append(_sentence(item, "the mean" if diagnosis.together is not None else "one"))
        for number in numbers(item):
            low, high = number.value - 1.96 * number.std, number.value + 1.96 * number.std
            plausible = "" if number.plausible is None else "{:g} to {:g}".format(*number.plausible)
            span = f"{low:.4g} to {high:.4g}" if np.isfinite(number.std) else "at a bound of the fit"
            rows.append([item.name, number.label, str(number), span, plausible, probability(item.p_value)])
    caption = (
        "Value ± standard deviation. p: probability of this much evidence by chance, on the held-out flights "
        "(of a sensor fault: from comparing the sensors with each other, without any model)."
    )
    if diagnosis.together is not None:
        paragraphs.insert(0, TOGETHER + _held(diagnosis))
    head = ["effect", "parameter", "value", "95 % interval", "plausible", "p"]
    shown = [figure for item in diagnosis.reported for figure in figures.get(key_of(item.name), [])]
    if shown:
        paragraphs.append(
            "Figures, one row each: mean residual (measured minus modelled) in bins of the signal on which it depends, "
            "with 95 % intervals; a perfect model gives zero. Effects: force, torque or rotor speed in all flights. "
            "Faults of the recording: predictions of the held-out flights 0.2 s ahead."
        )
    return Section("What was found", paragraphs, [(caption, head, rows)], shown)


def _held(diagnosis: Diagnosis) -> str:
    """Sentences on the declared effects in a joint fit: unchanged, changed within the spread of the type, removed."""
    judged = {item.name for item in (*diagnosis.reported, *diagnosis.unconfirmed)}
    together = not_none(diagnosis.together)
    present, typical = set(diagnosis.hypothesis.present), together.typical
    declared = [item["name"] for item in diagnosis.base.effects if item["name"] in present - judged]
    held, moved = ([n for n in declared if (n in typical) == which] for which in (False, True))
    fit = together.fit
    edge = [n.name for n in fit.numbers if n.effect in moved and fit.at_bound(n)]
    text = f" Held as the model declares them: {', '.join(held)}." if held else ""
    text += f" Changed within the spread of the type: {', '.join(moved)}." if moved else ""
    text += f" At the edge of the spread, so this drone differs from its type: {', '.join(edge)}." if edge else ""
    gone = diagnosis.dropped
    motors = " (the motors' constants were fitted anew)" if diagnosis.motors else ""
    return text + (
        f" Declared by the model, but not supported by the flights{motors}: {', '.join(gone)}." if gone else ""
    )


def _sentence(item: Reported, which: str = "one") -> str:
    text = f"{item.name}: {meaning(item.name)}; {strength(item)}."
    if is_fault(item.name):
        text += " A fault of the recording, not of the drone: it is removed before the physics is examined."
    elif documented(item.name) not in ("", meaning(item.name)):
        text += f" In the model: {documented(item.name)}."
    if item.found is not None:
        text += f" Without it, {which} prediction error of the fit flights grows by {_grows(item.found.buys)}."
        text += _where(item)
        if item.asked:
            told = (f"{a.name} {with_error(a.value, a.std)}{' (a contradiction)' * a.contradicts}" for a in item.asked)
            text += f" Accelerations alone give {', '.join(told)}."
        if item.found.confusable:
            names = ", ".join([item.name, *item.found.confusable])
            text += f" These flights cannot tell which of this set it is: {names}."
    return text


DOMAINS = {
    "rotor_speed": "in what commands do to the rotors",
    "force": "in the forces",
    "torque": "in the torques",
}


def _where(item: Reported) -> str:
    """Sentence on the domains with the evidence of the held-out flights, those with at least a tenth of it."""
    domains = {} if item.verdict is None else item.verdict.domains or {}
    if not domains:
        return ""
    if sum(domains.values()) <= 0:
        return " It does not explain the rows of the held-out flights better; only predictions improve with it."
    gains = {name: gain for name, gain in domains.items() if gain > 0}
    shares = {name: gain / sum(gains.values()) for name, gain in gains.items()}
    named = [f"{DOMAINS[n]} ({100 * s:.0f} %)" for n, s in sorted(shares.items(), key=lambda p: -p[1]) if s >= 0.1]
    return f" On the held-out flights it shows {', '.join(named)}."


def _grows(buys: float) -> str:
    """Growth of the error with an effect, from the share of the error without it that the effect removes."""
    growth = 1 / max(1 - buys, 1e-9) - 1
    return f"{100 * growth:.0f} %" if growth < 2 else f"a factor of {1 + growth:.1f}"


def _errors(figures: Figures) -> Section:
    text = (
        "Open-loop predictions of held-out flights, commands in. Bars are 95 % bootstrap intervals over windows. Hold: "
        "constant velocity and body rate. Noise floor (dashed): the error of a perfect model, which is not zero "
        "because the initial state and the reference are measured. It is the white noise of each column, propagated to "
        "first order (gyro noise times horizon adds to attitude, a wrong attitude tilts the thrust, and so on). "
        "Dotted: the same with random disturbance forces and torques, as large and as fast as the residuals that "
        "remain on these flights."
    )
    return Section("Error on held-out flights", [text], figures=figures["errors"])


def _numbers(diagnosis: Diagnosis) -> Section:
    windows = sum(len(log.windows) for log in diagnosis.before.logs)
    caption = f"RMS errors over {windows} windows of {len(diagnosis.before.logs)} held-out flights, with 95 % intervals"
    rows = _rows(diagnosis.before, diagnosis.after, diagnosis.held_out.noise_floor, diagnosis.held_out.random)
    head = ["error of", "ahead", "before", "after", "change", "hold", "noise floor", "noise and disturbances"]
    tables = [(caption, head, rows)]
    before, after = diagnosis.before.metrics("rotor_speed_in"), diagnosis.after.metrics("rotor_speed_in")
    if before and after:
        tables.append(_speed_in(before, after))
    return Section("Held-out errors in numbers", tables=tables)


def _rows(before: Evaluation, after: Evaluation, floor: dict, random: dict | None) -> list[list[str]]:
    found = []
    spans = {name: not_none(e.intervals(v)) for name, e, v in _kinds(before, after)}
    middle = {name: not_none(e.metrics(v)) for name, e, v in _kinds(before, after)}
    for quantity, unit in QUANTITIES.items():
        for horizon in before.horizons:
            key = f"{quantity}_rmse_{unit}@{horizon:g}s"
            cell = {name: f"{middle[name][key]:.3g} [{_span(spans[name][key])}]" for name in middle}
            row = [f"{quantity}, {UNIT[unit]}", f"{1e3 * horizon:.0f} ms", cell["before"], cell["after"]]
            row += [change(middle["before"][key], middle["after"][key]), cell["hold"], f"{floor[key]:.3g}"]
            found.append(row if random is None else [*row, f"{random[key]:.3g}"])
    return found


def _kinds(before: Evaluation, after: Evaluation):
    return ("before", before, "commands_in"), ("after", after, "commands_in"), ("hold", before, "hold")


def _span(ends: list[float]) -> str:
    return f"{ends[0]:.3g}, {ends[1]:.3g}"


def _speed_in(before: dict, after: dict) -> Table:
    keys = [key for key in before if "_rmse_" in key and key.endswith(("@0.2s", "@0.5s"))]
    rows = []
    for key in keys:
        quantity, _, unit = key.partition("@")[0].split("_")
        cells = [f"{before[key]:.3g}", f"{after[key]:.3g}", change(before[key], after[key])]
        rows.append([f"{quantity}, {UNIT[unit]}", f"{1e3 * float(key.partition('@')[2][:-1]):.0f} ms", *cells])
    caption = "The same with measured rotor speeds instead of commands: motors and their controllers have no influence"
    return caption, ["error of", "ahead", "before", "after", "change"], rows


def _unexplained(found: Unexplained, figures: Figures) -> Section:
    texts = ["A structured residual remains that no effect of the catalogue accounts for."]
    if found.proposal is not None:
        texts[0] += (
            " Terms that describe it were fitted without a physical model and are part of the corrected model. They "
            "describe the data; they are not physics."
        )
    if found.held_out_only:
        texts[0] += (
            " Only the held-out flights show it, because they contain motion that the fit flights hardly contain. The "
            "terms that describe it were fitted to the held-out flights, so they cannot be validated and are not part "
            "of the corrected model."
        )
    rows = [[text] for text in found.formulas]
    tables = [("Terms", ["term"], rows)] if rows else []
    return Section("Unexplained", [*texts, found.where], tables, figures.get("unexplained", []))


def _residuals(held_out: HeldOut, figures: Figures) -> Section:
    paragraphs = [
        "Residuals of the held-out flights are measured minus modelled, given the measured state: torque (as angular "
        "acceleration, from the gyro), force (specific force, from the accelerometer; body axes), rotor speed (where "
        "measured) and the prediction 0.2 s ahead. Measured and modelled values pass through the same zero-phase "
        "Gaussian filter of 20 ms.",
        "First figure: share of each residual's mean square that a signal explains on stretches left out, in % of the "
        "mean square before; blanks are below 3 %. Offset: its mean. A column that stays dark on the right shows "
        "structure that the model does not explain. Second figure: spectra, with the sensors' white noise.",
    ]
    before, after = held_out.structure
    units = held_out.pooled[0].units | held_out.predictions[0].units
    rows = [
        [axis, squared(units[axis]), f"{a:.3g}", f"{b:.3g}", change(a, b)]
        for axis, a, b in zip(before.axes, before.rms, after.rms, strict=True)
        if np.isfinite(a)
    ]
    tables = [("Size of the residuals, RMS", ["residual", "unit", "before", "after", "change"], rows)]
    return Section("Residuals and what they follow", paragraphs, tables, figures["residuals"])


def _measured(diagnosis: Diagnosis, logs_fit: list[FlightLog], logs_held_out: list[FlightLog]) -> Section:
    rows = []
    for use, logs in (("fit", logs_fit), ("held out", logs_held_out)):
        for log in logs:
            speed, turn = (np.linalg.norm(x, axis=1).max() for x in (log.velocity, log.body_rate))
            height = f"{log.position[:, 2].min():.2f} to {log.position[:, 2].max():.2f}"
            rows.append([log.name, use, f"{log.duration:.1f}", f"{1 / log.nominal_interval:.0f}", f"{speed:.1f}"])
            rows[-1] += [f"{turn:.1f}", height, _yes(log.rotor_speed), _yes(log.battery_voltage), str(len(log.gaps()))]
    head = ["flight", "use", "s", "rows/s", "top m/s", "top rad/s", "height, m", "rotor speed", "voltage", "gaps"]
    looked = [
        [name, with_error(value, std) if name.endswith("scale") else with_error(1e3 * value, 1e3 * std, "ms")]
        for name, (value, std) in diagnosis.trace.sensors.measured.items()
    ]
    delay = 1e3 * diagnosis.trace.search.delay
    text = (
        f"Pose and velocity rows are assumed to be {delay:.0f} ms late, as declared. The other faults are estimated by "
        "comparing the sensors."
    )
    sensors = ("Sensors compared with each other, without a model", ["fault", "found"], looked)
    return Section("Flights and sensors", [text], [("Flights", head, rows), sensors])


def _yes(column) -> str:
    return "no" if column is None else "yes"


def _refused(diagnosis: Diagnosis) -> Section:
    text = (
        "Every effect of the catalogue was tried in every round, on left-out blocks of the fit flights. To be "
        "reported, an effect must be significant there, reduce a prediction error, and be confirmed on the held-out "
        "flights."
    )
    head = ["effect", "gain, nats", "p", "why not"]
    caption = "Effects not reported, at their last try (gain in log-likelihood on blocks left out)"
    candidates = diagnosis.candidates
    rows = [[each.name, f"{each.gain:.1f}", probability(each.p_value), each.why] for each in candidates]
    near = {item.name for item in (*candidates, *diagnosis.reported)}
    others = sorted(set(diagnosis.trace.search.names) - near)
    texts = [text, f"Never among the eight most likely: {', '.join(others)}."] if others else [text]
    return Section("Tried and refused", texts, [(caption, head, rows)] if rows else [])


def _per_log(diagnosis: Diagnosis) -> Section:
    tables = []
    head = ["error of", "ahead", "before", "after", "change", "hold", "noise floor"]
    for old, new in zip(diagnosis.before.logs, diagnosis.after.logs, strict=True):
        if not len(old.windows):
            continue
        before, after = replace(diagnosis.before, logs=(old,)), replace(diagnosis.after, logs=(new,))
        rows = _rows(before, after, noise_floor(after), None)
        tables.append((f"{old.log.name}, {len(old.windows)} windows", head, rows))
    return Section("Every held-out flight", ["RMS errors with 95 % intervals."], tables)


UNSURE = 0.2
"""Relative standard deviation above which more flights that excite an effect are suggested."""


def what_is_left(diagnosis: Diagnosis) -> list[str]:
    """Paragraphs on the structure that remains in the residuals, and on the sources of the remaining error."""
    after = diagnosis.held_out.structure[1]
    strongest = after.strongest(3)
    if strongest:
        named = "; ".join(
            f"{after.axes[i]} follows {after.signals[j]} ({100 * after.share[i, j]:.0f} % of what is left in it, "
            f"{_size(diagnosis.held_out, i)} rms)"
            for i, j in strongest
        )
        first = f"Structure that remains on the held-out flights: {named}. Shown below."
    else:
        first = "No residual of the held-out flights follows any measured signal by more than 5 % of its mean square."
    return [first, _budget(diagnosis)]


def _size(held_out: HeldOut, index: int) -> str:
    after = held_out.structure[1]
    axis = after.axes[index]
    return f"{after.rms[index]:.2g} {squared(held_out.pair(axis)[1].units[axis])}"


def _budget(diagnosis: Diagnosis) -> str:
    horizon = max(diagnosis.after.horizons)
    errors = not_none(diagnosis.after.metrics("commands_in"))
    sensors, wandering = [], []
    for quantity, unit in QUANTITIES.items():
        key = f"{quantity}_rmse_{unit}@{horizon:g}s"
        for found, floor in (
            (sensors, diagnosis.held_out.noise_floor[key]),
            (wandering, max(diagnosis.held_out.noise_floor[key], diagnosis.held_out.random[key])),
        ):
            found.append(f"{quantity} {100 * min(1.0, floor**2 / errors[key] ** 2):.0f} %")
    return (
        f"Sources of the remaining error: sensor noise makes up these shares of its square, {horizon:g} s ahead: "
        f"{', '.join(sensors)}. Sensor noise together with random forces and torques like these residuals makes up "
        f"{', '.join(wandering)}. No model predicts disturbances that depend on no measured signal. Structure named "
        "above is part of these disturbances and could still be modelled."
    )


def next_flights(diagnosis: Diagnosis) -> list[str]:
    """Suggested flights for what is not known well enough yet, each with its reason, the most useful first."""
    flights: dict[str, list[str]] = {}

    def fly(what: str, because: str) -> None:
        flights.setdefault(what, []).append(because)

    for item in diagnosis.reported:
        rivals = [] if item.found is None else item.found.confusable
        for name in [item.name, *rivals] if rivals else []:
            others = ", ".join(other for other in [item.name, *rivals] if other != name)
            fly(experiment(name), f"this shows {name}, and not {others}")
        command = separating([item.name, *rivals], "model.yaml") if rivals else None
        if command is not None:
            fly(
                f"the trajectory that `{command}` writes",
                f"it is chosen to distinguish {item.name} from {', '.join(rivals)}",
            )
        main = max(numbers(item), key=lambda number: abs(number.value))
        if main.std > UNSURE * abs(main.value):
            share = 100 * main.std / max(abs(main.value), 1e-300)
            fly(experiment(item.name), f"{item.name} is known to {share:.0f} % only")
    for item in diagnosis.unconfirmed:
        fly(experiment(item.name), f"{item.name} was found, but not confirmed on held-out flights")
    if diagnosis.unexplained is not None and diagnosis.unexplained.held_out_only:
        fly(
            "more flights like the held-out ones, some of them to fit to",
            f"no model has the structure in them yet: {diagnosis.unexplained.where}",
        )
    after = diagnosis.held_out.structure[1]
    for i, j in after.strongest(3):
        signal = after.signals[j]
        fly(next(text for key, text in FOLLOWS.items() if signal.startswith(key)), f"{after.axes[i]} follows {signal}")
    logs = [*diagnosis.trace.search.logs, *diagnosis.held_out.search.logs]
    for column, name, why in (
        ("rotor_speed", "rotor speed", "it separates the motors from the aerodynamics"),
        ("battery_voltage", "the battery's voltage", "without it battery_sag cannot be found"),
    ):
        lacking = sum(getattr(log, column) is None for log in logs)
        if lacking:
            fly(f"any flight with {name} logged, which {lacking} of {len(logs)} lack", why)
    if not flights:
        return ["Different flights: faster, lower, longer. The model was tested only on motion that was flown."]
    return [f"{what[0].upper()}{what[1:]}. Why: {'; '.join(why)}." for what, why in flights.items()]
