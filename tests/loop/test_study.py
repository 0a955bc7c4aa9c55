"""A study of the closed loop: what is done is kept, and the page says what the numbers say."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from cfb_mjx.commands import DemoLoop
from cfb_mjx.errors import CfbError
from cfb_mjx.loop import steps
from cfb_mjx.loop.page import TITLE, lead, loop_figure, sections
from cfb_mjx.loop.steps import Cell, cells_of
from cfb_mjx.loop.study import study
from cfb_mjx.loop.summary import summarise
from cfb_mjx.reference_simulator import EFFECTS
from cfb_mjx.view import html_page

ERRORS = {
    "position_rmse_m@0.5s": 0.1,
    "velocity_rmse_mps@0.5s": 0.4,
    "attitude_rmse_deg@0.5s": 3.0,
    "rate_rmse_radps@0.5s": 0.2,
}
NAMED = {"payload": "payload", "wind": "cog_offset"}
"""What the made-up diagnosis says of each."""


def trial(hover, track):
    return {"hover_mm": [hover, hover], "command_std": [0.01, 0.01], "track_m": [track], "crashed": 0}


def report(own):
    effect = own.name.rpartition("-")[0]
    after = {key: value / 10 for key, value in ERRORS.items()}
    kept = {"unexplained": False, "unexplained_because": None, "unconfirmed": []}
    return {"effects": [{"name": NAMED[effect]}], **kept, "held_out": {"before": ERRORS, "after": after}}


def judged(cell, policies, own):
    good = cell.effect == "payload"
    return {
        "nominal": trial(40.0, 0.06) if good else trial(20.0, 0.05),
        "longer": trial(38.0, 0.06),
        "randomised": trial(20.0, 0.04),
        "corrected": trial(5.0, 0.05) if good else trial(25.0, 0.06),
        "both": trial(6.0, 0.03),
        "without_effect": trial(4.0, 0.05) if good else trial(19.0, 0.05),
        "environment": {"date": "2000-01-01", "processor": "none"},
    }


SETTINGS = {
    "config": {"analytic": {"updates": 5, "drones": 2}, "randomisation": {"magnitude": 0.25}},
    "further": ("analytic.updates=2",),
    "both": ("analytic.updates=2", "randomisation.magnitude=1.0"),
    "randomised": ("randomisation.magnitude=1.0", "analytic.updates=7"),
    "flights": {
        "FIT": ["lateral"],
        "HELD_OUT": ["circle"],
        "USUAL_SECONDS": [1.0, 2.0],
        "SECONDS": {"long_hover": [3.0, 4.0]},
        "DITHER_OF_JUMPS": 0.02,
        "RAISE": 0.4,
    },
    "trials": {"HOVERS": 2, "HOVER_S": 6.0, "SETTLING_S": 1.0, "TRACKS": 1, "TRACK_S": 9.0, "ENTRY_S": 3.0}
    | {"WIDTH_M": 1.0, "DEPTH_M": 0.5, "PERIOD_S": 6.0},
}


@pytest.fixture
def counted(monkeypatch):
    """Steps that only count: what was done of which cell, and where to stop."""
    done, stops = [], []

    def step(name, result):
        def act(*arguments):
            cell = next(a.name for a in arguments if isinstance(a, Cell | Path))
            if (name, cell) in stops:
                raise KeyboardInterrupt
            done.append((name, cell))
            return result(*arguments)

        monkeypatch.setattr(steps, name, act)

    step("train_common", lambda seed, folder: {})
    step("fly", lambda *_: {})
    step("close", report)
    step("learn", lambda *_: {})
    step("judge", judged)
    monkeypatch.setattr(steps, "settings", lambda: SETTINGS)
    return done, stops


def test_cells_go_seed_by_seed_and_share_no_draws():
    cells = cells_of(("payload", "wind", "payload"), 2, 61_000)
    assert [cell.name for cell in cells] == ["payload-61000", "wind-61000", "payload-61100", "wind-61100"]
    assert len({cell.case.seed for cell in cells}) == 4
    assert len(EFFECTS) < 100
    assert cells[0].case.effects == (("payload", 1.0),)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((("gremlins",), 1), "gremlins: there is no such effect; choose from rotor_drag"),
        ((("outside_wall",), 1), "outside_wall"),
        ((("sensor_delay",), 1), "sensor_delay"),
        (((), 1), "name at least one"),
        ((("wind",), 0), "--seeds 0"),
        ((("wind",), 1, -1), "--seed -1"),
    ],
)
def test_what_cannot_be_flown_is_refused(tmp_path, arguments, says):
    with pytest.raises(CfbError, match=says):
        DemoLoop(tmp_path, *arguments).run()
    assert not any(tmp_path.iterdir())


def test_an_interrupted_study_goes_on_where_it_was(tmp_path, counted):
    done, stops = counted
    cells = cells_of(("payload", "wind"), 1)
    stops.append(("learn", "wind-61000"))
    with pytest.raises(KeyboardInterrupt):
        list(study(cells, tmp_path))
    assert (tmp_path / "cells" / "payload-61000" / "result.json").exists()
    stops.clear()
    done.clear()
    seen = [json.loads(json.dumps(results)) for results in study(cells, tmp_path)]
    assert [name for name, what in done if what == "payload-61000"] == []
    assert [name for name, what in done if what == "wind-61000"] == ["fly", "close", "learn", "judge"]
    assert [list(results["cells"]) for results in seen] == [["payload-61000"], ["payload-61000", "wind-61000"]]
    done.clear()
    assert [json.loads(json.dumps(results)) for results in study(cells[:1], tmp_path)] == seen[1:]
    assert {name for name, _ in done} == {"train_common"}


def test_a_folder_is_for_one_kind_of_study(tmp_path, counted, monkeypatch):
    cells = cells_of(("payload",), 1)
    list(study(cells, tmp_path))
    monkeypatch.setattr(steps, "settings", lambda: SETTINGS | {"further": ("analytic.updates=3",)})
    with pytest.raises(CfbError, match="other settings"):
        list(study(cells, tmp_path))


def test_the_command_writes_what_was_found(tmp_path, counted, capsys):
    found = DemoLoop(tmp_path / "loop", effects=("payload", "wind"), seeds=2).run()
    assert json.loads((tmp_path / "loop" / "loop.json").read_text()) == json.loads(json.dumps(found.numbers))
    assert "close-loop named the effect of 2 of 4" in str(found)
    assert str(found).splitlines()[1:] == [f"{what}: {path}" for what, path in found.files.items()]
    assert all(path.stat().st_size > 1000 for path in found.files.values())
    said = capsys.readouterr()
    assert said.out == ""
    assert "wind, seed 61100 (4 of 4)" in said.err


@pytest.fixture
def results(tmp_path, counted):
    *_, last = study(cells_of(("payload", "wind"), 3), tmp_path)
    return last


def test_a_summary_is_of_medians_and_says_what_did_not_help(results):
    results["cells"]["payload-61100"]["trials"]["nominal"]["hover_mm"][0] = None
    payload, wind = summarise(results["cells"].values())
    assert (payload.right, wind.right) == (3, 0)
    assert payload.change["hover_mm"] == pytest.approx(-0.875)
    assert payload.alone["hover_mm"] == pytest.approx(-0.05)
    assert payload.improved("hover_mm")
    assert payload.improved("track_m")
    assert not payload.why_not
    crashed = payload.spreads["hover_mm"]["nominal"]
    assert (crashed.median, crashed.greatest, crashed.crashed) == (40.0, math.inf, 1)
    assert wind.change["hover_mm"] == pytest.approx(0.25)
    assert "little to gain in hover: 20 mm with the effect, 19 mm without" in wind.why_not[0]
    assert "0 of 3 drones" in wind.why_not[-1]
    assert payload.held_out["position_rmse_m@0.5s"] == pytest.approx((0.1, 0.01))


def test_a_policy_that_crashes_after_all_is_no_improvement(results):
    for seed in (61_000, 61_100):
        results["cells"][f"payload-{seed}"]["trials"]["corrected"]["track_m"][0] = None
    payload = summarise(results["cells"].values())[0]
    assert payload.change["track_m"] == math.inf
    assert not payload.improved("track_m")


def test_the_page_says_what_the_numbers_say(results, tmp_path):
    results["cells"]["wind-61100"]["trials"]["corrected"]["hover_mm"][0] = None
    figure = tmp_path / "loop.png"
    loop_figure(results, figure)
    assert figure.stat().st_size > 10_000
    text = html_page(TITLE, lead(results), sections(results, figure), {"date": "2000-01-01"})
    assert "close-loop named the effect of 3 of 6" in text
    assert "hovers the same drone better for 1 of 2 effects" in text
    assert "-88 %" in text
    assert "cog_offset" in text
    assert "lost" in text
    assert "1 crashed" in text
    assert "wind: hover error +25 % and tracking error +20 %" in text
    assert (
        "flies better than the corrected model, in the median, for: payload (tracking); wind (hover, tracking)" in text
    )
