"""Fitting rotors from files: what each file is, the model written, the JSON, the figure."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from cfb_mjx.commands import FitRotors
from cfb_mjx.errors import CfbError
from cfb_mjx.parameters import load_model_file

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "sysid"))
from motor_bench import record, steps

THRUST, TORQUE = np.array([-0.23, 0.562, -0.043]), 1e-4 * np.array([-3.4, 8.7, 2.9])


def save(path, **columns):
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="")
    return path


@pytest.fixture(autouse=True)
def _keep_settings(monkeypatch):
    """The tests' own precision and compile cache stay."""
    monkeypatch.setattr("cfb_mjx.runtime.configure_jax", lambda x64: None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    rng = np.random.default_rng(0)
    made = record(steps(rng, 6.0), rng, 0.045, 0.045, gain=2750.0, wander=5.0)
    save(folder / "steps.csv", t=made.time, u=made.command[:, 0], omega=made.rotor_speed[:, 0])
    speed, motor = np.repeat(np.linspace(400, 2700, 12), 4), np.tile([1, 2, 3, 4], 12)
    s, scale = speed / 2900, np.array([1.03, 0.99, 0.99, 0.99])[motor - 1]
    force = 1.1 * scale * s * np.polyval(THRUST, s) + 0.001 * rng.normal(size=48)
    torque = 2 * s * np.polyval(TORQUE, s) + 3e-6 * rng.normal(size=48)
    force[7] += 0.05
    save(folder / "map.csv", motor=motor, omega=speed, force=force, torque=torque)
    return folder


def test_steps_and_maps_together_make_one_model(folder, tmp_path):
    paths = [folder / "steps.csv", folder / "map.csv"]
    out, figure = tmp_path / "rotors.yaml", tmp_path / "rotors.png"
    options = {"robust": True, "json": tmp_path / "r.json", "figure": figure}
    fitted = FitRotors(paths, out, set="mass=0.045", **options).run()
    model = load_model_file(out)
    values = {key: entry.value for key, entry in model.entries.items()}
    assert values["motor_time_constant"] == pytest.approx(np.full(4, 0.045), rel=0.03)
    assert values["motor_gain"] == pytest.approx(np.full(4, 2750), rel=0.01)
    s = np.linspace(0.2, 0.9, 8)
    for name, truth in (("thrust_polynomial", 1.1 * THRUST), ("torque_polynomial", 2 * TORQUE)):
        np.testing.assert_allclose(np.polyval(values[name], s), np.polyval(truth, s), rtol=0.035)
        assert model.entries[name].std.shape == (3,)
    assert "fit-rotors on 2 file(s)" in model.entries["motor_gain"].source
    command = "cfb fit-rotors steps.csv map.csv -o rotors.yaml --set mass=0.045 --robust --json r.json"
    assert model.provenance["command"] == f"{command} --figure rotors.png"
    assert set(model.provenance["files_sha256"]) == {"steps.csv", "map.csv"}
    assert float(values["mass"]) == 0.045
    assert values["motor_speed_offset"] == pytest.approx(0)
    result = json.loads((tmp_path / "r.json").read_text())
    assert {"motor_gain", "motor_time_constant", "thrust_s3", "torque_s1"} <= set(result["parameters"])
    assert set(result["parameters"]["motor_gain"]) == {"value", "std", "unit", "preset"}
    assert result["unidentifiable"] == []
    assert len(result["maps"]["thrust"]["points"]["residual"]) == 48
    assert result["maps"]["thrust"]["points"]["weight"][7] < 0.1
    assert result["motors"]["all"]["extras"]["dead_time"]["supported"] is False
    assert figure.read_bytes()[:4] == b"\x89PNG"
    text = str(fitted)
    assert "offset: not supported by the data" in text
    assert "thrust: 48 points" in text


def test_motors_apart(folder, tmp_path):
    FitRotors(folder / "map.csv", tmp_path / "m.yaml", model="cfb", per_motor=True, robust=True).run()
    scale = load_model_file(tmp_path / "m.yaml").entries["thrust_scale"]
    np.testing.assert_allclose(scale.value, [1.03, 0.99, 0.99, 0.99], atol=0.008)
    assert np.all(scale.std < 0.005)


@pytest.mark.parametrize("follows", [True, False])
def test_steps_under_a_supply_that_sags(tmp_path, follows):
    """Speed follows command times voltage, unless the controller keeps it."""
    rng = np.random.default_rng(1)
    command = 0.8 * steps(rng, 6.0)
    voltage = np.linspace(4.1, 3.4, len(command))
    felt = command * voltage / 3.7 if follows else command
    made = record(felt, rng, 0.045, 0.045, gain=2300.0, offset=300.0, wander=5.0)
    path = save(
        tmp_path / "steps.csv",
        **{
            "time[ms]": 1e3 * made.time,
            "pwm": 65535 * command,
            "vbat[V]": voltage,
            "rpm": made.rotor_speed[:, 0] * 30 / np.pi,
        },
    )
    fitted = FitRotors(path, tmp_path / "m.yaml", json=tmp_path / "r.json").run()
    told = json.loads((tmp_path / "r.json").read_text())["parameters"]
    for name, truth in (("motor_gain", 2300.0), ("motor_speed_offset", 300.0), ("motor_time_constant", 0.045)):
        assert abs(told[name]["value"] - truth) < 4 * told[name]["std"] + 0.01 * truth, name
    said = "speed follows command times voltage" if follows else "speed does not follow the voltage of the supply"
    assert said in str(fitted)


def test_thrust_of_another_drone_names_its_model(tmp_path):
    speed = np.linspace(800, 2600, 20)
    path = save(tmp_path / "small.csv", omega=speed, force=1.5e-8 * speed**2)
    with pytest.raises(CfbError, match=r"of what a rotor of cfb-guards pulls and .* of one of cf2x; give --model cf2x"):
        FitRotors(path, tmp_path / "m.yaml").run()
    FitRotors(path, tmp_path / "m.yaml", model="cf2x").run()


def test_refusals_leave_earlier_results(folder, tmp_path, files):
    kept = tmp_path / "kept.yaml"
    kept.write_text("mine")
    cases = [
        ([folder / "steps.csv"], tmp_path / "model.json", r"model\.json.*\.yaml"),
        ([files / "flight.csv"], kept, r"flight\.csv.*no rotor speeds"),
        ([folder / "missing.csv"], kept, r"missing\.csv.*no such file"),
        ([save(tmp_path / "x.csv", omega=[1.0], force=[0.1])], kept, r"x \(thrust\).*1 point"),
    ]
    for paths, output, message in cases:
        with pytest.raises(CfbError, match=message):
            FitRotors(paths, output).run()
    assert kept.read_text() == "mine"
