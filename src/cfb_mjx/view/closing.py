"""Write the report of a model correction: an HTML page, and a rerun recording of the residuals.

The page has the verdict, the effects found with units, the remaining error, and suggested experiments and flights. The
recording shows held-out flights with residuals and predictions, before and after.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cfb_mjx import plugins
from cfb_mjx.files import scratch, write_text
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import CATALOGUE, KNOWN, SENSOR_FAULTS, CogOffset, Inertia, MotorTimeConstant, RotorDrag
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.evaluation import Evaluation, LogEvaluation
from cfb_mjx.sysid.metrics import QUANTITIES
from cfb_mjx.sysid.tracing.diagnosis import Diagnosis, HeldOut, Reported, Unexplained
from cfb_mjx.sysid.tracing.residuals import UNITS, Residuals
from cfb_mjx.sysid.tracing.structure import noise_floor
from cfb_mjx.view.closing_figures import AFTER, BEFORE, Figures, draw, key_of, squared
from cfb_mjx.view.page import Section, html_page
from cfb_mjx.view.recorder import AXES, LIGHT, Plot, Recorder, Tab, part, recording

FOLLOWS = {
    "velocity": RotorDrag.experiment,
    "rate": Inertia.experiment,
    "rotor mean": "climbs, dives and hovers at several thrusts, rotor speed logged",
    "rotor": MotorTimeConstant.experiment,
    "command": MotorTimeConstant.experiment,
    "position": "the same manoeuvre at another place, away from walls, cables and other drones",
    "height": "hover at several heights, and the same heights over another floor",
    "heading": CogOffset.experiment,
    "voltage": "hover from a full battery to an empty one",
    "time": "hover for a minute from cold, twice",
    "offset": CogOffset.experiment,
}
_COMPONENTS = {2: ("x", "y"), 3: ("x", "y", "z"), 4: ("M1", "M2", "M3", "M4")}


def separating(names: list[str], model: str) -> str | None:
    """The command that finds a trajectory to distinguish effects; None if one of them is not in the catalogue."""
    if not set(names) <= set(CATALOGUE):
        return None
    plugged = "".join(f" --plugin {shlex.quote(str(file))}" for file in plugins.files())
    return f"cfb excite separate --between {','.join(names)} --model {model}{plugged} -o next"


def is_fault(name: str) -> bool:
    """Whether a name is a fault of the recording, not a physical effect."""
    return name in SENSOR_FAULTS


def meaning(name: str) -> str:
    """Short phrase that explains an effect or fault."""
    if is_fault(name):
        return SENSOR_FAULTS[name].meaning
    return KNOWN[name].meaning or documented(name) or name.replace("_", " ")


def documented(name: str) -> str:
    """First paragraph of an effect's docstring, without the full stop."""
    return " ".join((KNOWN[name].__doc__ or "").split("\n\n")[0].split()).rstrip(".")


def experiment(name: str) -> str:
    """Flights that excite an effect or fault, in words."""
    return (SENSOR_FAULTS if is_fault(name) else KNOWN)[name].experiment or f"flights that excite {name}"


def unit_of(name: str, field: str) -> str:
    """Unit of a parameter of an effect or fault; empty for dimensionless parameters."""
    unit = SENSOR_FAULTS[name].unit if is_fault(name) else KNOWN[name].units.get(field, "1")
    return "" if unit == "1" else unit.replace("^2", "²")


@dataclass(frozen=True)
class Number:
    """One number of an effect as printed, in a unit of suitable size."""

    label: str
    value: float
    std: float
    unit: str
    plausible: tuple[float, float] | None
    """Plausible range of the catalogue; None for faults of the recording."""

    def __str__(self) -> str:
        return with_error(self.value, self.std, self.unit)


