"""The paper's constants, compared with the shipped files, and values that follow from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.reproduce.item import Result, Row, write_csv

# Copied from the paper (table II, eqs. 5-9), for comparison with the shipped parameter files.
PAPER = {
    "cfb-guards": {"mass": 0.044, "inertia": (3.3e-5, 3.6e-5, 5.9e-5)},
    "cfb": {"mass": 0.040, "inertia": (1.8e-5, 2.4e-5, 3.0e-5)},
}
SHARED = {
    "motor_time_constant": ("motor time constant T, s", 0.050),
    "motor_gain": ("motor gain K, rad/s", 2900.0),
    "rotor_inertia": ("rotor inertia J_m, kg m^2", 0.5e-7),
    "rotor_spacing": ("rotor spacing l, m", 0.0707),
    "pose_delay": ("observation delay, s", 0.008),
}
SHIPPED = "as shipped"
NAMES = {"cfb-guards": "with guards", "cfb": "without guards"}
RANDOMISATION = {
    "mass": ("mass", 0.1),
    "inertia": ("inertia", 0.2),
    "motor_time_constant": ("motor dynamics, T", 0.2),
    "motor_gain": ("motor dynamics, K", 0.2),
    "thrust_scale": ("thrust, each motor", 0.2),
    "torque_scale": ("torque, each motor", 0.2),
    "center_of_gravity": ("centre of gravity", 0.01),
    "attitude_offset": ("attitude offset", np.radians(15.0)),
}


def parameters(folder: Path, real: Path | None) -> Result:
    """Compare table II and the ranges of the randomisation with the shipped files."""
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.model.rotors import thrust
    from cfb_mjx.parameters import load_model_file, load_randomisation

    rows = []
    for preset, stated in PAPER.items():
        entries = load_model_file(preset).entries
        rows.append(
            Row(
                f"mass {NAMES[preset]}, kg",
                f"{stated['mass']:g}",
                f"{float(entries['mass'].value):g}",
                SHIPPED,
                "input",
            )
        )
        for axis, paper, ours in zip("xyz", stated["inertia"], np.asarray(entries["inertia"].value), strict=True):
            rows.append(Row(f"inertia J_{axis} {NAMES[preset]}, kg m^2", f"{paper:g}", f"{ours:g}", SHIPPED, "input"))
    entries = load_model_file("cfb-guards").entries
    for name, (what, paper) in SHARED.items():
        rows.append(Row(what, f"{paper:g}", f"{float(np.ravel(entries[name].value)[0]):g}", SHIPPED, "input"))
    for preset in PAPER:
        drone = Quadrotor.from_file(preset)
        p = drone.parameters
        full = float(thrust(p, p.motor_gain).sum())
        hover, weight = float(drone.hover_command()[0]), float(p.mass * p.gravity)
        rows.append(Row(f"command in hover {NAMES[preset]}", "", f"{hover:.3f}", "follows from the above"))
        rows.append(Row(f"thrust to weight {NAMES[preset]}", "", f"{full / weight:.2f}", "follows from the above"))
    ranges = dict(load_randomisation("paper").ranges)
    for name, (what, paper) in RANDOMISATION.items():
        ours = _half(name, max(ranges[name].half_width))
        rows.append(Row(f"randomisation of {what}", _half(name, paper), ours, SHIPPED, "input"))
    write_csv(folder / "parameters.csv", ("quantity", "paper", "ours"), [(r.what, r.paper, r.ours) for r in rows])
    return Result(
        "Parameters and randomisation",
        ["The shipped parameter files and randomisation, compared with the paper's table and text."],
        rows,
    )


def _half(name: str, value: float) -> str:
    if name == "center_of_gravity":
        return f"+-{100 * value:g} cm"
    return f"+-{np.degrees(value):.3g} deg" if name == "attitude_offset" else f"+-{100 * value:g} %"
