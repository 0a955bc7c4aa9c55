"""Folders for results: made with those above them, or refused in one sentence."""

from __future__ import annotations

import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder


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