def numbers(item: Reported) -> list[Number]:
    """All numbers of an effect or fault."""
    found = []
    prior = {} if is_fault(item.name) else KNOWN[item.name].prior
    for field, value in item.parameters.items():
        several = isinstance(value, list)
        each = np.atleast_1d(np.asarray(value, dtype=float))
        deviation = np.broadcast_to(np.asarray(item.uncertainty.get(field, np.nan), dtype=float), each.shape)
        factor, unit = readable(unit_of(item.name, field), float(np.max(np.abs(each))))
        labels = _COMPONENTS.get(len(each), tuple(str(i) for i in range(len(each))))
        low_high = None if field not in prior else (factor * prior[field][0], factor * prior[field][1])
        for label, v, s in zip(labels, each, deviation, strict=True):
            name = f"{field} {label}" if several else field
            found.append(Number(name, factor * float(v), factor * float(s), unit, low_high))
    return found


def readable(unit: str, size: float) -> tuple[float, str]:
    """Factor and unit for printing: ms, mm and g for values below half a s, m or kg."""
    smaller = {"s": "ms", "m": "mm", "kg": "g"}
    return (1e3, smaller[unit]) if unit in smaller and size < 0.5 else (1.0, unit)


def with_error(value: float, std: float, unit: str = "") -> str:
    """Format as ``value ± std unit``, with the number of digits that the standard deviation justifies."""
    unit = f" {unit}" if unit else ""
    if not np.isfinite(std) or std <= 0:
        return f"{value:.3g}{unit}"
    power = int(np.floor(np.log10(max(abs(value), std))))
    scale = power if power < -3 or power > 4 else 0
    digits = max(0, 1 - int(np.floor(np.log10(std))) + scale)
    a, b = value / 10.0**scale, std / 10.0**scale
    return f"({a:.{digits}f} ± {b:.{digits}f})e{scale}{unit}" if scale else f"{a:.{digits}f} ± {b:.{digits}f}{unit}"


def probability(p: float) -> str:
    """Format a p-value."""
    return f"{p:.1g}" if p > 1e-300 else "< 1e-300"


def strength(item: Reported) -> str:
    """All numbers of an effect in one phrase."""
    return ", ".join(f"{number.label} {number}" for number in numbers(item))


def change(before: float, after: float) -> str:
    """Format a relative change."""
    share = round(100 * (after / before - 1))
    return f"{share:+d} %" if share else "0 %"


def verdict(diagnosis: Diagnosis) -> str:
    """Summary of the result in one or two sentences."""
    physics = [item for item in diagnosis.reported if not is_fault(item.name)]
    faults = [item for item in diagnosis.reported if is_fault(item.name)]
    parts = []
    if diagnosis.together is not None:
        return _many(diagnosis, physics)
    if len(physics) == 1:
        (item,) = physics
        parts.append(
            f"The drone flies with {item.name} the model lacks ({meaning(item.name)}): "
            f"{strength(item)}{_interval(item)}."
        )
    elif physics:
        named = "; ".join(f"{item.name} ({strength(item)})" for item in physics)
        parts.append(f"The drone flies with {len(physics)} effects the model lacks: {named}.")
    if faults:
        named = "; ".join(f"{item.name}, {meaning(item.name)}: {strength(item)}" for item in faults)
        parts.append(f"The recording is at fault, not the physics: {named}.")
        if not physics and diagnosis.unexplained is None:
            parts.append("In the physics, nothing is missing beyond chance.")
    if diagnosis.unexplained is not None:
        parts.append(f"Structure is left that no effect of the catalogue accounts for: {diagnosis.unexplained.where}.")
    elif not diagnosis.reported:
        parts.append("Nothing is missing beyond chance.")
    if diagnosis.reported or diagnosis.unexplained is not None:
        parts.append(_bought(diagnosis))
    return " ".join(parts)


SHOWN = 3
"""Largest number of effects that the first paragraph explains."""


