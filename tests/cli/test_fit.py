"""``cfb fit`` from the logs to a model the other commands take."""

import json
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

from cfb_mjx.commands.fit import Fitted
from cfb_mjx.parameters import load_model_file

LOG = Path(__file__).resolve().parents[2] / "data" / "flight_logs" / "figure8.mcap"


def test_a_fit_becomes_a_model_results_and_a_figure(cfb, tmp_path):
    model, results, figure = tmp_path / "drone.yaml", tmp_path / "fit.json", tmp_path / "fit.svg"
    request = ["--parameters", "inertia_xx,inertia_yy"]
    done = cfb("fit", LOG, "-o", model, "--json", results, "--figure", figure, *request)
    assert done.returncode == 0, done.stderr
    found = json.loads(results.read_text())
    assert found["estimator"] == "innovation"
    assert set(found["parameters"]) | set(found["unidentifiable"]) == {"inertia_xx", "inertia_yy"}
    for estimate in found["parameters"].values():
        assert set(estimate) == {"value", "std", "unit", "preset"}
        assert estimate["unit"] == "kg m^2"
    assert {"before", "after", "hold"} <= set(found["held_out"])
    assert "attitude_rmse_deg@0.2s" in found["held_out"]["after"]
    written = load_model_file(model)
    if "inertia_xx" in found["parameters"]:
        assert float(written.parameters().inertia[0]) == found["parameters"]["inertia_xx"]["value"]
    assert "figure8.mcap" in model.read_text()  # what it was fitted to
    assert "<svg" in figure.read_text()
    assert cfb("evaluate", LOG, "--model", model).returncode == 0


def test_a_parameter_that_does_not_exist_is_refused(cfb, tmp_path):
    done = cfb("fit", LOG, "-o", tmp_path / "m.yaml", "--parameters", "inertia,colour")
    assert done.returncode == 2
    assert "colour" in done.stderr
    assert "inertia_xx" in done.stderr
    assert not (tmp_path / "m.yaml").exists()


class Errors:
    """Held-out errors that are all the same."""

    logs = ()

    def __init__(self, error: float):
        self.error = error

    def metrics(self, variant: str):
        return defaultdict(lambda: 1.0 if variant == "hold" else self.error)


def test_a_model_that_predicts_worse_than_before_is_said_to():
    def said(before: float, after: float) -> str:
        found = SimpleNamespace(before=Errors(before), after=Errors(after))
        return "\n".join(Fitted._held_out(found))

    assert "12 of 12 held-out errors grew" in said(1.0, 2.0)
    assert "grew" not in said(2.0, 1.0)
    assert "grew" not in said(1.0, 1.001)
