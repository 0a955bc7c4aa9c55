"""One attempt at a task, without Ray: what lands, what does not, and what is gone on from."""

import json
import os
import sys
import threading
from pathlib import Path

import pytest

from cfb_mjx.sweep.drive import TaskFault, attempt
from cfb_mjx.sweep.folder import open_folder, read_record
from cfb_mjx.sweep.tasks import Task

FLY = Task("seed=1", "fly", ("pid", "--seed", "1"), (("--json", "result.json"),), {"seed": 1})
TRAIN = Task("a", "train", ("target",), (("--output", "."),), {"seed": 1})


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # an attempt changes it
    return open_folder(tmp_path / "out", "")


def result(words: list[str]) -> Path:
    return Path(words[words.index("--json") + 1])


def fly(words: list[str]) -> int:
    os.write(1, b"from compiled code\n")
    print("flown")
    result(words).write_text(json.dumps({"words": words}))
    return 0


def test_results_land_whole_with_what_was_printed(folder, tmp_path, capfd):
    assert attempt(FLY, folder, str(tmp_path), fly).failed is None
    done = folder.done(FLY.name)
    assert {p.name for p in done.iterdir()} == {"result.json", "task.json", "output.txt"}
    assert json.loads((done / "result.json").read_text())["words"][:4] == ["fly", "pid", "--seed", "1"]
    printed = (done / "output.txt").read_text()
    assert "flown" in printed
    assert "from compiled code" in printed
    assert FLY.line in printed
    assert capfd.readouterr() == ("", "")
    record = read_record(done)
    assert record["attempts"] == 1
    assert record["line"] == FLY.line
    assert not folder.running(FLY.name).exists()


def test_what_is_done_is_not_done_again(folder, tmp_path):
    attempt(FLY, folder, str(tmp_path), fly)
    before = (folder.done(FLY.name) / "task.json").stat()
    assert attempt(FLY, folder, str(tmp_path), lambda words: pytest.fail("ran again")).failed is None
    assert (folder.done(FLY.name) / "task.json").stat() == before


def test_a_second_attempt_waits_for_the_first_and_discards_itself(folder, tmp_path):
    """As when a machine that was given up for lost goes on working."""
    begun, ended = threading.Event(), threading.Event()

    def other() -> None:
        with folder.alone(FLY.name):
            begun.set()
            ended.wait(10)
            folder.done(FLY.name).mkdir()

    thread = threading.Thread(target=other)
    thread.start()
    begun.wait(10)
    threading.Timer(0.5, ended.set).start()
    assert attempt(FLY, folder, str(tmp_path), lambda words: pytest.fail("ran beside the other")).failed is None
    assert ended.is_set()
    thread.join()


def test_bad_input_is_told_and_lands_nowhere(folder, tmp_path):
    def refuse(words) -> int:
        print("cfb: nothing: no such model.", file=sys.stderr)
        return 2

    assert attempt(FLY, folder, str(tmp_path), refuse).failed == "nothing: no such model."
    assert not folder.done(FLY.name).exists()


def test_a_fault_asks_for_another_attempt_and_leaves_nothing_of_itself(folder, tmp_path):
    def broken(words) -> int:
        (result(words).parent / "half").mkdir()
        raise ValueError("out of luck")

    with pytest.raises(TaskFault, match="ValueError: out of luck"):
        attempt(FLY, folder, str(tmp_path), broken)
    assert "Traceback" in (folder.running(FLY.name) / "output.txt").read_text()
    assert attempt(FLY, folder, str(tmp_path), fly).failed is None
    done = folder.done(FLY.name)
    assert read_record(done)["attempts"] == 2
    assert not (done / "half").exists()
    assert "out of luck" in (done / "output.txt").read_text()


def test_a_command_that_wrote_no_result_is_not_done(folder, tmp_path):
    with pytest.raises(TaskFault):
        attempt(FLY, folder, str(tmp_path), lambda words: 0)
    assert not folder.done(FLY.name).exists()


def test_a_training_goes_on_from_its_checkpoint(folder, tmp_path):
    seen = []

    def train(words: list[str]) -> int:
        here = Path(words[words.index("--output") + 1])
        seen.append(((here / "checkpoint.npz").exists(), "--resume" in words))
        (here / "checkpoint.npz").write_text("")
        if len(seen) == 1:
            (here / ".policy.npz.abc.tmp.npz").write_text("half written")
            raise KeyboardInterrupt
        (here / "training.json").write_text("{}")
        return 0

    with pytest.raises(KeyboardInterrupt):
        attempt(TRAIN, folder, str(tmp_path), train)
    assert attempt(TRAIN, folder, str(tmp_path), train).failed is None
    assert seen == [(False, True), (True, True)]
    assert {p.name for p in folder.done("a").iterdir()} == {
        "checkpoint.npz",
        "training.json",
        "task.json",
        "output.txt",
    }