def _many(diagnosis: Diagnosis, physics: list[Reported]) -> str:
    """Summary of a joint fit of many effects: the effects, the errors before and after, and advice."""
    first = "; ".join(f"{item.name} ({meaning(item.name)})" for item in physics[:SHOWN])
    more = [item.name for item in physics[SHOWN:]]
    count = f"{len(physics)} effects" if len(physics) != 1 else "one effect"
    motors = ", and its motors differ from the model's" if diagnosis.motors else ""
    has = f"The drone flies with {count} the model lacks{motors}; the most important: {first}"
    has += f"; then {', '.join(more)}." if more else "."
    horizon = f"@{max(diagnosis.before.horizons):g}s"
    keys = {"attitude": ("attitude_mean_deg", "deg"), "velocity": ("velocity_mean_mps", "m/s")}
    before, after, still = (
        not_none(found.metrics(variant))
        for found, variant in (
            (diagnosis.before, "commands_in"),
            (diagnosis.after, "commands_in"),
            (diagnosis.before, "hold"),
        )
    )
    errors = " and ".join(
        f"the {name} error {horizon[1:-1]} s ahead goes from {before[key + horizon]:.3g} to {after[key + horizon]:.3g} "
        f"{unit} (hold: {still[key + horizon]:.3g})"
        for name, (key, unit) in keys.items()
    )
    bound = [number for item in diagnosis.reported for number in item.at_bound]
    do = "Fly and train with model.yaml"
    if bound:
        do += f"; do not trust as physics the numbers at the edge of their plausible range ({', '.join(bound)})"
    other = [item.name for item in diagnosis.reported if any(each.contradicts for each in item.asked)]
    if other:
        no = ", nor" if bound else "; do not trust as physics"
        do += f"{no} the effects that the accelerations contradict ({', '.join(other)})"
    return f"{has} On held-out flights {errors}. {do}."


def _interval(item: Reported) -> str:
    """The 95 % interval of an effect with one number; empty for several numbers."""
    found = numbers(item)
    if len(found) != 1:
        return ""
    low, high = (found[0].value + side * 1.96 * found[0].std for side in (-1, 1))
    return f" (95 % interval {low:.4g} to {high:.4g})"


def _bought(diagnosis: Diagnosis) -> str:
    """Sentence on the largest reduction of a held-out error at the longest horizon."""
    before, after = (not_none(found.metrics("commands_in")) for found in (diagnosis.before, diagnosis.after))
    horizon = f"@{max(diagnosis.before.horizons):g}s"
    keys = [key for key in before if "_rmse_" in key and key.endswith(horizon)]
    key = min(keys, key=lambda k: after[k] / before[k])
    quantity, _, unit = key.partition("@")[0].split("_")
    unit = {"mps": "m/s", "radps": "rad/s"}.get(unit, unit)
    return (
        f"On held-out flights the {quantity} error {horizon[1:-1]} s ahead goes from {before[key]:.3g} to "
        f"{after[key]:.3g} {unit} ({change(before[key], after[key])})."
    )


RATE, ROWS = 40.0, 1500
"""Largest number of rows per second, and of rows in all flights. Residuals are smoothed, so few rows suffice."""
FLIGHTS = 6
"""Largest number of flights in a recording."""


def write_recording(
    path: Path, rows: tuple[list[Residuals], list[Residuals]], before: Evaluation, after: Evaluation
) -> None:
    """Write a recording that `rerun` opens.

    For each flight, under its name: ``residual/<axis>/before|after``, ``signal/<name>``, and in 3D the measured pose
    and path with the predictions of both models from the start of every window.

    Args:
        path: file to write, ``.rrd``.
        rows: residuals of the held-out flights before and after, at the same times.
        before: evaluation of the declared model on the same flights, in the same order.
        after: evaluation of the corrected model.

    Raises:
        CfbError: rerun is not installed or the file cannot be written.
    """
    tabs = [tab(one.log, part(one.log.name)) for one in before.logs[:FLIGHTS]]
    seconds = sum(log.log.duration for log in before.logs[:FLIGHTS])
    rate = min(RATE, ROWS / max(seconds, 1e-3))
    with recording("cfb_close_loop", tabs, path) as recorder:
        for index, (old, new) in enumerate(list(zip(*rows, strict=True))[:FLIGHTS]):
            root = part(old.name)
            record_residuals(recorder, root, {"before": (old, BEFORE), "after": (new, AFTER)}, rate)
            record_flight(recorder, root, before.logs[index], rate)
            for label, evaluated, colour in (("before", before, BEFORE), ("after", after, AFTER)):
                record_predictions(recorder, f"{root}/world/prediction_{label}", evaluated.logs[index], colour)


