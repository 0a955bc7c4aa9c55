"""``cfb refine`` from the logs to a model the other commands take."""

import inspect
import json
from dataclasses import replace
from pathlib import Path

import pytest

from cfb_mjx.commands import Refine
from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.logs import read_log
from cfb_mjx.model.effects import Inertia, RotorDrag
from cfb_mjx.parameters import load_model_file, save_model_file
from cfb_mjx.sysid.refinement import model_files, plausible_numbers
from cfb_mjx.sysid.sensor_faults import HEALTHY
from cfb_mjx.sysid.tracing.named_effects import NamedFit

LOGS = Path(__file__).resolve().parents[2] / "data" / "flight_logs"
LOG = LOGS / "drag.mcap"


def test_a_refined_model_is_marked_and_taken_by_other_commands(cfb, tmp_path):
    model, results = tmp_path / "drone.yaml", tmp_path / "refine.json"
    request = ["--effects", "rotor_drag", "--predictor", "--held-out", LOGS / "figure8.mcap", "--json", results]
    done = cfb("refine", LOG, "-o", model, *request)
    assert done.returncode == 0, done.stderr
    assert "a predictor, not a plant" in done.stdout
    found = json.loads(results.read_text())
    assert found["numbers"]["rotor_drag.coefficient"]["value"] > 0.005
    assert found["loss"]["after"] < found["loss"]["before"]
    assert "attitude_rmse_deg@0.2s" in found["held_out"]["after"]["commands_in"]
    written = load_model_file(model)
    assert written.kind == "predictor"
    assert written.provenance["fit_logs_sha256"]
    assert [e["name"] for e in written.effects] == ["rotor_drag"]
    with pytest.raises(CfbError, match=r"predictor, not a plant.*--force"):
        written.require_plant("training", "--force")
    assert cfb("evaluate", LOG, "--model", model).returncode == 0


def test_a_number_that_ends_at_its_bound_says_so(monkeypatch):
    """By innovations, too: there a strength may not change its sign."""

    def found(drag):
        given = NamedFit((RotorDrag(coefficient=drag),), {"rotor_drag": {"coefficient": 1e-3}}, HEALTHY)
        monkeypatch.setattr("cfb_mjx.sysid.refinement.model_files.fit_named_effects", lambda *_: given)
        fitted = model_files.by_innovations(load_model_file("cfb-guards"), [read_log(LOG)], ["rotor_drag"])
        return fitted.to_json()["numbers"]["rotor_drag.coefficient"]["at_bound"]

    assert found(0.0)
    assert not found(0.01)


def test_all_that_a_drone_usually_lacks(monkeypatch, tmp_path):
    asked = []

    def fit(base, logs, names, **_):
        asked.extend(names)
        return model_files.EffectFit(tuple(names), {}, frozenset(), (), "plant", loss=(2.0, 1.0))

    monkeypatch.setattr(model_files, "by_predictions", fit)
    monkeypatch.setattr("cfb_mjx.runtime.configure_jax", lambda x64: None)
    refined = Refine(LOG, tmp_path / "m.yaml", effects="plant").run()
    assert "mean loss 2.0000 -> 1.0000" in str(refined)
    assert {"blade_flapping", "thrust_scale", "inertia", "battery_sag"} <= set(asked)
    assert not {"payload", "payload_swing", "wind", "gust"} & set(asked)
    assert plausible_numbers(load_model_file("cfb-guards").parameters(), asked)


def test_effects_that_are_not_fitted_anew_keep_what_is_known_of_them(monkeypatch):
    """A fitted inertia may be one that no body has, as long as the file says how sure it is."""
    known = {"relative": [0.1, 0.1, 0.1]}
    inertia = {"name": "inertia", "parameters": {"relative": [0.2, -0.1, 0.4]}, "uncertainty": known}
    effects = (Inertia(relative=[0.2, -0.1, 0.4]), RotorDrag(coefficient=0.01))
    given = NamedFit(effects, {"rotor_drag": {"coefficient": 1e-3}}, HEALTHY)
    monkeypatch.setattr("cfb_mjx.sysid.refinement.model_files.fit_named_effects", lambda *_: given)
    base = replace(load_model_file("cfb-guards"), effects=(inertia,))
    with pytest.warns(CfbWarning, match="impossible for a rigid body"):
        fitted = model_files.by_innovations(base, [read_log(LOG)], ["rotor_drag"])
    assert fitted.model_file(base).effects[0]["uncertainty"] == known
    assert list(fitted.estimates) == ["rotor_drag.coefficient"]
    assert fitted.estimates["rotor_drag.coefficient"].unit == RotorDrag.units["coefficient"]


