"""Fit one model to several drones of a type; write the preset cfb-fleet and docs/one-model.md.

    python scripts/one_model.py NAME=FOLDER,MODEL,MASS_KG ... --loops out/real-loops [--bench TABLE.csv ...]

Run `real_loops.py` first. As there, FOLDER holds fit/ and validation/, and MODEL is a preset or the NAME of an earlier
drone. The fit of a drone starts from LOOPS/NAME/model.yaml. The same numbers are fitted for all drones, plus those of
effects that one drone alone has (a load); `cfb_mjx.sysid.fleet` computes the common model. Each drone is then predicted
with the type fitted to the other drones. BENCH tables have rotor speeds (rpm) and the thrust of four rotors (g). Only
aggregate numbers are written; the flights do not become part of the project.
"""

import argparse
import csv
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import matplotlib
import numpy as np

from cfb_mjx.files import write_text
from cfb_mjx.logs import FlightLog, read_log
from cfb_mjx.model import Quadrotor, thrust
from cfb_mjx.model.effects import KNOWN
from cfb_mjx.model.effects.fields import HOVER_SPEED
from cfb_mjx.parameters import Entry, ModelFile, load_model_file, save_model_file
from cfb_mjx.runtime import configure_jax, environment
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.fleet import Fleet, OfDrone, fleet
from cfb_mjx.sysid.observer import Observer
from cfb_mjx.sysid.refinement import Number, Refinement, plausible_numbers, refine
from cfb_mjx.sysid.refinement.numbers import PLANT
from cfb_mjx.sysid.refinement.predictions import ALIKE, kinds_alike

ROOT = Path(__file__).resolve().parents[1]
PAGE, FIGURE = ROOT / "docs" / "one-model.md", ROOT / "docs" / "one-model.png"
PRESET = ROOT / "configs" / "parameters" / "cfb-fleet.yaml"
OWN = ("cog_offset", "thrust_tilt", "position_moment")
"""Drone-specific effects: zero in the type, with a spread."""
OF_MOTORS = ("command_delay", "motor_asymmetry", "battery_sag")
COMMON = tuple(name for name in PLANT if name not in OF_MOTORS)
MOTORS = ("motor_gain", "motor_speed_offset", "motor_time_constant")
VARIANTS = ("commands_in", "rotor_speed_in", "commands_in_observer", "rotor_speed_in_observer")
HORIZON, WINDOWS, STEPS = 0.5, 400, 15
BODY = "cfb"
"""Preset with the body of the type."""
CURVE = (800.0, 2600.0)
"""Range of rotor speeds in which thrust curves are compared, rad/s."""


@dataclass(frozen=True)
class Drone:
    """A drone: its flights, its declared model and the model that `cfb close-loop` found."""

    name: str
    folder: Path
    declared: ModelFile
    found: ModelFile

    def _flights(self, side: str) -> list[FlightLog]:
        return [read_log(path) for path in sorted((self.folder / side).iterdir())]

    @cached_property
    def fit_logs(self) -> list[FlightLog]:
        return self._flights("fit")

    @cached_property
    def judged(self) -> list[FlightLog]:
        return self._flights("validation")

    @cached_property
    def extras(self) -> tuple[str, ...]:
        """Effects that this drone alone has."""
        return tuple(item["name"] for item in self.found.effects if item["name"] not in PLANT)

    def refined(self, model: Quadrotor, names: tuple[str, ...]) -> Refinement:
        numbers = plausible_numbers(model.parameters, names)
        weights = kinds_alike(model, self.fit_logs)
        return refine(model, self.fit_logs, numbers, weights=weights, iterations=STEPS, most_windows=WINDOWS)

    @cached_property
    def fit(self) -> Refinement:
        print(f"{self.name}: fitting it", flush=True)
        return self.refined(Quadrotor.from_file(self.found), (*COMMON, *self.extras))

    @cached_property
    def of_drone(self) -> OfDrone:
        """The fitted numbers that belong to the type: without a load, with the slope of the battery sag."""
        whole = OfDrone.fitted(self.name, self.fit)
        kept = [i for i, n in enumerate(whole.numbers) if n.effect in COMMON]
        numbers, values = [whole.numbers[i] for i in kept], [whole.values[i] for i in kept]
        covariance = whole.covariance[np.ix_(kept, kept)]
        for item in self.found.effects:
            if item["name"] == "battery_sag":
                numbers.append(Number("battery_sag", "slope", None, *KNOWN["battery_sag"].prior["slope"]))
                values.append(item["parameters"]["slope"])
                std = item.get("uncertainty", {}).get("slope") or 0.0
                covariance = np.block([[covariance, np.zeros((len(kept), 1))], [np.zeros((1, len(kept))), std**2]])
        return OfDrone(self.name, tuple(numbers), np.array(values), covariance)


