"""What ``cfb sweep`` refuses before it starts anything."""

import json
import sys
import threading
from pathlib import Path

import pytest
import yaml

from cfb_mjx.cli import main
from cfb_mjx.sweep.folder import Folder


@pytest.fixture
def sweep(tmp_path, monkeypatch, capsys):
    """Run ``cfb sweep`` on a file with these keys, as if Ray were not installed; status and what it said."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "ray", None)

    def run(*words: str, **keys) -> tuple[int, str]:
        document = {"format": "cfb_mjx sweep 1", "command": "fly", "arguments": {"controller": "pid"}}
        Path("s.yaml").write_text(yaml.safe_dump(document | {"over": {"seed": [0, 1]}} | keys))
        status = main(["sweep", "s.yaml", "-o", "out", *words])
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        return status, said.out + said.err

    return run


def land(name: str, line: str) -> None:
    done = Path("out/done", name)
    done.mkdir(parents=True)
    (done / "task.json").write_text(json.dumps({"line": line}))
    (done / "result.json").write_text(json.dumps({"mean_distance_mm": 4.5}))
    Path("out/sweep.yaml").write_text("")


def test_without_ray_it_says_what_to_install(sweep):
    status, said = sweep()
    assert status == 2
    assert said.endswith("cfb: cfb sweep needs Ray, which is not installed; pip install 'cfb_mjx[sweep]'.\n")


def test_a_finished_sweep_says_so_and_needs_nothing(sweep):
    for seed in (0, 1):
        land(f"seed={seed}", f"cfb fly pid --seed {seed} --json result.json")
    status, said = sweep()
    assert status == 0
    assert "all 2 tasks are done already" in said
    assert Path("out/results.csv").read_text().splitlines()[1] == "seed=0,done,,,0,4.5"


def test_another_command_line_under_a_name_is_refused(sweep):
    land("seed=1", "cfb fly mellinger --seed 1 --json result.json")
    status, said = sweep()
    assert status == 2
    assert "done/seed=1: was made by 'cfb fly mellinger --seed 1 --json result.json'" in said
    assert "give another folder" in said
    assert json.loads(Path("out/done/seed=1/result.json").read_text()) == {"mean_distance_mm": 4.5}


def test_another_training_is_not_gone_on_with(sweep):
    land("seed=7", "")
    begun = Path("out/running/seed=0")
    begun.mkdir(parents=True)
    (begun / "checkpoint.npz").write_text("")
    (begun / "task.json").write_text(json.dumps({"line": "cfb train flip --seed 0 --output ."}))
    status, said = sweep(command="train", arguments={"task": "target"})
    assert status == 2
    assert "running/seed=0: was made by 'cfb train flip" in said
    assert (begun / "checkpoint.npz").exists()


def test_results_of_no_task_any_more_are_left_alone(sweep):
    land("seed=7", "cfb fly pid --seed 7 --json result.json")
    _, said = sweep()
    said = said.replace(str(Path.cwd()) + "/", "")
    assert "1 results in out/done belong to no task of this sweep (seed=7 ...)" in said
    assert Path("out/done/seed=7/result.json").exists()


def test_a_second_driver_is_refused(sweep):
    held, ended = threading.Event(), threading.Event()

    def other() -> None:
        with Folder(Path("out")).driven((1, 2)):
            held.set()
            ended.wait(20)

    thread = threading.Thread(target=other)
    thread.start()
    held.wait(10)
    for words in ((), ("--part", "1/2")):
        status, said = sweep(*words)
        assert status == 2
        assert "another cfb sweep is at work there" in said
        assert "process" in said
    # Another part may.
    assert "needs Ray" in sweep("--part", "2/2")[1]
    ended.set()
    thread.join()
    assert "needs Ray" in sweep()[1]


def test_a_folder_with_other_things_is_refused(sweep):
    Path("out").mkdir()
    Path("out/thesis.tex").write_text("")
    status, said = sweep()
    assert status == 2
    assert "out: holds other files" in said
    assert [p.name for p in Path("out").iterdir()] == ["thesis.tex"]


def test_a_dry_run_lists_the_tasks_and_writes_nothing(sweep):
    status, said = sweep("--dry-run", "--part", "2/2")
    assert status == 0
    assert said == ("seed=1\n  cfb fly pid --seed 1 --json out/done/seed=1/result.json\n1 tasks, 0 done\n")
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--workers", "0"], "--workers 0: must be at least 1."),
        (["--retries", "-1"], "--retries -1: must be"),
        (["--part", "3"], "--part 3: write I/N"),
        (["--part", "0/2"], "--part 0/2: write I/N"),
        (["--part", "3/2"], "--part 3/2: write I/N"),
    ],
)
def test_bad_options(sweep, words, said):
    status, found = sweep(*words)
    assert status == 2
    assert said in found
    assert not Path("out").exists()


def test_an_argument_of_the_wrong_type_is_found_before_anything_starts(sweep):
    status, said = sweep(over={"seed": [0, "one"]})
    assert status == 2
    assert "s.yaml: task seed=one: " in said
    assert "seed must be a whole number, found 'one'" in said
    assert not Path("out").exists()


def test_a_folder_that_another_part_is_just_making_is_no_obstacle(sweep):
    """Jobs of an array start at the same moment."""
    for name in (".locks", "done"):
        Path("out", name).mkdir(parents=True)
    assert "holds other files" in sweep()[1]
    Path("out/done").rmdir()
    Path("out/.sweep.yaml.x.tmp.yaml").write_text("")
    assert "needs Ray" in sweep("--part", "1/2")[1]
