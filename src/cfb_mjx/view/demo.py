"""Page of `cfb demo`: predictions, randomised drones and a real flight."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cfb_mjx.view.page import Section, html_page

QUANTITIES = (
    ("position", "m", "m"),
    ("velocity", "mps", "m/s"),
    ("attitude", "deg", "deg"),
    ("rate", "radps", "rad/s"),
)
"""Name, unit in JSON keys, unit as printed."""
_VARIANTS = {"commands_in": "model, commands in", "rotor_speed_in": "model, rotor speed in", "hold": "hold"}


def demo_page(result: dict[str, Any], folder: Path) -> str:
    """Build the page of the demonstration.

    Args:
        result: result of `cfb_mjx.demo.demonstrate`, with ``environment`` and ``wall_s``.
        folder: folder of the figures.

    Returns:
        The HTML as text.
    """
    flight, flown, real = result["flight"], result["rollouts"], result["real"]
    distance, tilt = flown["distance_m@0.5s"], flown["tilt_deg@0.5s"]

    def errors(block: dict) -> tuple:
        caption = f"RMS error over {block['windows']} windows [95 % bootstrap interval]"
        return caption, ["quantity", "predicted by", *_horizons(block)], error_rows(block)

    sections = [
        Section(
            f"One flight, predicted by {result['model']}",
            [
                flight["origin"],
                f"Every 0.2 s of {flight['duration_s']:.1f} s of flight, the model starts from the measured state and "
                "predicts half a second without feedback. Commands in: its input is the motor commands. Rotor speed "
                "in: its input is the measured rotor speeds, so the motor model has no influence. Hold: constant "
                "velocity and constant body rate, a baseline without physics. In the figure, a prediction starts at an "
                "open circle; a prediction that diverges leaves its panel.",
            ],
            [errors(flight)],
            [(folder / "prediction.png", "Measured flight with open-loop predictions; error against horizon")],
        ),
        Section(
            f"{flown['drones']} randomised drones",
            [
                "All drones start from the same measured state and receive the same commands of the flight, for half a "
                "second without feedback. Mass, inertia, motors, thrust, torque and centre of gravity are drawn from "
                "the paper's ranges. Without feedback, an error of a few millimetres in the centre of gravity makes a "
                "drone tip over. A controller trained on such drones must stabilise all of them.",
                f"Each drone flies {flown['steps']} steps of {flown['step_s'] * 1e3:g} ms; every "
                f"{flown['kept_every']}th state is kept for the figure. Keeping only the last state is faster: see cfb "
                "bench.",
            ],
            [
                (
                    "Throughput, and position and tilt of the drones after 0.5 s",
                    ["", "value"],
                    [
                        ["steps per second (best of 3 runs)", f"{flown['steps_per_s'] / 1e6:.1f} million"],
                        ["run", f"{flown['run_s'] * 1e3:.1f} ms"],
                        ["compilation (or loading a cached program)", f"{flown['compile_s']:.1f} s"],
                        ["precision", flown["precision"]],
                        ["distance from the flight: 5, 50, 95 %", _spread_text(distance, "m")],
                        ["tilt: 5, 50, 95 %", _spread_text(tilt, "deg")],
                    ],
                )
            ],
            [(folder / "spread.png", "Quantile bands of position and tilt over half a second")],
        ),
    ]
    if "skipped" not in real:
        sections.append(
            Section(
                f"A real flight: {real['log']}",
                [
                    real["verdict"],
                    f"The vehicle weighs {real['mass_kg'] * 1e3:g} g, and the model's mass is set to that; every other "
                    "constant is the declared one. The attitude is open-loop unstable, so a small error of torque "
                    "grows quickly. Fitting the model to logs reduces such errors.",
                ],
                [errors(real)],
                [(folder / "real.png", "Real flight with open-loop predictions; error against horizon")],
            )
        )
    else:
        sections.append(Section("A real flight", [f"Skipped: {real['skipped']}"]))
    lead = (
        "Predictions of the declared model, its speed, and a flight on which it fails. "
        f"Made in {result['wall_s']:.0f} s."
    )
    return html_page("cfb_mjx demo", lead, sections, result["environment"])


def error_rows(result: dict[str, Any]) -> list[list[str]]:
    """One row per quantity and variant: RMS error at every horizon, with its bootstrap interval."""
    rows = []
    for quantity, unit, label in QUANTITIES:
        for variant, name in _VARIANTS.items():
            if result[variant] is None:
                continue
            cells = []
            for key in _keys(result, quantity, unit):
                low, high = result["intervals"][variant][key]
                cells.append(f"{result[variant][key]:.3g} [{low:.3g}, {high:.3g}]")
            rows.append([f"{quantity}, {label}", name, *cells])
    return rows


def _keys(result: dict, quantity: str, unit: str) -> list[str]:
    return [key for key in result["hold"] if key.startswith(f"{quantity}_rmse_{unit}@")]


def _horizons(result: dict) -> list[str]:
    return [f"{float(key.partition('@')[2][:-1]) * 1e3:.0f} ms" for key in _keys(result, "position", "m")]


def _spread_text(quantiles: dict[str, float], unit: str) -> str:
    return ", ".join(f"{value:.3g}" for value in quantiles.values()) + f" {unit}"
