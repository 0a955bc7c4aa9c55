"""``cfb excite separate``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, require_folder, require_no_file, together, write_json, write_text
from cfb_mjx.parameters import load_model_file
from cfb_mjx.runtime import Progress, configure_jax, environment
from cfb_mjx.terminal import print_paths

if TYPE_CHECKING:
    from cfb_mjx.sysid.excitation.separation import Told

FILES = ("setpoints.csv", "flight.mcap", "separation.json")
EVERY = 0.02
"""Time between set-points written, s."""


def run_separate(
    between: str | None,
    output: Path,
    model: str,
    changes: list[str],
    measured_rotors: bool,
    disturbance: float,
    json: Path | None,
) -> None:
    """Find the path that tells some effects apart, print what every path tells, write the best one.

    Raises:
        CfbError: no effects, unknown ones, impossible outputs, or no path that tells them apart.
    """
    require_no_file(output)
    require_folder(json)
    names = [name.strip() for name in (between or "").split(",") if name.strip()]
    if len(names) < 2:
        raise CfbError(
            "cfb excite separate needs --between A,B: the effects to tell apart, as cfb close-loop names them."
        )
    configure_jax(x64=True)
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid.excitation.conditions import Conditions
    from cfb_mjx.sysid.excitation.paths import PATHS
    from cfb_mjx.sysid.excitation.separation import separate

    described = load_model_file(model, changes)
    conditions = Conditions(measured_rotors=measured_rotors, disturbance=disturbance)
    told = separate(Quadrotor.from_file(described), names, conditions, progress=Progress("flying"))
    print(f"what one flight of each path tells about {' against '.join(names)}, in nats (10 settle it):\n")
    for one in told:
        flights = f"{one.flights} flight{'s' * (one.flights != 1)}" if one.flights else "does not tell them"
        print(f"{one.path:<16}{max(one.worst, 0.0):>9.1f}   {flights:<20} {PATHS[one.path][0]}")
    result = _json(told, names, described.name, asdict(conditions))
    if told[0].flights is None:
        raise CfbError(
            f"no path tells {' from '.join(names)} at the strengths assumed; weigh, remove a part or measure it apart."
        )
    with together():
        _write(output, told[0], result)
        if json is not None:
            write_json(json, result)
    best = told[0]
    print(f"\nfly: {best.path}, {best.flights} time{'s' * (best.flights != 1)}, then cfb close-loop again")
    print(f"files: {', '.join(str(output / name) for name in FILES)}")
    print_paths(results=json)


def _json(told: list[Told], names: list[str], model: str, conditions: dict) -> dict:
    paths = {
        one.path: {
            "nats": {f"{true} against {other}": value for (true, other), value in one.nats.items()},
            "flights": one.flights,
            "followed": one.followed,
        }
        for one in told
    }
    best = told[0]
    return {
        "between": names,
        "model": model,
        "fly": best.path,
        "flights": best.flights,
        "paths": paths,
        "conditions": conditions,
        "environment": environment(),
    }


def _write(folder: Path, best: Told, result: dict) -> None:
    from cfb_mjx.logs import write_mcap
    from cfb_mjx.sysid.excitation.paths import path

    output_folder(folder)
    rows = path(best.path, EVERY)
    lines = ["t,x,y,z,yaw", *(f"{EVERY * i:.2f}," + ",".join(f"{v:.4f}" for v in row) for i, row in enumerate(rows))]
    write_text(folder / "setpoints.csv", "\n".join(lines) + "\n")
    write_mcap(best.flown.log, folder / "flight.mcap")
    write_json(folder / "separation.json", result)
