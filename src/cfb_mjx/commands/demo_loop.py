"""``cfb demo-loop``: the whole cycle in simulation: fly, correct the model, retrain, fly again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from cfb_mjx.commands.command import Command, OutputFolder, Result, Within, command, lines_of
from cfb_mjx.files import VectorFormat, require_no_file, together, write_json, write_text
from cfb_mjx.optional import not_none


@dataclass(frozen=True)
class Improved(Result):
    """How well drones fly before and after the correction of the model.

    Attributes:
        numbers: the results as in loop.json, for instance
            ``numbers["cells"]["payload-61000"]["trials"]["corrected"]``.
        files: paths of the files written, by kind.
    """

    numbers: Mapping[str, Any]
    files: Mapping[str, Path]

    def __str__(self) -> str:
        from cfb_mjx.loop.page import lead

        return "\n".join([lead(dict(self.numbers)), *lines_of(self.files)])


@command
class DemoLoop(Command):
    """Run the whole cycle on an independent simulator: fly, correct the model, retrain, fly again.

    A policy trained on the uncorrected model flies a drone that has an effect which the model lacks, and logs the
    flights. `cfb close-loop` finds the effect in the logs and corrects the model. The policy is trained further on the
    corrected model and flies the same drone again, beside a policy that was trained with more randomisation instead.

    Writes loop.json, loop.png and index.html, and for every drone its logs, the report of close-loop, the corrected
    model and the policy. If the run was interrupted, the same command continues it.

    Attributes:
        output: folder to write to.
        effects: effects of the reference simulator, for instance payload cog_offset wind; one drone for each.
            Default: payload.
        seeds: number of drones with each effect; for every seed separate policies are trained.
        seed: seed of the first drone.
        format: also write every figure as a vector graphic, pdf or svg. Default: PNG only.
    """

    output: OutputFolder = Path("out/demo-loop")
    effects: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ("payload",)
    seeds: Annotated[int, Within(1)] = 1
    seed: Annotated[int, Within(0)] = 61_000
    format: VectorFormat | None = None

    def run(self) -> Improved:
        """Run the cycle for every effect and seed; the results, the figure and the page are updated after each.

        Raises:
            CfbError: an unknown effect, a folder with results of other settings, or a folder that cannot be written.
        """
        from cfb_mjx.loop.steps import cells_of

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
        from cfb_mjx.loop.page import TITLE, lead, loop_figure, sections
        from cfb_mjx.view import html_page
        from cfb_mjx.view.style import with_vector_copies

        results, figure, page = (self.output / name for name in ("loop.json", "loop.png", "index.html"))
        facts = list(numbers["cells"].values())[-1]["trials"]["environment"]
        with together(), with_vector_copies(self.format):
            write_json(results, numbers)
            loop_figure(numbers, figure)
            write_text(page, html_page(TITLE, lead(numbers), sections(numbers, figure), facts))
        return {"results": results, "page": page}
