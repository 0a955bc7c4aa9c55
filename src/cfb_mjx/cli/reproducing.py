"""``cfb reproduce``: the paper's figures and tables."""

from __future__ import annotations

import time
from pathlib import Path

from cfb_mjx.cli.runtime import configure_jax, environment, say
from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, write_json, write_text

_CHECKOUT = Path(__file__).resolve().parents[3]
ALL = "all"


def run_reproduce(names: tuple[str, ...], output: Path, real: Path | None) -> dict:
    """Make the items, each in turn, and the pages about them.

    Args:
        names: of `cfb_mjx.reproduce.ITEMS`, or ``all``.
        output: folder, made if missing.
        real: folder of real flights; by default ``shared/real`` beside the checkout, if there is one.

    Raises:
        CfbError: an unknown name, no flights in ``real``, or an output that cannot be written.
    """
    from cfb_mjx.reproduce import ITEMS
    from cfb_mjx.reproduce.document import markdown, page

    unknown = [name for name in names if name not in (*ITEMS, ALL)]
    if unknown or not names:
        raise CfbError(
            f"{', '.join(unknown) or 'nothing'}: cannot be reproduced; choose from {ALL}, {', '.join(ITEMS)}."
        )
    chosen = list(ITEMS) if ALL in names else [name for name in ITEMS if name in names]
    real = _real(real)
    output = output_folder(output)
    begin, results = time.perf_counter(), {}
    for count, name in enumerate(chosen, 1):
        started = time.perf_counter()
        configure_jax(x64=ITEMS[name].x64)
        results[name] = ITEMS[name].make(output, real)
        say(f"{count}/{len(chosen)} {name}: {time.perf_counter() - started:.0f} s")
    facts, whole = environment(), time.perf_counter() - begin
    command = " ".join(["cfb reproduce", ALL if len(chosen) == len(ITEMS) else " ".join(chosen)])
    # How long it took is said on the screen only: on one machine, a day's pages are the same to the byte.
    write_text(output / "index.html", page(results, facts))
    write_text(output / "paper.md", markdown(results, facts, command))
    numbers = {name: [vars(row) for row in result.rows] for name, result in results.items()}
    write_json(output / "paper.json", {"rows": numbers, "environment": facts})
    for name, result in results.items():
        print(f"\n{result.title} ({name})")
        for row in result.rows:
            paper = f"   paper {row.paper}" if row.paper else ""
            print(f"  {row.what}: {row.ours}{paper}")
    print(f"\ndone in {whole:.0f} s. Open {output / 'index.html'}")
    print(f"numbers: {output / 'paper.md'}, {output / 'paper.json'}")
    return {"results": results, "environment": facts}


def _real(folder: Path | None) -> Path | None:
    beside = _CHECKOUT.parent / "shared" / "real"
    chosen = beside if folder is None else folder
    if any((chosen / part).is_dir() and any((chosen / part).glob("*.parquet")) for part in ("fit", "validation")):
        return chosen
    if folder is not None:
        raise CfbError(f"{folder}: has no fit/*.parquet or validation/*.parquet; leave --real out to do without.")
    return None