def tab(log: FlightLog, root: str, more: tuple[Plot, ...] = ()) -> Tab:
    """A tab with the flight in 3D and plots of ``more``, its residuals and its velocity."""
    residuals = tuple(
        Plot(f"residual: {what}", tuple(f"{root}/residual/{key}_{axis}/**" for axis in "xyz"))
        for key, what in (("torque", "torque / inertia"), ("force", "force / mass"))
    )
    velocity = Plot("velocity, body axes", tuple(f"{root}/signal/velocity_{axis}" for axis in "xyz"))
    seen = np.stack([log.position.min(axis=0), log.position.max(axis=0)])
    return Tab(log.name, f"{root}/world", (*more, *residuals, velocity), seen)


def record_residuals(
    recorder: Recorder, root: str, residuals: dict[str, tuple[Residuals, str | None]], rate: float
) -> None:
    """Record the residuals of one flight, and the signals on which they could depend.

    Args:
        recorder: the open recording.
        root: entity of the flight.
        residuals: label to residuals (of the same rows) and colour; None: the colour of the axis.
        rate: rows per second to keep.
    """
    first = next(iter(residuals.values()))[0]
    step = max(1, round(1 / (rate * float(np.median(np.diff(first.time))))))
    keep = np.flatnonzero(first.valid)[::step]
    time = first.time[keep]
    for label, (flight, colour) in residuals.items():
        for axis, (values, unit) in flight.axes().items():
            if np.isfinite(values[keep]).any():
                entity = f"{root}/residual/{_plain(axis)}/{label}"
                own = AXES.get(axis[-1]) if colour is None else colour
                recorder.series(entity, time, values[keep], f"{axis} {label}, {unit}", own)
    for name, values in first.drivers.items():
        if np.isfinite(values[keep]).any():
            recorder.series(
                f"{root}/signal/{_plain(name)}", time, values[keep], f"{name}, {UNITS[name]}", AXES.get(name[-1])
            )


def record_flight(
    recorder: Recorder, root: str, evaluated: LogEvaluation, rate: float, thrust: np.ndarray | None = None
) -> None:
    """Record the measured path and pose, and the thrust (n, 4) [N] of every row of the log, if given."""
    log, world = evaluated.log, f"{root}/world"
    step = max(1, round(1 / (rate * max(log.nominal_interval, 1e-4))))
    recorder.world(world)
    recorder.line(f"{world}/measured_path", log.position[::step], LIGHT)
    # Pose rows lag by the delay; the recording shows them at the time at which they were true.
    time = log.time[::step] - evaluated.delay
    arrows = None if thrust is None else thrust[::step]
    recorder.drone(f"{world}/drone", time, log.position[::step], log.quaternion[::step], arrows)


def record_predictions(recorder: Recorder, entity: str, evaluated: LogEvaluation, colour: str) -> None:
    """Record the predicted path from the start of every window."""
    said, windows = evaluated.predictions["commands_in"], evaluated.windows
    if said is not None:
        strips = np.concatenate([windows.position[:, None], np.asarray(said.position)], axis=1)
        recorder.lines(entity, windows.start, strips, colour)


def _plain(name: str) -> str:
    """A name as one part of an entity's path, without blanks."""
    return name.replace(" ", "_")


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


def write_report(
    diagnosis: Diagnosis,
    folder: Path,
    facts: Mapping[str, object],
    logs_fit: list[FlightLog],
    logs_held_out: list[FlightLog],
) -> None:
    """Write ``report.html``, which is self-contained, and ``residual.rrd`` into a folder.

    Args:
        diagnosis: result of `cfb_mjx.sysid.tracing.closing.close_loop`.
        folder: an existing folder; each file in it is replaced atomically.
        facts: date, machine and versions, printed at the end.
        logs_fit: the fit flights, as read.
        logs_held_out: the held-out flights, as read.

    Raises:
        CfbError: a file cannot be written, or rerun is not installed.
    """
    folder = Path(folder)
    with scratch() as drawn:
        figures = draw(diagnosis, Path(drawn))
        found = sections(diagnosis, figures, logs_fit, logs_held_out)
        page = html_page(f"Model correction of {diagnosis.base.name}", verdict(diagnosis), found, facts)
    write_recording(folder / "residual.rrd", diagnosis.held_out.rows, diagnosis.before, diagnosis.after)
    write_text(folder / "report.html", page)
