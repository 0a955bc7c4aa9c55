"""``cfb reproduce``: the paper's figures and tables."""

from __future__ import annotations

import json
import time
from pathlib import Path

from cfb_mjx.errors import CfbError
from cfb_mjx.files import code_identity, output_folder, together, write_json, write_text
from cfb_mjx.runtime import configure_jax, environment, say

_CHECKOUT = Path(__file__).resolve().parents[3]
ALL = "all"


PAGE, TEXT, NUMBERS = "index.html", "paper.md", "paper.json"


def run_reproduce(
    names: tuple[str, ...],
    output: Path,
    real: Path | None,
    flights: Path | None = None,
    mass: float | None = None,
) -> dict:
    """Make the items, each in turn, and after each the pages about those that are made.

    A run that was interrupted goes on with what is left when it is started again with the same names and flights.

    Args:
        names: of `cfb_mjx.reproduce.ITEMS`, or ``all``.
        output: folder, made if missing.
        real: folder of real flights; by default ``shared/real`` beside the checkout, if there is one.
        flights: folder of flights of the drone that the items are about.
        mass: of that drone, kg.

    Raises:
        CfbError: an unknown name, no flights in ``real`` or ``flights``, flights that no item takes, an impossible
            mass, or an output that cannot be written.
    """
    from cfb_mjx.reproduce import ITEMS
    from cfb_mjx.reproduce.flights import Given

    unknown = [name for name in names if name not in (*ITEMS, ALL)]
    if unknown or not names:
        raise CfbError(
            f"{', '.join(unknown) or 'nothing'}: cannot be reproduced; choose from {ALL}, {', '.join(ITEMS)}."
        )
    chosen = list(ITEMS) if ALL in names else [name for name in ITEMS if name in names]
    _require_fitting(chosen, flights, mass, {name for name, item in ITEMS.items() if item.given})
    real = _real(real)
    given = None if flights is None else Given.read(flights, mass)
    output = output_folder(output)
    words = ["cfb reproduce", ALL if len(chosen) == len(ITEMS) else " ".join(chosen)]
    of = {"names": chosen, "code": code_identity(), "real": str(real), "flights": str(flights), "mass": mass}
    results = _made(output, of)
    if results:
        say(f"{len(results)} of {len(chosen)} were made before the interruption; going on with the rest")
    begin = time.perf_counter()
    for name in chosen:
        if name in results:
            continue
        started = time.perf_counter()
        configure_jax(x64=ITEMS[name].x64)
        more = {"given": given} if ITEMS[name].given else {}
        with together():
            results[name] = ITEMS[name].make(output, real, **more)
            results = {item: results[item] for item in chosen if item in results}
            _write(output, results, of, " ".join(words))
        say(f"{len(results)}/{len(chosen)} {name}: {time.perf_counter() - started:.0f} s")
    whole = time.perf_counter() - begin
    for name, result in results.items():
        print(f"\n{result.title} ({name})")
        for row in result.rows:
            paper = f"   paper {row.paper}" if row.paper else ""
            kind = {"result": "", "input": "   [input]", "own": "   [own flight]"}[row.kind]
            print(f"  {row.what}: {row.ours}{paper}{kind}")
    print(f"\ndone in {whole:.0f} s. Open {output / PAGE}")
    print(f"numbers: {output / TEXT}, {output / NUMBERS}")
    return {"results": results, "environment": environment()}


def _require_fitting(chosen: list[str], flights: Path | None, mass: float | None, takers: set[str]) -> None:
    """Refuse flights that would be taken for those of another drone, or not at all."""
    if flights is None:
        if mass is not None:
            raise CfbError("--mass is of the drone of --flights; give those, or leave it out.")
        return
    if mass is not None and not 0.005 <= mass <= 0.5:
        raise CfbError(f"--mass {mass:g}: must be in kg, from 0.005 to 0.5.")
    if not set(chosen) <= takers or ("brushed" in chosen and len(chosen) > 1):
        raise CfbError(
            f"--flights: name what they are for, of {', '.join(sorted(takers))}; brushed alone, for it takes flights "
            "of a brushed drone and the others of a brushless one."
        )


def _write(output: Path, results: dict, of: dict, command: str) -> None:
    """The pages, the rows and what is needed to go on."""
    from cfb_mjx.reproduce.document import markdown, page

    facts = environment()
    left = [name for name in of["names"] if name not in results]
    said = f"Not made yet: {', '.join(left)}; the same command goes on with them." if left else ""
    # How long it took is said on the screen only: on one machine, a day's pages are the same to the byte.
    write_text(output / PAGE, page(results, facts, said))
    write_text(output / TEXT, markdown(results, facts, command, left=said))
    kept = {
        name: {
            "title": result.title,
            "text": list(result.text),
            "figures": [(path.name, alternative) for path, alternative in result.figures],
            "tables": list(result.tables),
        }
        for name, result in results.items()
    }
    rows = {name: [vars(row) for row in result.rows] for name, result in results.items()}
    write_json(output / NUMBERS, {"rows": rows, "environment": facts, "of": of, "left": left, "items": kept})


def _made(output: Path, of: dict) -> dict:
    """What an interrupted run of the same has made already; nothing where one came to its end."""
    from cfb_mjx.reproduce.item import Result, Row

    try:
        found = json.loads((output / NUMBERS).read_text(encoding="utf-8"))
        if found["of"] != of or not found["left"]:
            return {}
        results = {}
        for name, item in found["items"].items():
            figures = [(output / file, alternative) for file, alternative in item["figures"]]
            rows = [Row(**row) for row in found["rows"][name]]
            if all(path.is_file() for path, _ in figures):
                results[name] = Result(item["title"], item["text"], rows, figures, item["tables"])
        return results
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _real(folder: Path | None) -> Path | None:
    beside = _CHECKOUT.parent / "shared" / "real"
    chosen = beside if folder is None else folder
    if any((chosen / part).is_dir() and any((chosen / part).glob("*.parquet")) for part in ("fit", "validation")):
        return chosen
    if folder is not None:
        raise CfbError(f"{folder}: has no fit/*.parquet or validation/*.parquet; leave --real out to do without.")
    return None
