"""The table of results."""

import csv
import json

from cfb_mjx.sweep.folder import open_folder
from cfb_mjx.sweep.summary import Summary, numbers_of
from cfb_mjx.sweep.tasks import Task


def test_numbers_are_found_by_dotted_names():
    result = {
        "failed": False,
        "text": "no number",
        "hole": None,
        "environment": {"cores": 2},
        "parameters": {"mass": {"value": 0.04, "unit": "kg"}},
        "effects": [{"name": "wind", "p_value": 0.01, "parameters": {"x": 1.5}}],
        "rows": [1, 2, 3],
        "a": {"b": {"c": {"d": 1, "too": {"deep": 2}}}},
    }
    assert numbers_of(result) == {
        "failed": False,
        "parameters.mass.value": 0.04,
        "effects.wind.p_value": 0.01,
        "effects.wind.parameters.x": 1.5,
        "a.b.c.d": 1,
    }


def test_every_task_has_a_row_whatever_became_of_it(tmp_path):
    tasks = [Task(f"seed={n}", "fly", (), (), {"seed": n, "model": None}) for n in range(3)]
    folder = open_folder(tmp_path / "out", "")
    folder.done("seed=0").mkdir()
    (folder.done("seed=0") / "task.json").write_text(json.dumps({"attempts": 2, "seconds": 1.5}))
    (folder.done("seed=0") / "result.json").write_text(json.dumps({"seed": 0, "error": 0.25, "failed": True}))
    folder.fail(tasks[1], "no such model.")
    summary = Summary(folder, tasks)
    summary.refresh()
    with open(folder.path / "results.csv") as file:
        rows = list(csv.DictReader(file))
    common = {"attempts": "", "seconds": "", "model": "", "error": "", "failed": ""}
    landed = {"attempts": "2", "seconds": "1.5", "error": "0.25", "failed": "true"}
    assert rows == [
        {"name": "seed=0", "state": "done", "seed": "0"} | common | landed,
        {"name": "seed=1", "state": "failed", "seed": "1"} | common,
        {"name": "seed=2", "state": "open", "seed": "2"} | common,
    ]
    assert [row["state"] for row in json.loads((folder.path / "results.json").read_text())["tasks"]] == [
        "done",
        "failed",
        "open",
    ]
    assert folder.failed("seed=1").read_text().startswith("no such model.\n")


def test_another_drivers_results_come_in(tmp_path):
    """Several parts of a sweep write the same table."""
    tasks = [Task(f"seed={n}", "fly", (), (), {"seed": n}) for n in range(2)]
    folder = open_folder(tmp_path / "out", "")
    summary = Summary(folder, tasks)
    summary.refresh(now=True)
    for name in ("seed=0", "seed=1"):
        folder.done(name).mkdir()
    summary.refresh()  # too soon
    assert (folder.path / "results.csv").read_text().count("done") == 0
    summary.refresh(now=True)
    assert (folder.path / "results.csv").read_text().count("done") == 2