def test_every_fit_returns_estimates_a_model_file_and_numbers():
    from cfb_mjx.sysid import Fitted
    from cfb_mjx.sysid.identification import Fit
    from cfb_mjx.sysid.rotors.fitting import RotorFit

    asked = {name for name in dir(Fitted) if not name.startswith("_")}
    assert asked == {"estimates", "model_file", "to_json"}
    for kind in (Fit, RotorFit, model_files.EffectFit):
        has = {*dir(kind), *kind.__dataclass_fields__}
        assert asked <= has, kind
        assert list(inspect.signature(kind.model_file).parameters) == ["self", "base", "source"], kind


def test_plants_say_nothing_and_unknown_kinds_are_refused(tmp_path):
    path = tmp_path / "m.yaml"
    plant = load_model_file("cfb-guards")
    plant.require_plant("training", "--force")
    save_model_file(plant, path)
    assert "kind" not in path.read_text()
    path.write_text("kind: oracle\n" + path.read_text())
    with pytest.raises(CfbError, match="'kind' must be one of plant, predictor"):
        load_model_file(path)


@pytest.mark.parametrize(
    ("arguments", "needles"),
    [
        (["--effects", "warp"], ["warp", "rotor_drag"]),
        ([], ["has no effects", "--effects"]),
        (["--effects", "rotor_drag", "--weight", "drag=-1"], ["--weight drag=-1", "positive"]),
        (["--effects", "rotor_drag", "--weight", "square=2"], ["no flight", "square"]),
        (["--effects", "rotor_drag", "--predictor", "--estimator", "innovations"], ["--predictor"]),
        (["--effects", "rotor_drag", "--weight", "drag=2", "--estimator", "innovations"], ["--weight"]),
        (["--effects", "rotor_drag", "--held-out", str(LOG)], ["drag.mcap", "evaluated on flights it was fitted to"]),
    ],
)
def test_bad_requests_are_refused(cfb, tmp_path, arguments, needles):
    done = cfb("refine", LOG, "-o", tmp_path / "m.yaml", *arguments)
    assert done.returncode == 2
    assert all(needle in done.stderr for needle in needles)
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "m.yaml").exists()


def test_sensor_faults_of_the_model_stay_out_of_a_fit_as_logged_but_a_stretch_of_the_attitude_too(
    monkeypatch, tmp_path
):
    seen = {}

    def fit(base, logs, names, as_logged, progress):
        seen.update(effects={e["name"]: e["parameters"] for e in base.effects}, as_logged=as_logged)
        return model_files.EffectFit(tuple(names), {}, frozenset(), base.effects, "plant")

    monkeypatch.setattr(model_files, "by_innovations", fit)
    stretch = {"scale": 1.1}
    known = (
        {"name": "sensor_velocity_scale", "parameters": stretch},
        {"name": "sensor_delay", "parameters": {"delay": 0.01}},
        {"name": "rotor_drag", "parameters": {}},
    )
    faulty = replace(load_model_file("cfb-guards"), effects=known)
    save_model_file(faulty, tmp_path / "faulty.yaml")
    everything = {item["name"]: item["parameters"] for item in known}
    leaning = {"rotor_drag": {}, "sensor_velocity_scale": stretch | {"with_attitude": 1.0}}
    for as_logged, kept in ((False, everything), (True, leaning)):
        how = {"effects": "rotor_drag", "estimator": "innovations", "as_logged": as_logged}
        Refine(LOG, tmp_path / "m.yaml", model=str(tmp_path / "faulty.yaml"), **how).run()
        assert seen == {"effects": kept, "as_logged": as_logged}
