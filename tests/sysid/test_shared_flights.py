"""The protocol reproduces reference results on flights outside the project; skipped where they are absent."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from cfb_mjx.logs import read_log
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid import evaluate

SHARED = Path(__file__).resolve().parents[3] / "shared"
CASES = sorted(SHARED.glob("blind/case_*"))


@pytest.mark.skipif(not CASES, reason="needs the reference flights in ../shared/blind")
@pytest.mark.parametrize("case", CASES[:5] + CASES[7:8], ids=lambda path: path.name)
def test_nominal_errors_are_reproduced(case):
    manifest = json.loads((case / "manifest.json").read_text())
    files = [f for item in manifest["logs"] if item["split"] == "held_out" for f in item["files"]]
    with open(SHARED / "blind" / "nominal_errors.csv", newline="") as table:
        reference = next(row for row in csv.DictReader(table) if row["case"] == case.name)
    found = evaluate(Quadrotor.from_file("cfb-guards"), [read_log(case / f) for f in files]).metrics("commands_in")
    for key, value in reference.items():
        if key != "case":
            assert found[key] == pytest.approx(float(value), rel=1e-3), key


@pytest.mark.skipif(not (SHARED / "real").is_dir(), reason="needs the real flights in ../shared/real")
def test_declared_model_and_hold_on_a_real_flight():
    log = read_log(SHARED / "real" / "validation" / "square_20251017_run4.parquet")
    model = Quadrotor.from_file(load_model_file("cfb-guards").with_values("weighed", mass=0.045))
    result = evaluate(model, [log])
    degrees = {
        v: np.radians(result.metrics(v)["attitude_mean_deg@0.5s"]) for v in ("commands_in", "rotor_speed_in", "hold")
    }
    # An independent study of this flight: 1.94, 1.22 and 1.12 rad.
    assert degrees["commands_in"] == pytest.approx(1.94, rel=0.08)
    assert degrees["rotor_speed_in"] == pytest.approx(1.22, rel=0.08)
    assert degrees["hold"] == pytest.approx(1.12, rel=0.05)
