"""Names of files and other people's words reach the terminal as text: nothing in them steers it."""

import io
import os
import shutil
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cfb_mjx import cli
from cfb_mjx.runtime import Progress, say
from cfb_mjx.terminal import escaped, shown

EVIL = "\x1b]0;owned\x07\x1b[2J\r\x9b1A\u202e"
BYTES = os.fsdecode(b"caf\xe9")  # no UTF-8: a lone surrogate, which cannot be printed


def steers(text: str) -> bool:
    return any(c in text for c in "\x1b\x07\r\x9b\u202e")


@given(st.text(st.characters()))
def test_what_is_shown_can_be_printed_and_ordinary_text_is_as_it_was(text):
    found = shown(text)
    found.encode()
    assert all(c in "\n\t" or c.isprintable() or c.isspace() or ord(c) > 0xA0 for c in found)
    assert shown(found) == found
    plain = "".join(c for c in text if c.isprintable())
    assert shown(plain) == plain


@pytest.mark.parametrize(
    "arguments",
    [
        ["evaluate", f"{EVIL}.csv"],
        ["evaluate", f"{BYTES}.csv"],
        ["evaluate", "here.csv", "--devices", EVIL],
        ["bench", "--drones", EVIL],
        [f"evaluate{EVIL}"],
        ["fly", "pid", "--model", f"{EVIL}.yaml"],
    ],
)
def test_a_refusal_names_the_file_and_does_not_obey_it(arguments, capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert cli.main(arguments) == 2
    out, err = capsys.readouterr()
    assert not steers(out + err), out + err
    (out + err).encode()
    assert r"\x1b" in out + err or r"\udce9" in out + err


def test_a_result_names_the_file_and_does_not_obey_it(files, tmp_path, capsys):
    shutil.copy(files / "flight.csv", tmp_path / f"{EVIL}.csv")
    assert cli.main(["import", str(tmp_path / f"{EVIL}.csv"), "-o", str(tmp_path / f"{EVIL}.mcap")]) == 0
    assert (tmp_path / f"{EVIL}.mcap").exists()
    out, err = capsys.readouterr()
    assert not steers(out + err)
    assert r"\x1b]0;owned" in out


def test_whoever_prints_is_escaped_and_a_bar_still_rewrites_its_line(monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    with escaped():
        say(EVIL)
        sys.stderr.writelines([EVIL])
        print(EVIL, file=sys.stderr)
        assert not steers(terminal.getvalue())
        terminal.truncate(0)
        Progress(f"fitting {EVIL}")(1, 2, EVIL)
    assert sys.stderr is terminal
    bar = terminal.getvalue().strip("\0")
    assert bar.startswith("\rfitting ")
    assert bar.endswith("\x1b[K")
    assert not steers(bar[1:-3])
