"""``cfb demo-loop``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cfb_mjx.files import require_no_file, together, write_json, write_text
from cfb_mjx.runtime import Progress, configure_jax, environment, say

RESULTS, PAGE, FIGURE = "loop.json", "index.html", "loop.png"
DEFAULT_EFFECT = "payload"


def run_demo_loop(output: Path, effects: tuple[str, ...], seeds: int, seed: int) -> None:
    """Close the loop for every effect and seed, and write results, figure and page into ``output``.

    Raises:
        CfbError: an unknown effect, a number out of range, or a folder with other results or that cannot be written.
    """
    from cfb_mjx.loop.study import cells_of

    cells = cells_of(effects or (DEFAULT_EFFECT,), seeds, seed)
    require_no_file(output)
    results = carry_out(cells, output, lambda results: write_results(results, output))
    from cfb_mjx.view.closed_loop import lead

    print(f"{lead(results)}\nresults: {output / RESULTS}\npage: {output / PAGE}")


def carry_out(cells: list, output: Path, finished: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Go through cells of `cfb_mjx.loop.study`; ``finished`` gets all results after each.

    Raises:
        CfbError: as `run_demo_loop`.
    """
    configure_jax(x64=False)
    from cfb_mjx.loop.steps import real_steps, settings
    from cfb_mjx.loop.study import run

    facts = environment()
    return run(cells, output, real_steps(facts, _close, say, _watch), settings(), say, finished)


def write_results(results: dict[str, Any], output: Path) -> None:
    """Results, figure and page, in that order."""
    from cfb_mjx.view import html_page
    from cfb_mjx.view.closed_loop import TITLE, lead, loop_figure, sections

    facts = list(results["cells"].values())[-1]["trials"]["environment"]
    with together():
        write_json(output / RESULTS, results)
        loop_figure(results, output / FIGURE)
        write_text(output / PAGE, html_page(TITLE, lead(results), sections(results, output / FIGURE), facts))


def _close(fit: list[Path], held_out: list[Path], output: Path) -> None:
    from cfb_mjx.cli.closing import run_close_loop
    from cfb_mjx.loop.policies import CONFIG
    from cfb_mjx.train.config import load_config

    arguments = ["--fit", *(p.name for p in fit), "--held-out", *(p.name for p in held_out), "-o", output.name]
    run_close_loop(fit, held_out, output, load_config(CONFIG).model, [], arguments)


def _watch(what: str):
    bar = Progress(what)
    return lambda done, total, rate, left: bar(done, total, f"{left:.0f} s left")
