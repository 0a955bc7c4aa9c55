"""The demo runs from end to end, and its page says what its numbers are."""

from __future__ import annotations

import json

import pytest

from cfb_mjx import demo
from cfb_mjx.commands import Demo
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import write_tabular
from cfb_mjx.view.demo import QUANTITIES
from tests.simulated_log import simulated_log

# They share fixtures and compiled programs.
pytestmark = pytest.mark.xdist_group("demo")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Page and numbers of a small demo whose "real" flight is a short simulated one of another mass."""
    folder = tmp_path_factory.mktemp("demo")
    (folder / "real" / "validation").mkdir(parents=True)
    write_tabular(simulated_log(2.0), folder / "real" / "validation" / "random1_a.parquet")
    out = folder / "new" / "out"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("cfb_mjx.runtime.configure_jax", lambda x64: None)
        patched.setattr(demo, "DRONES", 64)
        found = Demo(out, folder / "real").run()
    return out, json.loads((out / "demo.json").read_text()), (out / "index.html").read_text(), found


def test_what_is_printed(flown):
    out, numbers, _, found = flown
    text = str(found)
    low, high = numbers["flight"]["intervals"]["hold"]["position_rmse_m@0.5s"]
    assert f"{numbers['flight']['hold']['position_rmse_m@0.5s']:.3g} [{low:.3g}, {high:.3g}]" in text
    assert text.splitlines()[-3].endswith(f"Open {out / 'index.html'}")
    assert text.splitlines()[-1] == f"numbers: {out / 'demo.json'}"


def test_files(flown):
    out, _, page, _ = flown
    names = {path.name for path in out.iterdir()}
    assert names == {"index.html", "demo.json", "prediction.png", "spread.png", "real.png"}
    assert page.count("data:image/png;base64,") == 3


def test_page_holds_the_numbers(flown):
    _, numbers, page, _ = flown
    for flight in ("flight", "real"):
        for variant in ("commands_in", "rotor_speed_in", "hold"):
            for key, value in numbers[flight][variant].items():
                if "_rmse_" in key:
                    low, high = numbers[flight]["intervals"][variant][key]
                    assert f"{value:.3g} [{low:.3g}, {high:.3g}]" in page
    assert f"{numbers['rollouts']['steps_per_s'] / 1e6:.1f} million" in page
    assert numbers["real"]["verdict"] in page
    assert numbers["environment"]["jax"] in page


def test_shipped_flight_is_predicted_to_sensor_noise(flown):
    _, numbers, *_ = flown
    flight = numbers["flight"]
    assert flight["log"] == "figure8"
    assert flight["commands_in"]["position_rmse_m@0.5s"] < 0.01
    assert flight["commands_in"]["attitude_rmse_deg@0.5s"] < 1.0
    for key, error in flight["commands_in"].items():
        if key.endswith("@0.5s"):
            assert error < 0.1 * flight["hold"][key]


def test_rollouts_spread_about_the_flight(flown):
    _, numbers, *_ = flown
    rollouts = numbers["rollouts"]
    assert (rollouts["drones"], rollouts["steps"], rollouts["precision"]) == (64, 125, "float32")
    distance = rollouts["distance_m@0.5s"]
    assert 0.01 < distance["5%"] < distance["50%"] < distance["95%"] < 3.0


def test_real_flight_is_skipped_with_a_reason(tmp_path):
    nothing, other = (demo.evaluate_real(None, folder, tmp_path / "real.png") for folder in (None, tmp_path))
    assert nothing["skipped"].startswith("give --real FOLDER")
    assert str(tmp_path) in other["skipped"]
    assert "--real" in other["skipped"]


@pytest.mark.parametrize(
    ("model", "expected"),
    [(2.0, "is worse than hold on"), (1.0, "is better"), ((1, 1, 1, 2), "worse than hold in 1 of 4")],
)
def test_verdict_follows_the_numbers(model, expected):
    model = model if isinstance(model, tuple) else (model,) * 4
    keys = [f"{quantity}_rmse_{unit}@0.5s" for quantity, unit, _ in QUANTITIES]
    result = {"commands_in": dict(zip(keys, model, strict=True)), "hold": dict.fromkeys(keys, 1.5)}
    assert expected in demo.verdict_of(result)


def test_output_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CfbError, match="this is a file"):
        Demo(tmp_path / "file" / "out").run()