def of_motors(drones: list[Drone]) -> dict[str, Entry]:
    """Return the motor constants of the type: those of the drone with the median hover command.

    The meaning of a command of 1 differs between laboratories (firmware, batteries). Gain and offset belong together,
    so a mean over drones would describe no drone. The spread is that between the motors of one drone.
    """
    each = {n: np.array([np.broadcast_to(d.found.entries[n].value, 4) for d in drones]) for n in MOTORS}
    hover = (HOVER_SPEED - each["motor_speed_offset"].mean(axis=1)) / each["motor_gain"].mean(axis=1)
    middle = int(np.argsort(hover)[len(drones) // 2])
    source = f"mean of the four motors of {drones[middle].name}, whose hover command is the middle one of {len(drones)}"
    found = {}
    for name, values in each.items():
        spread = np.sqrt(values.var(axis=1, ddof=1).mean())
        found[name] = Entry(np.full(4, values[middle].mean()), source, None, np.full(4, spread))
    return found


def type_of(drones: list[Drone], name: str) -> tuple[ModelFile, Fleet]:
    """Return the model of the type that is fitted to some drones."""
    common = fleet([drone.of_drone for drone in drones], OWN)
    names = ", ".join(drone.name for drone in drones)
    mappings = common.mappings(f"fitted to flights of {len(drones)} drones ({names}): docs/one-model.md")
    for item in mappings:
        item["source"] = f"{KNOWN[item['name']].source}; {item['source']}"
        if item["name"] == "battery_sag":
            # A short lag, and no offset: the gain holds at 3.7 V.
            item["parameters"] |= {"level": 0.0, "lag": 0.02}
    body = load_model_file(BODY)
    file = replace(
        body,
        name=name,
        description="The Crazyflie Brushless as a type: the paper's model, and what all of several laboratories' drones"
        " lack beside it. `uncertainty` is that of the type's number, `spread` the standard deviation between drones"
        " (--randomise cfb-fleet draws such drones). docs/one-model.md says what it is worth.",
        entries={**body.entries, **of_motors(drones)},
        effects=tuple(mappings),
    )
    return file, common


def own_fitted(drone: Drone, of_type: ModelFile) -> Quadrotor:
    """Return the type with motors, centre of gravity, tilt and a load fitted to the flights of one drone."""
    mass = drone.declared.entries["mass"]
    motors = {name: drone.found.entries[name] for name in MOTORS}
    model = Quadrotor.from_file(replace(of_type, entries={**of_type.entries, "mass": mass, **motors}))
    loads = tuple(e for e in Quadrotor.from_file(drone.found).effects if type(e).name in drone.extras)
    model = Quadrotor(model.parameters, (*model.effects, *loads), body=model.body)
    return drone.refined(model, ("cog_offset", "thrust_tilt", *drone.extras)).model


def errors(model: Quadrotor, logs: list[FlightLog]) -> dict[str, tuple[float, float]]:
    """Return the mean attitude (rad) and velocity (m/s) error half a second ahead, by variant."""
    found = evaluate(model, logs, observer=Observer(), keep_diverged=True)
    told = {name: found.metrics(name) for name in (*VARIANTS, "hold")}
    key = f"@{HORIZON}s"
    return {n: (np.radians(m[f"attitude_mean_deg{key}"]), m[f"velocity_mean_mps{key}"]) for n, m in told.items() if m}


def gentle(drone: Drone) -> list[FlightLog]:
    """Return the flights with the smallest error of `hold`, within a factor of `ALIKE`."""
    each = {log.name: errors(Quadrotor.from_file(drone.declared), [log])["hold"][0] for log in drone.judged}
    return [log for log in drone.judged if each[log.name] <= ALIKE * min(each.values())]


def models(drone: Drone, drones: list[Drone]) -> dict[str, Quadrotor]:
    """Return the models that a drone is predicted with, by their names on the page."""
    mass, others = drone.declared.entries["mass"], [other for other in drones if other is not drone]
    of_type, _ = type_of(others, "others")
    found = {"declared model": Quadrotor.from_file(drone.declared)}
    for other in others:
        model = replace(other.found, entries={**other.found.entries, "mass": mass})
        found[f"{other.name}'s model"] = Quadrotor.from_file(model)
    found["type from the others"] = Quadrotor.from_file(replace(of_type, entries={**of_type.entries, "mass": mass}))
    found["the same, drone-specific fit"] = own_fitted(drone, of_type)
    found["its own model"] = Quadrotor.from_file(drone.found)
    return found


def judged_table(drone: Drone, drones: list[Drone]) -> list[str]:
    """Return the section with the errors of all models on a drone's validation flights."""
    few, rows = gentle(drone), models(drone, drones)
    lines = [f"### {drone.name}", ""]
    kinds = {"all validation flights": drone.judged}
    if len(few) < len(drone.judged):
        kinds[f"gentle flights ({', '.join(log.name for log in few)})"] = few
    for words, logs in kinds.items():
        print(f"{drone.name}: {words}", flush=True)
        head = " | ".join(name.replace("_", " ").replace(" observer", ", observer") for name in VARIANTS)
        lines += [f"{words[0].upper()}{words[1:]}:", "", f"| model | {head} |", "|---|" + "---|" * len(VARIANTS)]
        still = None
        for name, model in rows.items():
            found = errors(model, logs)
            still = found["hold"]
            lines.append(f"| {name} | " + " | ".join("{:.3f} / {:.3f}".format(*found[v]) for v in VARIANTS) + " |")
        lines += ["| hold | " + " | ".join(["{:.3f} / {:.3f}".format(*still)] * len(VARIANTS)) + " |", ""]
    return lines


def bench(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a bench table; return rotor speed [rad/s] and thrust of one rotor [N]."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file, skipinitialspace=True))
    speeds = [key for key in rows[0] if key.startswith("rpm")]
    grams = next(key for key in rows[0] if key.endswith("[g]"))
    each = np.array([[float(row[key]) for key in speeds] for row in rows])
    # A speed far below that of the other rotors is a missed reading.
    each[each < 0.5 * each.max(axis=1, keepdims=True)] = np.nan
    return np.nanmean(each, axis=1) * np.pi / 30, np.array([float(row[grams]) for row in rows]) * 9.81e-3 / 4


def against_curve(speed: np.ndarray, force: np.ndarray) -> tuple[float, float]:
    """Return the least-squares excess of measured thrust over the paper's curve, and the relative rms residual."""
    paper = Quadrotor.from_file(BODY).parameters
    inside = (speed > CURVE[0]) & (speed < CURVE[1])
    curve = np.asarray(thrust(paper, np.repeat(speed[inside][:, None], 4, 1)))[:, 0]
    share = float(curve @ force[inside] / (curve @ curve))
    return share - 1, float(np.sqrt(np.mean((force[inside] - share * curve) ** 2)) / force[inside].mean())


def draw(drones: list[Drone], common: Fleet, tables: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Draw the numbers of each drone and of the type, and the thrust curves of the type and of benches."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = [i for i, n in enumerate(common.numbers) if n.effect not in OWN]
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 5.5), width_ratios=(3, 2), layout="constrained")
    for row, i in enumerate(reversed(shown)):
        number, scale = common.numbers[i], max(abs(common.values[i]), 1e-12)
        left.errorbar(
            common.values[i] / scale, row, xerr=common.spread[i] / scale, fmt="k|", ms=12, capsize=3, lw=1.2, zorder=1
        )
        for drone, colour in zip(drones, ("#0072B2", "#E69F00", "#009E73", "#CC79A7"), strict=False):
            for own, value in zip(drone.of_drone.numbers, drone.of_drone.values, strict=True):
                if (own.effect, own.field, own.index) == (number.effect, number.field, number.index):
                    left.plot(value / scale, row, "o", color=colour, ms=5, label=drone.name if row == 0 else None)
    left.set_yticks(range(len(shown)), [common.numbers[i].name for i in reversed(shown)], fontsize=8)
    left.set_xlabel("over the type's value; bar: spread between drones")
    left.set_xlim(-3, 5)
    left.axvline(0, color="0.8", lw=0.8, zorder=0)
    left.legend(loc="upper right", fontsize=8)
    speed, paper = np.linspace(*CURVE, 200), Quadrotor.from_file(BODY).parameters
    curve = np.asarray(thrust(paper, np.repeat(speed[:, None], 4, 1)))[:, 0]
    for name, (at, force) in tables.items():
        inside = (at > CURVE[0]) & (at < CURVE[1])
        right.plot(at[inside], force[inside], ".", ms=2, color="0.6", zorder=0)
        right.plot([], [], ".", color="0.6", label=f"bench: {name}")
    place = next(i for i, n in enumerate(common.numbers) if n.name == "thrust_scale.relative")
    right.plot(speed, curve, "k--", lw=1, label="paper")
    right.plot(speed, curve * (1 + common.values[place]), "k", label="the type, from flights")
    low, high = (curve * (1 + common.values[place] + side * common.spread[place]) for side in (-1, 1))
    right.fill_between(speed, low, high, color="k", alpha=0.15, lw=0)
    right.set_xlabel("rotor speed, rad/s")
    right.set_ylabel("thrust of a rotor, N")
    right.legend(fontsize=8)
    figure.savefig(FIGURE, dpi=110)


def page(drones: list[Drone], common: Fleet, of_type: ModelFile, tables: dict) -> str:
    """Return the page as Markdown."""
    facts = ", ".join(f"{name} {value}" for name, value in environment().items())
    lines = ["# One model for every Crazyflie Brushless", ""]
    lines += [f"Written by `python scripts/one_model.py`; do not edit. {facts}", ""]
    lines += [
        "This page is for readers whose drone was not measured yet. The preset `cfb-fleet` is a model of the type of",
        f"drone, fitted to flights of {len(drones)} drones:",
        "",
        "| use | command |",
        "|---|---|",
        "| predict a drone that was not measured yet | `cfb evaluate my.csv --model cfb-fleet --set mass=0.037` |",
        "| start a model correction | `cfb close-loop ... --model cfb-fleet` |",
        "| fly with measured randomisation | `cfb fly pid --model cfb-fleet --magnitude 1 --randomise cfb-fleet` |",
        "| train with it | `cfb train target --model cfb-fleet --randomise cfb-fleet -o out` |",
        "",
        "Each drone was fitted separately to predictions of its flights. The fitted numbers are the same for all",
        "drones, plus those of the effects that one drone alone has (a load). The spread between drones is the scatter",
        "of the fits minus what their errors explain. The type's numbers are the mean weighted by spread and errors.",
        "",
        "Two limits apply. With so few drones a spread is known to about half its size, and it is zero where all",
        "drones are at one bound. Predictions of flights with feedback give more inertia and more damping than",
        "accelerations do ([real loops](real-loops.md) names where), and the type has both.",
        "",
        "![Numbers of the drones and the type; thrust curves](one-model.png)",
        "",
        "## Numbers",
        "",
        "*Drone-specific* numbers have a spread but no value for the type. The motor constants of the type are those",
        "of the drone whose hover command is the middle one: what a command of 1 means differs between laboratories,",
        "so gain and offset belong together.",
        "",
        "| number | " + " | ".join(d.name for d in drones) + " | the type | spread between drones |",
        "|---|" + "---|" * (len(drones) + 2),
    ]
    for number, value, std, spread in zip(common.numbers, common.values, common.std, common.spread, strict=True):
        cells = []
        for drone in drones:
            at = [i for i, n in enumerate(drone.of_drone.numbers) if n.name == number.name]
            error = np.sqrt(np.diag(drone.of_drone.covariance))
            texts = [f"± {e:.1g}" if e > 0 else "at a bound" for e in error]
            cells.append("".join(f"{drone.of_drone.values[i]:.3g} {texts[i]}" for i in at))
        kind = "drone-specific" if number.effect in OWN else f"{value:.3g} ± {std:.1g}"
        lines.append(f"| {number.name} | " + " | ".join(cells) + f" | {kind} | {spread:.2g} |")
    for name in MOTORS:
        entry = of_type.entries[name]
        cells = [f"{np.mean(d.found.entries[name].value):.4g}" for d in drones]
        lines.append(
            f"| {name}, mean of four | " + " | ".join(cells) + f" | {entry.value[0]:.4g}, of the middle drone |"
            f" {entry.spread[0]:.2g}, between motors of one drone |"
        )
    for drone in drones:
        for name in drone.extras:
            own = next(item for item in drone.found.effects if item["name"] == name)["parameters"]
            told = ", ".join(f"{key} {value:.4g}" for key, value in own.items() if np.ndim(value) == 0)
            lines += ["", f"Only {drone.name} has `{name}`: {told}."]
    if tables:
        lines += ["", "Check on thrust benches (not part of the fit): thrust relative to the paper's curve, least"]
        lines[-1] += f" squares between {CURVE[0]:.0f} and {CURVE[1]:.0f} rad/s:"
        for name, table in tables.items():
            share, rms = against_curve(*table)
            lines += ["", f"- {name}: {100 * share:+.1f} %, rms of the residual {100 * rms:.1f} % of the mean thrust"]
    lines += [
        "",
        "## Errors on a drone that the type was not fitted to",
        "",
        "Each cell is the mean error of attitude (rad) / velocity (m/s) half a second ahead, on validation flights.",
        "",
        "| model | what it is |",
        "|---|---|",
        "| type from the others | fitted to the other drones; of this drone only the mass is used |",
        "| the same, drone-specific fit | motors, centre of gravity, tilt and a load fitted to the drone's fit "
        "flights, all common numbers held |",
        "| its own model | found by `cfb close-loop` on the drone's fit flights ([real loops](real-loops.md)) |",
        "| hold | constant velocity and constant body rate |",
        "",
        f"*Gentle flights* are those with the smallest error of `hold`, within a factor of {ALIKE:g}.",
        "",
    ]
    for drone in drones:
        lines += judged_table(drone, drones)
    return "\n".join(lines)


def main() -> None:
    """Write the preset of the type, the page and the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drones", nargs="+", metavar="NAME=FOLDER,MODEL,MASS_KG")
    parser.add_argument("--loops", type=Path, default=ROOT / "out" / "real-loops")
    parser.add_argument("--bench", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    configure_jax(x64=True)
    drones, declared = [], {}
    for drone in options.drones:
        name, _, rest = drone.partition("=")
        folder, model, mass = rest.split(",")
        preset = declared.get(model, model)
        declared[name] = preset
        own = load_model_file(preset, [f"mass={mass}"])
        drones.append(Drone(name, Path(folder), own, load_model_file(options.loops / name / "model.yaml")))
    of_type, common = type_of(drones, "cfb-fleet")
    save_model_file(of_type, PRESET)
    tables = {path.stem: bench(path) for path in options.bench}
    draw(drones, common, tables)
    write_text(PAGE, page(drones, common, of_type, tables) + "\n")


if __name__ == "__main__":
    main()
