"""``cfb demo``: a page that shows the library at work, made in about a minute."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cfb_mjx.commands.command import Command, OutputFolder, Result, command
from cfb_mjx.files import output_folder, together, write_json, write_text


@dataclass(frozen=True)
class Shown(Result):
    """The results of the demonstration.

    Attributes:
        numbers: the results as in demo.json: the prediction errors on a ``flight`` and on a ``real`` one, and the
            speed of the ``rollouts``.
        page: path of the page, to open in a browser.
        figures: paths of the figures (PNG).
        json: path of the JSON file with the results.
    """

    numbers: Mapping[str, Any]
    page: Path
    figures: tuple[Path, ...]
    json: Path

    def __str__(self) -> str:
        flown, real = self.numbers["rollouts"], self.numbers["real"]
        skipped = [f"real flight: skipped; {real['skipped']}"] if "skipped" in real else []
        return "\n".join(
            [
                *_errors(self.numbers["flight"]),
                f"{flown['drones']} randomised drones: {flown['steps_per_s'] / 1e6:.1f} million steps/s "
                f"({flown['precision']}, best of 3); compiled in {flown['compile_s']:.1f} s, "
                f"one run takes {flown['run_s'] * 1e3:.0f} ms",
                *(skipped or [*_errors(real), real["verdict"]]),
                f"\ndone in {self.numbers['wall_s']:.0f} s. Open {self.page}",
                f"figures: {', '.join(map(str, self.figures))}",
                f"numbers: {self.json}",
            ]
        )


@command
class Demo(Command):
    """Evaluate a flight that comes with the library, fly 4096 randomised drones, and write a page with the results.

    Writes index.html, demo.json and the figures.

    Attributes:
        output: folder to write to.
        real: folder with real flights in the IDSIA layout (validation/*.parquet); one of them is then evaluated too.
    """

    output: OutputFolder = Path("out/demo")
    real: Path | None = None

    def run(self) -> Shown:
        """Run the demonstration, and write the figures, the numbers and the page.

        Raises:
            CfbError: a flight that cannot be read, or a file that cannot be written.
        """
        folder = output_folder(self.output)
        from cfb_mjx.runtime import configure_jax, environment, say

        configure_jax(x64=True)
        from cfb_mjx.demo import demonstrate
        from cfb_mjx.view.demo import demo_page

        begin = time.perf_counter()
        page, json = folder / "index.html", folder / "demo.json"
        with together():
            numbers = demonstrate(folder, self.real, say)
            numbers |= {"environment": environment(), "wall_s": time.perf_counter() - begin}
            write_json(json, numbers)
            write_text(page, demo_page(numbers, folder))
        names = ["prediction.png", "spread.png", *([] if "skipped" in numbers["real"] else ["real.png"])]
        return Shown(numbers, page, tuple(folder / name for name in names), json)


def _errors(flight: dict[str, Any]) -> list[str]:
    from cfb_mjx.view.demo import error_rows

    head = f"{flight['log']}: {flight['windows']} windows, RMS error after 0.5 s [95 % interval]"
    return [head, *(f"    {what:<16}{name:<24}{cells[-1]}" for what, name, *cells in error_rows(flight))]
