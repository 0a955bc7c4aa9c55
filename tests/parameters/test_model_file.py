"""Model files: presets, round trips, and a refusal for every way a file can be wrong."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import yaml

from cfb_mjx.errors import CfbError
from cfb_mjx.parameters import SPECIFICATIONS, Parameters, load_model_file, preset_names, save_model_file

PAPER = {
    "cfb-guards": {"mass": 0.044, "inertia": [3.3e-5, 3.6e-5, 5.9e-5]},
    "cfb": {"mass": 0.040, "inertia": [1.8e-5, 2.4e-5, 3.0e-5]},
}
PAPER_SHARED = {
    "gravity": 9.81,
    "rotor_spacing": 0.0707,
    "rotor_inertia": 0.5e-7,
    "motor_time_constant": 0.05,
    "motor_gain": 2900.0,
    "reference_rotor_speed": 2900.0,
    "thrust_polynomial": [-0.23, 0.562, -0.043],
    "torque_polynomial": [-3.4e-4, 8.7e-4, 2.9e-4],
    "pose_delay": 0.008,
    "gyro_delay": 0.0,
    "center_of_gravity": 0.0,
    "motor_speed_offset": 0.0,
    "thrust_scale": 1.0,
    "torque_scale": 1.0,
    "attitude_offset": 0.0,
}


def test_shipped_presets():
    assert {"cfb", "cfb-guards", "cf21b-500"} <= set(preset_names())


@pytest.mark.parametrize("name", preset_names())
def test_every_constant_of_a_preset_has_a_source(name):
    model = load_model_file(name)
    assert model.name == name
    assert set(model.entries) == set(SPECIFICATIONS)
    for key, entry in model.entries.items():
        assert len(entry.source) > 5, key
        assert entry.value.shape == SPECIFICATIONS[key].shape
        SPECIFICATIONS[key].check(entry.value, key)


@pytest.mark.parametrize("name", sorted(PAPER))
def test_the_papers_numbers(name):
    parameters = load_model_file(name).parameters()
    assert isinstance(parameters, Parameters)
    for key, value in (PAPER[name] | PAPER_SHARED).items():
        np.testing.assert_array_equal(getattr(parameters, key), np.broadcast_to(value, SPECIFICATIONS[key].shape), key)


def _equal(a, b):
    assert a.name == b.name
    assert a.description == b.description
    assert [dict(e) for e in a.effects] == [dict(e) for e in b.effects]
    assert dict(a.provenance) == dict(b.provenance)
    assert set(a.entries) == set(b.entries)
    for key, entry in a.entries.items():
        np.testing.assert_array_equal(entry.value, b.entries[key].value)
        assert entry.source == b.entries[key].source
        assert (entry.std is None) == (b.entries[key].std is None)
        if entry.std is not None:
            np.testing.assert_array_equal(entry.std, b.entries[key].std)


@pytest.mark.parametrize("name", preset_names())
def test_round_trip_of_presets_is_lossless(name, tmp_path):
    model = load_model_file(name)
    save_model_file(model, tmp_path / "m.yaml")
    _equal(load_model_file(tmp_path / "m.yaml"), model)


def test_round_trip_of_awkward_numbers_is_lossless(tmp_path):
    """All digits of a double, exponents YAML 1.1 reads as text, std, text beyond ASCII, effects and provenance."""
    model = load_model_file("cf21b-500").with_values(
        "fit of 3 logs: « Übung », 50 %\nsecond line",
        mass=0.1 + 1e-17 + 0.1 / 3,
        inertia=[1e-5 / 3, 2e-5 / 7, 3e-5 / 11 + 1e-12],
        motor_gain=np.array([2900.1, 1e4 / 3, 1e3 + 1e-10, 5e3]),
        rotor_inertia=5e-324,
    )
    save_model_file(model, tmp_path / "m.yaml")
    _equal(load_model_file(tmp_path / "m.yaml"), model)


def test_std_survives(document, tmp_path):
    document["parameters"]["mass"]["std"] = 1e-4
    document["parameters"]["inertia"]["std"] = [1e-6, 2e-6, 3e-6]
    document["provenance"] = {"logs": ["a", "b"], "date": "2026-01-01"}
    model = load_model_file(_write(tmp_path, document))
    save_model_file(model, tmp_path / "again.yaml")
    _equal(load_model_file(tmp_path / "again.yaml"), model)


def test_numbers_in_any_notation(document, tmp_path):
    text = yaml.safe_dump(document).replace("value: 0.04\n", "value: 4e-2\n")
    assert "4e-2" in text
    (tmp_path / "m.yaml").write_text(text)
    assert load_model_file(tmp_path / "m.yaml").entries["mass"].value == 0.04


@pytest.mark.parametrize("unit", ["kg m^2", "kg·m²", "kg*m^2", "kg m**2", "kg*m**2", " kg  m^2"])
def test_units_may_be_spelled_in_several_ways(unit, document, tmp_path):
    document["parameters"]["inertia"]["unit"] = unit
    assert load_model_file(_write(tmp_path, document)).entries["inertia"].value[0] == 1.8e-5


def test_with_values_refuses_what_a_file_may_not_hold():
    model = load_model_file("cfb")
    for values in ({"mas": 1.0}, {"mass": -1.0}, {"mass": float("nan")}, {"inertia": [1e-5, 1e-5, 3e-5]}):
        with pytest.raises(CfbError, match=next(iter(values))):
            model.with_values("test", **values)
    assert model.with_values("test", mass=0.05).entries["mass"].source == "test"
    assert load_model_file("cfb").entries["mass"].value == 0.04


@pytest.fixture
def document() -> dict:
    """A complete, valid file as a plain mapping, to be spoiled."""
    return {
        "format": "cfb_mjx model 1",
        "name": "mine",
        "parameters": {
            "mass": {"value": 0.04, "unit": "kg", "source": "scales"},
            "inertia": {"value": [1.8e-5, 2.4e-5, 3.0e-5], "unit": "kg m^2", "source": "paper"},
            "rotor_spacing": {"value": 0.0707, "unit": "m", "source": "paper"},
            "rotor_inertia": {"value": 5e-8, "unit": "kg m^2", "source": "paper"},
            "motor_time_constant": {"value": 0.05, "unit": "s", "source": "paper"},
            "motor_gain": {"value": 2900.0, "unit": "rad/s", "source": "paper"},
            "reference_rotor_speed": {"value": 2900.0, "unit": "rad/s", "source": "paper"},
            "thrust_polynomial": {"value": [-0.23, 0.562, -0.043], "unit": "N", "source": "paper"},
            "torque_polynomial": {"value": [-3.4e-4, 8.7e-4, 2.9e-4], "unit": "N m", "source": "paper"},
            "pose_delay": {"value": 0.008, "unit": "s", "source": "paper"},
        },
    }


def test_the_delay_of_the_pose_may_have_its_former_name(document, tmp_path):
    parameters = document["parameters"]
    parameters["observation_delay"] = parameters.pop("pose_delay") | {"value": 0.012}
    model = load_model_file(_write(tmp_path, document))
    assert (model.entries["pose_delay"].value, model.entries["gyro_delay"].value) == (0.012, 0.0)
    assert model.parameters().observation_delay == 0.012
    save_model_file(model.with_values("me", observation_delay=0.016), tmp_path / "written.yaml")
    assert "observation_delay" not in (tmp_path / "written.yaml").read_text()
    assert load_model_file(tmp_path / "written.yaml").entries["pose_delay"].value == 0.016
    with pytest.raises(CfbError, match="give only pose_delay"):
        model.with_values("me", observation_delay=0.016, pose_delay=0.02)
    parameters["pose_delay"] = parameters["observation_delay"]
    with pytest.raises(CfbError, match=r"drone\.yaml: parameters\.observation_delay and parameters\.pose_delay"):
        load_model_file(_write(tmp_path, document))


def _write(tmp_path, document):
    path = tmp_path / "drone.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def test_what_may_be_left_out_is_neutral(document, tmp_path):
    model = load_model_file(_write(tmp_path, document))
    np.testing.assert_array_equal(model.entries["thrust_scale"].value, np.ones(4))
    assert model.entries["gravity"].value == 9.81


# How to spoil the document: path of keys, new value (or DELETE), and what the message must name besides the file.
DELETE = object()
SPOILED = [
    (["colour"], "red", "colour"),
    (["parameters", "weight"], {"value": 1, "unit": "N", "source": "x"}, "parameters.weight"),
    (["parameters", "mass", "units"], "kg", "parameters.mass.units"),
    (["format"], DELETE, "format"),
    (["format"], "cfb_mjx model 99", "format"),
    (["parameters"], DELETE, "parameters"),
    (["parameters"], [1, 2], "parameters"),
    (["parameters", "mass"], DELETE, "mass"),
    (["parameters", "mass"], 0.04, "parameters.mass"),
    (["parameters", "mass", "unit"], DELETE, "parameters.mass"),
    (["parameters", "mass", "unit"], "g", "parameters.mass"),
    (["parameters", "mass", "source"], DELETE, "parameters.mass"),
    (["parameters", "mass", "source"], "", "parameters.mass"),
    (["parameters", "mass", "value"], DELETE, "parameters.mass"),
    (["parameters", "mass", "value"], -0.04, "parameters.mass"),
    (["parameters", "mass", "value"], 0.0, "parameters.mass"),
    (["parameters", "mass", "value"], float("nan"), "parameters.mass"),
    (["parameters", "mass", "value"], float("inf"), "parameters.mass"),
    pytest.param(["parameters", "mass", "value"], 10**400, "parameters.mass", id="huge integer"),
    (["parameters", "mass", "value"], True, "parameters.mass"),
    (["parameters", "mass", "value"], "heavy", "parameters.mass"),
    (["parameters", "mass", "value"], None, "parameters.mass"),
    (["parameters", "mass", "value"], [0.04, 0.04], "parameters.mass"),
    (["parameters", "mass", "value"], [[0.04]], "parameters.mass"),
    (["parameters", "mass", "value"], {"x": 1}, "parameters.mass"),
    (["parameters", "mass", "std"], -1.0, "parameters.mass"),
    (["parameters", "mass", "std"], float("nan"), "parameters.mass"),
    (["parameters", "inertia", "value"], [1e-5, 1e-5, 3e-5], "parameters.inertia"),
    (["parameters", "inertia", "value"], [1e-5, -1e-5, 1e-5], "parameters.inertia"),
    (["parameters", "inertia", "value"], [1e-5, 1e-5], "parameters.inertia"),
    (["parameters", "inertia", "value"], [1e-5, float("nan"), 1e-5], "parameters.inertia"),
    (["parameters", "motor_gain", "value"], [1.0, 2.0, 3.0], "parameters.motor_gain"),
    (["parameters", "motor_time_constant", "value"], 0.0, "parameters.motor_time_constant"),
    (["parameters", "thrust_polynomial", "value"], [-1.0, 0.1, 0.1], "parameters.thrust_polynomial"),
    (["parameters", "pose_delay", "value"], -0.001, "parameters.pose_delay"),
    (["effects"], {"name": "parasitic_drag"}, "effects"),
    (["effects"], [{"parameters": {}}], "effects"),
    (["effects"], ["parasitic_drag"], "effects"),
    (["provenance"], 3, "provenance"),
]


@pytest.mark.parametrize(("keys", "value", "named"), SPOILED)
def test_a_spoiled_file_is_refused_with_file_and_key(keys, value, named, document, tmp_path):
    spoiled = copy.deepcopy(document)
    node = spoiled
    for key in keys[:-1]:
        node = node[key]
    if value is DELETE:
        del node[keys[-1]]
    else:
        node[keys[-1]] = value
    with pytest.raises(CfbError) as caught:
        load_model_file(_write(tmp_path, spoiled))
    assert "drone.yaml" in str(caught.value)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "mapping"),
        ("# only a comment\n", "mapping"),
        ("- a\n- b\n", "mapping"),
        ("just text", "mapping"),
        ("a: [1, 2\n", "YAML"),
        ("a: 1\na: 2\n", "'a' appears twice"),
        ("parameters:\n  mass: {value: 1, value: 2}\n", "'value' appears twice"),
        ("[1, 2]: x\n", "key"),
        ("x: !!python/object/apply:os.getcwd []\n", "YAML"),
        ("x: &a [*a\n", "YAML"),
        ("name: 2026-13-45\n", "YAML"),
        ("name: !!int abc\n", "YAML"),
        pytest.param("name: " + 3000 * "[" + "\n", "YAML", id="deeply nested"),
        ("\tname: x\n", "YAML"),
    ],
)
def test_a_file_that_is_not_a_yaml_mapping_is_refused(text, named, tmp_path):
    path = tmp_path / "drone.yaml"
    path.write_text(text)
    with pytest.raises(CfbError, match=r"drone\.yaml") as caught:
        load_model_file(path)
    assert named in str(caught.value)


def test_bytes_that_are_not_text_are_refused(tmp_path):
    path = tmp_path / "drone.yaml"
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(CfbError, match=r"drone\.yaml"):
        load_model_file(path)


def test_missing_file_unknown_preset_and_folder_are_refused(tmp_path):
    with pytest.raises(CfbError, match=r"nowhere\.yaml"):
        load_model_file(tmp_path / "nowhere.yaml")
    with pytest.raises(CfbError, match=r"cfb-gards.*cfb-guards"):
        load_model_file("cfb-gards")
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(CfbError, match=r"folder\.yaml"):
        load_model_file(tmp_path / "folder.yaml")


@pytest.mark.parametrize(
    ("effect", "named"),
    [
        ({"name": "warp_drive"}, "warp_drive"),
        ({"name": "parasitic_drag", "parameters": {"cubic": 1.0}}, "cubic"),
        ({"name": "parasitic_drag", "strength": 1.0}, "strength"),
    ],
)
def test_unknown_effects_and_their_parameters_are_refused_with_the_file(effect, named, document, tmp_path):
    from cfb_mjx.model import Quadrotor

    document["effects"] = [effect]
    path = _write(tmp_path, document)
    with pytest.raises(CfbError, match=r"drone\.yaml") as caught:
        Quadrotor.from_file(path)
    assert named in str(caught.value)


def test_saving_where_nothing_can_be_written_is_refused_and_leaves_the_old_file(tmp_path):
    model = load_model_file("cfb")
    with pytest.raises(CfbError, match="nowhere"):
        save_model_file(model, tmp_path / "nowhere" / "m.yaml")
    path = tmp_path / "m.yaml"
    save_model_file(model, path)
    before = path.read_bytes()
    with pytest.raises(CfbError):
        save_model_file(model, path / "below.yaml")
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.yaml"]


def test_what_is_saved_can_be_read_even_without_a_source(tmp_path):
    """Either `with_values` refuses an empty source or the file stays readable; writing an unreadable file is worst."""
    try:
        model = load_model_file("cfb").with_values("", mass=0.05)
    except CfbError:
        return
    save_model_file(model, tmp_path / "m.yaml")
    load_model_file(tmp_path / "m.yaml")
