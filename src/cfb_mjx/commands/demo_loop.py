"""``cfb demo-loop``: the loop closed all the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from cfb_mjx.commands.command import Command, OutputFolder, Result, Within, command, lines_of
from cfb_mjx.files import require_no_file, together, write_json, write_text
from cfb_mjx.optional import not_none


@dataclass(frozen=True)
class Improved(Result):
    """How drones fly before and after.

    Attributes:
        numbers: as loop.json has them: ``numbers["cells"]["payload-61000"]["trials"]["corrected"]`` and the like.
        files: what was written, by what it is.
    """

    numbers: Mapping[str, Any]
    files: Mapping[str, Path]

    def __str__(self) -> str:
        from cfb_mjx.view.closed_loop import lead

        return "\n".join([lead(dict(self.numbers)), *lines_of(self.files)])


@command
class DemoLoop(Command):
    """Close the loop all the way, on an independent simulator: fly, diagnose, retrain, fly again.

    A policy trained on the declared model flies and logs a drone with an effect that the model lacks; close-loop names
    it and corrects the model; the policy is trained further on that and flies the same drone again, beside a policy
    trained with more randomisation. Writes loop.json, loop.png and index.html, and for every drone its logs, the report
    of close-loop, the corrected model and the policy. What is done is kept: started again, it goes on where it was.

    Attributes:
        output: folder to write to.
        effects: of the reference simulator, one drone each: payload, cog_offset, wind ...; by default payload.
        seeds: drones of each effect; every seed has policies of its own.
        seed: the first.
    """

    output: OutputFolder = Path("out/demo-loop")
    effects: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ("payload",)
    seeds: Annotated[int, Within(1)] = 1
    seed: Annotated[int, Within(0)] = 61_000

    def run(self) -> Improved:
        """Close the loop for every effect and seed; results, figure and page are written after each.

        Raises:
            CfbError: an unknown effect, or a folder with other results or that cannot be written.
        """
        from cfb_mjx.loop.cells import cells_of

        cells = cells_of(self.effects, self.seeds, self.seed)
        require_no_file(self.output)
        from cfb_mjx.runtime import configure_jax

        configure_jax(x64=False)
        from cfb_mjx.loop.study import study

        improved = None
        for numbers in study(cells, self.output):
            improved = Improved(numbers, self._write(numbers))
        return not_none(improved)

    def _write(self, numbers: dict[str, Any]) -> dict[str, Path]:
        from cfb_mjx.view import html_page
        from cfb_mjx.view.closed_loop import TITLE, lead, loop_figure, sections

        results, figure, page = (self.output / name for name in ("loop.json", "loop.png", "index.html"))
        facts = list(numbers["cells"].values())[-1]["trials"]["environment"]
        with together():
            write_json(results, numbers)
            loop_figure(numbers, figure)
            write_text(page, html_page(TITLE, lead(numbers), sections(numbers, figure), facts))
        return {"results": results, "page": page}
