"""The campaigns of the tracing sweep: single effects, mixtures, effects outside the catalogue, clean and hard drones.

    python scripts/tracing_cases.py [--seed 97000]

searches for the strengths at which effects cause between an eighth and a third of an error, and writes them to
benchmarks/tracing_mild.json.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from cfb_mjx.reference_simulator import EFFECTS, PAIRED, Case, fly_campaigns
from cfb_mjx.sysid.tracing.jointly import ERRORS

ROOT = Path(__file__).resolve().parents[1]
MILD = ROOT / "benchmarks" / "tracing_mild.json"
SEED = 97_000
"""Seed of the sweep; the search for effects was developed on other seeds."""
WEAK, BESIDE = 0.35, 0.5
LEAST, MOST = 0.12, 0.30
"""Range of the share of an error that a mild effect causes."""
MIDDLE = 0.2
SEARCHED, ROUNDS = (1 / 256, 2.0), 7
WEAKEST = {"motor_second_order": 0.1}
"""Least strength in the search; the step of the simulator is too long for a shorter second lag."""

SINGLE = [name for name in EFFECTS if not name.startswith(("outside", PAIRED))]
SENSORS = [name for name in SINGLE if name.startswith("sensor")]
PHYSICAL = [name for name in SINGLE if name not in SENSORS]
OUTSIDE = [name for name in EFFECTS if name.startswith("outside")]

MIXTURES = [
    ("rotor_drag", "cog_offset"),
    ("inflow_thrust", "battery_sag"),
    ("ground_effect", "motor_gain_mismatch"),
    ("blade_flapping", "inertia"),
    ("payload", "command_delay"),
    ("parasitic_drag", "torque_scale"),
    ("motor_thermal_drift", "rotor_drag"),
    ("thrust_tilt", "inflow_thrust"),
    ("motor_time_constant", "rotor_drag", "cog_offset"),
    ("wind", "motor_gain_mismatch"),
    ("motor_second_order", "parasitic_drag"),
    ("thrust_scale", "ground_effect", "rotor_drag"),
]
"""One strong effect and others of half the strength."""
UNEVEN = [
    ("motor_gain_mismatch", "rotor_drag"),
    ("cog_offset", "inflow_thrust", "battery_sag"),
    ("payload", "parasitic_drag"),
    ("rotor_drag", "motor_time_constant"),
    ("thrust_scale", "blade_flapping", "wind"),
    ("battery_sag", "ground_effect"),
    ("motor_second_order", "cog_offset", "rotor_drag"),
    ("wind", "inertia"),
    ("blade_flapping", "motor_asymmetry"),
    ("inertia", "thrust_tilt", "parasitic_drag"),
]
"""One strong effect and weak ones."""
FAULTY = [
    ("sensor_velocity_scale", "rotor_drag"),
    ("sensor_delay", "motor_gain_mismatch"),
    ("sensor_time_shift", "inertia"),
    ("sensor_gyro_lowpass", "blade_flapping"),
]
"""A sensor fault and an effect of half the strength."""
MANY = (6, 6, 8, 8, 10, 10, 12, 12)
"""Numbers of simultaneous effects, as on real drones; their strengths are drawn from `STRENGTHS`."""
STRENGTHS = (0.3, 0.8)
ALIKE = {"payload": ("thrust_scale", "payload_swing"), "motor_time_constant": ("motor_asymmetry",)}
"""Effects that no flight can distinguish from the key; they are not drawn together with it."""


def cases(nulls: int, seed: int) -> list[Case]:
    """Return every campaign of the sweep, in random order, so that an interrupted sweep is a random sample."""
    found = [Case(f"{name}-strong", seed + i, ((name, 1.0),)) for i, name in enumerate(SINGLE)]
    found += [Case(f"{name}-weak", seed + 100 + i, ((name, WEAK),)) for i, name in enumerate(SINGLE)]
    found += [_mixed("", seed + 200 + i, names, BESIDE) for i, names in enumerate(MIXTURES)]
    found += [
        Case(f"{name}-{k}", seed + 300 + 10 * i + k, ((name, 1.0),)) for i, name in enumerate(OUTSIDE) for k in (1, 2)
    ]
    found += hard_cases(seed)
    found += [many(f"many-{count}-{i + 1}", seed + 900 + i, count) for i, count in enumerate(MANY)]
    found += [Case(f"clean-{i}", seed + 1000 + i, ()) for i in range(nulls)]
    return [found[i] for i in np.random.default_rng(seed).permutation(len(found))]


def hard_cases(seed: int) -> list[Case]:
    """Return the hard cases: mild effects, uneven mixtures, and sensor faults alone and with an effect."""
    mild = json.loads(MILD.read_text())
    found = [_mild(name, seed, mild[name]) for name in PHYSICAL if name in mild]
    found += [_mixed("uneven-", seed + 500 + i, names, WEAK) for i, names in enumerate(UNEVEN)]
    found += [
        Case(f"{name}-{k}", seed + 600 + 10 * i + k, ((name, strength),))
        for i, name in enumerate(SENSORS)
        for k, strength in ((1, 0.6), (2, 0.8))
    ]
    return found + [_mixed("faulty-", seed + 700 + i, names, BESIDE) for i, names in enumerate(FAULTY)]


def many(name: str, seed: int, count: int) -> Case:
    """Return a drone with ``count`` physical effects at once."""
    rng = np.random.default_rng([seed, 3000])
    drawn = [str(effect) for effect in rng.permutation(PHYSICAL)]
    drawn = [effect for effect in drawn if not set(ALIKE.get(effect, ())) & set(drawn[:count])][:count]
    return Case(name, seed, tuple((effect, float(rng.uniform(*STRENGTHS))) for effect in drawn))


def alone(case: Case) -> dict[str, Case]:
    """Return the drones that have one effect of the case each, with the same strength."""
    return {
        name: Case(f"{case.name}, {name}", case.seed, tuple((n, s if n == name else 0.0) for n, s in case.effects))
        for name, _ in case.effects
    }


def _mild(name: str, seed: int, strength: float) -> Case:
    return Case(f"{name}-mild", seed + 400 + PHYSICAL.index(name), ((name, strength),))


def _mixed(kind: str, seed: int, names: tuple[str, ...], others: float) -> Case:
    return Case(kind + "+".join(names), seed, tuple((n, others if i else 1.0) for i, n in enumerate(names)))


def achievable(before: dict[str, float], perfect: dict[str, float]) -> float:
    """Return the largest share by which a perfect model would lower an error."""
    return max(1 - perfect[key] / before[key] for key in ERRORS)


def mild_strengths(seed: int) -> dict[str, float]:
    """Return the strength at which each physical effect causes a share nearest `MIDDLE` of an error, if it is mild."""
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.parameters import load_model_file
    from cfb_mjx.sysid.evaluation import evaluate

    model = Quadrotor.from_file(load_model_file("cfb-guards"))

    def errors(flown):
        return [evaluate(model, campaign.held_out).metrics("commands_in") for campaign in flown]

    # The same seed gives the same flights without the effect.
    perfect = errors(fly_campaigns([replace(_mild(name, seed, 1.0), effects=()) for name in PHYSICAL]))
    low = np.log([WEAKEST.get(name, SEARCHED[0]) for name in PHYSICAL])
    high = np.full(len(PHYSICAL), np.log(SEARCHED[1]))
    found = {}
    for _ in range(ROUNDS):
        tried = np.exp(0.5 * (low + high))
        before = errors(fly_campaigns([_mild(n, seed, float(s)) for n, s in zip(PHYSICAL, tried, strict=True)]))
        bought = np.array([achievable(*pair) for pair in zip(before, perfect, strict=True)])
        for name, strength, share in zip(PHYSICAL, tried, bought, strict=True):
            if abs(share - MIDDLE) < abs(found.get(name, (0, np.inf))[1] - MIDDLE):
                found[name] = float(strength), float(share)
        much = bought > MIDDLE
        low, high = np.where(much, low, np.log(tried)), np.where(much, np.log(tried), high)
        print(", ".join(f"{n} {s:.3g}: {b:.0%}" for n, s, b in zip(PHYSICAL, tried, bought, strict=True)), flush=True)
    return {name: float(f"{strength:.3g}") for name, (strength, share) in found.items() if LEAST <= share <= MOST}


if __name__ == "__main__":
    from cfb_mjx.files import write_text
    from cfb_mjx.runtime import configure_jax

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("-o", type=Path, default=MILD)
    arguments = parser.parse_args()
    configure_jax(x64=True)
    write_text(arguments.o, json.dumps(mild_strengths(arguments.seed), indent=1) + "\n")
