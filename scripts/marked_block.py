"""Write the blocks of hand-written pages that scripts generate: everything between two marks."""

from pathlib import Path

from cfb_mjx.files import write_text


def write_block(page: Path, name: str, text: str) -> None:
    """Replace the text between ``<!-- name: begin -->`` and ``<!-- name: end -->``.

    Raises:
        ValueError: the page does not have these marks.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise ValueError(f"{page}: has no block {name}")
    write_text(page, f"{before}{begin}\n{text}\n{end}{after}")
