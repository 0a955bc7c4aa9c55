"""``cfb benchmark-nanodrone``."""

from __future__ import annotations

from pathlib import Path

from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, write_json
from cfb_mjx.logs import read_log
from cfb_mjx.logs.idsia import read_as_published
from cfb_mjx.runtime import Progress, configure_jax, environment

DECLARED = "cfb-guards"
PLANT = "cfb-idsia"
"""Fitted to flights of the benchmark's drone, none of them its test flights."""
_ENDINGS = (".parquet", ".csv")


def run_nanodrone(folder: Path, model: str, json: Path | None, stride: int, official: bool = False) -> None:
    """Run the benchmark, print its table, write the results.

    Raises:
        CfbError: a folder without flights of the benchmark, a bad model, stride or output.
    """
    require_folder(json)
    if stride < 1:
        raise CfbError(f"--stride {stride}: must be a whole number from 1.")
    if not folder.is_dir():
        raise CfbError(f"{folder}: is not a folder; name one that holds the benchmark's flights (parquet or csv).")
    paths = sorted(path for path in folder.iterdir() if path.suffix in _ENDINGS)
    if not paths:
        raise CfbError(f"{folder}: holds no .parquet or .csv file; name a folder with the benchmark's flights.")
    logs = [read_as_published(path) if official else read_log(path, "idsia") for path in paths]
    if len({log.name for log in logs}) < len(logs):
        raise CfbError(f"{folder}: two flights have one name; keep each flight as parquet or as csv.")
    configure_jax(x64=True)
    from cfb_mjx.logs.idsia import VEHICLE_MASS
    from cfb_mjx.parameters import load_model_file
    from cfb_mjx.sysid.nanodrone import PUBLISHED, QUANTITIES, STEPS, Contestant, benchmark
    from cfb_mjx.sysid.observer import usual_observer

    declared = load_model_file(DECLARED).with_values("the benchmark's description", mass=VEHICLE_MASS)
    contestants = {"declared": Contestant.of(declared)}
    for name, where in {"plant": PLANT, "model": model}.items():
        described = load_model_file(where)
        contestants[name] = Contestant.of(described, where=where)
        contestants[f"{name}_observer"] = Contestant.of(described, usual_observer(described.kind), where=where)
    result = benchmark(logs, contestants, stride, Progress("benchmark"))
    published = {
        name: {f"{quantity}_sum_{unit}": x for (quantity, unit), x in zip(QUANTITIES.items(), sums, strict=True)}
        for name, sums in PUBLISHED.items()
    }
    result |= {
        "published": published,
        "steps": STEPS,
        "stride": stride,
        "official": official,
        "model": model,
        "environment": environment(),
    }
    _print(result)
    if json is not None:
        write_json(json, result)
        print(f"results: {json}")


_UNITS = {"position": "m", "velocity": "m/s", "attitude": "rad", "rate": "rad/s"}
_LABELS = {
    "physics": "physics (rate held)",
    "declared": f"{DECLARED}, 45 g",
    "plant": PLANT,
    "plant_observer": f"{PLANT} with observer",
    "model": "model",
    "model_observer": "model with observer",
}


def _print(result: dict) -> None:
    from cfb_mjx.sysid.nanodrone import QUANTITIES, SHOWN, STEPS

    keys = [[f"{q}_mean_{u}@{h}" for h in SHOWN] + [f"{q}_sum_{u}"] for q, u in QUANTITIES.items()]
    for name, flight in result["flights"].items():
        print(f"{name}: {flight['windows']} windows")
    print(f"\nmean errors after h steps of 10 ms, and their sum over h = 1 to {STEPS}; {result['windows']} windows")
    print(f"{'':<26}" + "".join(f"{f'{q}, {_UNITS[q]}':<38}" for q in QUANTITIES).rstrip())
    heads = [f"h = {h}" for h in SHOWN] + ["sum"]
    print(f"{'':<26}" + "".join("".join(f"{head:<9}" for head in heads) + "  " for _ in QUANTITIES).rstrip())
    for name, row in result["rows"].items():
        _row(_LABELS.get(name, name), row, keys)
    print("as published, on the paper's own test flights:")
    for name, row in result["published"].items():
        _row(name, row, keys)


def _row(label: str, row: dict, keys: list[list[str]]) -> None:
    cells = ("".join(f"{row[k]:<9.4g}" if k in row else f"{'':<9}" for k in group) + "  " for group in keys)
    print(f"{label:<26}{''.join(cells)}".rstrip())
