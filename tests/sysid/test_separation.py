"""Telling effects apart by flying: paths stay in the room, strengths are taken from the model, the right path wins."""

import numpy as np
import pytest

from cfb_mjx.cli import main
from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import GroundEffect, Wind
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid.excitation.experiment import Conditions
from cfb_mjx.sysid.excitation.information import Told, assumed, separate
from cfb_mjx.sysid.excitation.manoeuvres import PATHS, SECONDS, path

# Shares compiled programs with the tracing tests.
pytestmark = pytest.mark.xdist_group("tracing")

GUARDS = Quadrotor.from_file("cfb-guards")


@pytest.mark.parametrize("name", PATHS)
def test_paths_stay_in_the_room(name):
    found = path(name, 0.01)
    assert found.shape == (round(SECONDS / 0.01), 4)
    assert np.abs(found[:, :2]).max() <= 1.0
    assert 0.1 <= found[:, 2].min() <= found[:, 2].max() <= 2.2 + 1e-9
    assert np.ptp(found, axis=0).max() >= 0.5


def test_passes_reach_the_speeds_they_promise():
    speed = np.abs(np.diff(path("passes along x", 0.01)[:, 0])) / 0.01
    for promised in (0.5, 1.0, 2.5):
        assert np.isclose(speed, promised, rtol=1e-6).mean() > 0.05


def test_an_effect_the_model_has_keeps_its_strength():
    own = Wind(velocity=[1.0, 0.0, 0.0], conductance=0.02)
    assert assumed("wind", [own]) is own
    typical = assumed("ground_effect", [GroundEffect.neutral()])
    assert float(typical.strength) == pytest.approx(0.06)
    assert np.asarray(assumed("cog_offset", []).offset).tolist() == pytest.approx([0.002, -0.002])


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["wind"], "two different effects"),
        (["wind", "wind"], "two different effects"),
        (["wind", "ether"], "unknown effect ether"),
        (["wind", "sensor_delay"], "fault of the recording"),
    ],
)
def test_what_cannot_be_told_by_flying_is_refused(names, said):
    with pytest.raises(CfbError, match=said):
        separate(GUARDS, names)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("separate --between wind,payload --rate-limit 6 --repetitions 3", "leave out --rate-limit, --repetitions"),
        ("separate --between wind,payload --parameters inertia", "leave out --parameters"),
        ("roll-pitch --between wind,payload", "roll-pitch does not use --between"),
    ],
)
def test_options_that_would_be_ignored_are_refused(command, said, tmp_path, capsys):
    assert main(["excite", *command.split(), "-o", str(tmp_path / "next")]) != 0
    assert said in capsys.readouterr().err
    assert not (tmp_path / "next").exists()


def test_a_path_is_worth_its_least_telling_pair():
    told = Told("x", {("a", "b"): 40.0, ("b", "a"): 4.0}, None, True)
    assert told.worst == 4.0
    assert told.flights == 3
    assert Told("x", {("a", "b"): 40.0, ("b", "a"): -1.0}, None, True).flights is None
    assert Told("x", {("a", "b"): 40.0}, None, False).flights is None


@pytest.mark.long
def test_heights_tell_ground_effect_from_thrust():
    described = load_model_file("cfb-guards")
    model = Quadrotor(described.parameters(), (GroundEffect(strength=0.15, height=0.1),))
    calm = Conditions(disturbance=0.5, force_disturbance=0.1, rotor_disturbance=1.0, measured_rotors=True)
    told = separate(model, ["ground_effect", "thrust_scale"], calm, ["heights", "headings"])
    assert [one.path for one in told] == ["heights", "headings"]
    assert told[0].followed
    assert told[0].flights == 1
    assert told[0].nats["ground_effect", "thrust_scale"] > 5 * max(told[1].worst, 1.0)
