"""Completion: what bash offers, and that zsh and fish can read theirs."""

import shutil
import subprocess

import pytest

from cfb_mjx.cli import main
from cfb_mjx.completion import script


def offered(tmp_path, *words: str) -> set[str]:
    """What bash offers for the last word."""
    (tmp_path / "cfb.bash").write_text(script("bash"))
    typed = " ".join(f"'{word}'" for word in ("cfb", *words))
    code = f'source cfb.bash; COMP_WORDS=({typed}); COMP_CWORD={len(words)}; _cfb; printf "%s\\n" "${{COMPREPLY[@]}}"'
    done = subprocess.run(["bash", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_bash_offers_commands_options_choices_and_files(tmp_path):
    (tmp_path / "flight.mcap").write_text("")
    assert offered(tmp_path, "fi") == {"fit", "fit-rotors"}
    assert {"--held-out", "--help"} <= offered(tmp_path, "fit", "--h")
    assert offered(tmp_path, "fit", "a.mcap", "--estimator", "") == {"auto", "innovation", "shooting"}
    assert offered(tmp_path, "evaluate", "fl") == {"flight.mcap"}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_can_read_it(shell, tmp_path):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not here")
    (tmp_path / "it").write_text(script(shell))
    subprocess.run([shell, "-n", tmp_path / "it"], check=True)


def test_it_is_written_where_the_shell_looks(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setenv("SHELL", "/bin/bash")
    for words in (["bash"], []):
        assert main(["--install-completion", *words]) == 0
        written = tmp_path / "bash-completion" / "completions" / "cfb"
        assert str(written) in capsys.readouterr().out
        assert written.read_text() == script("bash")
    assert main(["--install-completion", "tcsh"]) == 2
    assert "choose from bash, zsh, fish" in capsys.readouterr().err
