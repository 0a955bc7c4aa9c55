"""Files: written whole, those of one run together; folders for results made with those above them, or refused."""

from __future__ import annotations

import itertools
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, read_bytes, remove, replacing, scratch, together, write_text, write_texts

NAMES = ("model.yaml", "report.html", "report.json")


def test_output_folder_is_made_with_those_above_it(tmp_path):
    folder = output_folder(tmp_path / "a" / "b")
    (folder / "earlier").write_text("kept")
    assert output_folder(tmp_path / "a" / "b") == folder
    assert (folder / "earlier").read_text() == "kept"


@pytest.mark.parametrize("below", ["", "more"])
def test_a_file_in_the_way_of_a_folder_is_named(tmp_path, below):
    file = tmp_path / "taken"
    file.write_text("mine")
    with pytest.raises(CfbError, match="taken: this is a file"):
        output_folder(file / below)
    assert file.read_text() == "mine"


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444])
def test_a_file_keeps_its_mode(tmp_path, mode):
    path = tmp_path / "private.yaml"
    path.write_text("old")
    path.chmod(mode)
    write_text(path, "new")
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == mode


def test_a_new_file_has_the_mode_of_any_other(tmp_path):
    write_text(tmp_path / "new", "")
    (tmp_path / "usual").write_text("")
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_what_lands_together_is_of_one_run(tmp_path):
    write_texts(tmp_path, dict.fromkeys(NAMES, "old"))
    write_text(tmp_path / "search.json", "old")
    with together():
        for name in NAMES:
            write_text(tmp_path / name, "half")
            write_text(tmp_path / name, "new")
            assert (tmp_path / name).read_text() == "old"
            assert read_bytes(tmp_path / name) == b"new"
        remove(tmp_path / "search.json")
        assert (tmp_path / "search.json").exists()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(NAMES, "new")


@pytest.mark.parametrize("error", [CfbError, KeyboardInterrupt])
def test_a_failure_before_all_is_written_changes_nothing(tmp_path, error):
    write_texts(tmp_path, dict.fromkeys(NAMES, "old"))
    with pytest.raises(error), together():  # noqa: PT012
        write_text(tmp_path / NAMES[0], "new")
        remove(tmp_path / NAMES[1])
        raise error
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(NAMES, "old")


def test_a_file_that_cannot_take_its_place_takes_the_others_back(tmp_path, monkeypatch):
    write_texts(tmp_path, dict.fromkeys(NAMES, "old"))
    count, rename = itertools.count(), Path.rename

    def full(self, target):
        if next(count) == 1:
            raise OSError(28, "No space left on device")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(CfbError, match="Earlier files are unchanged"):
        write_texts(tmp_path, dict.fromkeys(NAMES, "new"))
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(NAMES, "old")


KILLED = """
import os, signal, sys
from pathlib import Path
from cfb_mjx.files import write_texts

at, count = int(sys.argv[2]), 0

def dying(name):
    act = getattr(os, name)
    def call(*arguments, **more):
        global count
        count += 1
        if count > at:
            os.kill(os.getpid(), signal.SIGKILL)
        return act(*arguments, **more)
    setattr(os, name, call)

for name in ("open", "rename", "replace", "unlink", "chmod"):
    dying(name)
write_texts(Path(sys.argv[1]), dict.fromkeys(sys.argv[3:], "new"))
"""


def test_killed_at_any_moment_nothing_new_lies_beside_anything_old(tmp_path):
    ends = []
    for at in itertools.count():
        folder = tmp_path / str(at)
        folder.mkdir()
        write_texts(folder, dict.fromkeys(NAMES, "old"))
        done = subprocess.run([sys.executable, "-c", KILLED, folder, str(at), *NAMES], check=False, cwd="/")
        there = {(folder / name).read_text() for name in NAMES if (folder / name).exists()}
        assert len(there) == 1, (at, there)
        ends.append(there.pop())
        # The next run clears away what was left.
        write_texts(folder, dict.fromkeys(NAMES, "newest"))
        assert {path.name: path.read_text() for path in folder.iterdir()} == dict.fromkeys(NAMES, "newest")
        if done.returncode == 0:
            break
    assert len(ends) > 6
    assert ends == sorted(ends, reverse=True)  # old until some moment, new from then on


def test_what_another_process_is_writing_is_not_cleared_away(tmp_path):
    with replacing(tmp_path / "slow.txt") as temporary:
        temporary.write_text("slow")
        code = "import sys; from cfb_mjx.files import write_text; write_text(sys.argv[1], 'quick')"
        subprocess.run([sys.executable, "-c", code, tmp_path / "quick.txt"], check=True, env=dict(os.environ))
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"slow.txt": "slow", "quick.txt": "quick"}


def test_scratch_files_are_there_at_once_while_others_wait(tmp_path):
    with together():
        write_text(tmp_path / "kept", "new")
        with scratch() as folder:
            write_text(Path(folder) / "drawn", "a figure")
            assert (Path(folder) / "drawn").read_text() == "a figure"
        assert not (tmp_path / "kept").exists()
    assert (tmp_path / "kept").read_text() == "new"
    assert not Path(folder).exists()
