"""``cfb reproduce``: reproduce the figures and tables of the paper."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cfb_mjx.commands.command import Command, OutputFolder, Result, command
from cfb_mjx.errors import CfbError
from cfb_mjx.files import VectorFormat, code_identity, output_folder, together

if TYPE_CHECKING:
    from cfb_mjx import reproduce

ALL = "all"
_KINDS = {"result": "", "input": "   [input]", "own": "   [own flight]"}


@dataclass(frozen=True)
class Reproduced(Result):
    """The numbers of the paper beside ours.

    Attributes:
        results: the results by the name of the item; ``results["motor-step"].rows`` hold the paper's numbers and ours.
        environment: date, machine and versions.
        seconds: how long it took, s.
        page: path of the page, to open in a browser.
        files: paths of the rows as Markdown and as JSON.
    """

    results: Mapping[str, reproduce.Result]
    environment: Mapping[str, str]
    seconds: float
    page: Path
    files: tuple[Path, ...]

    def __str__(self) -> str:
        lines = []
        for name, result in self.results.items():
            lines.append(f"\n{result.title} ({name})")
            for row in result.rows:
                paper = f"   paper {row.paper}" if row.paper else ""
                lines.append(f"  {row.what}: {row.ours}{paper}{_KINDS[row.kind]}")
        lines.append(f"\ndone in {self.seconds:.0f} s. Open {self.page}")
        return "\n".join([*lines, f"numbers: {', '.join(map(str, self.files))}"])


@command
class Reproduce(Command):
    """Reproduce the figures and tables of the paper, with its numbers beside ours.

    The items are parameters, motor-step, rotor-curves, hover-to-forward, yaw-disturbance, brushed, back-and-forth,
    controllers, randomisation, flips and double-flip. All of them together take minutes.

    For each item it writes a figure (PNG), the numbers behind it (CSV), and rows with the paper's number, ours, and the
    reason for the difference. index.html shows everything; paper.md and paper.json have the rows. Rows that only repeat
    a constant of the paper, or in which the model predicts its own simulated flights, are marked. The files are updated
    after each item. If the run was interrupted, the same command continues it.

    Attributes:
        names: items to reproduce. Default: all.
        output: folder to write to.
        real: folder with real flights in the IDSIA layout (fit/*.parquet, validation/*.parquet).
            They are shown beside the shipped flights.
        flights: folder with flight logs of your drone.
            brushed needs flights of a brushed Crazyflie, hover-to-forward and yaw-disturbance those of a brushless one.
            For the latter two the useful prediction horizon is then measured on these flights.
        mass: weighed mass of the drone of --flights, kg, from 0.005 to 0.5. Default: the mass of the preset.
        format: also write every figure as a vector graphic, pdf or svg. Default: PNG only.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="NAME...")] = (ALL,)
    output: OutputFolder = Path("out/paper")
    real: Path | None = None
    flights: Path | None = None
    mass: float | None = None
    format: VectorFormat | None = None

    def run(self) -> Reproduced:
        """Reproduce the items one after another, and update the pages after each.

        Raises:
            CfbError: an unknown name, no flights in ``real`` or ``flights``, flights that no item uses, an invalid
                mass, or a file that cannot be written.
        """
        from cfb_mjx.runtime import configure_jax, environment, say

        configure_jax(x64=False)
        from cfb_mjx.reproduce import ITEMS
        from cfb_mjx.reproduce.flights import Given, require_real
        from cfb_mjx.reproduce.item import NUMBERS, PAGE, TEXT, keep, kept_in
        from cfb_mjx.view.style import with_vector_copies

        chosen = self._chosen(ITEMS)
        self._require_fitting(chosen, ITEMS)
        require_real(self.real)
        given = None if self.flights is None else Given.read(self.flights, self.mass)
        folder, facts = output_folder(self.output), environment()
        told = f"cfb reproduce {ALL if len(chosen) == len(ITEMS) else ' '.join(chosen)}"
        real, flights = str(self.real), str(self.flights)
        of = {
            "names": chosen,
            "code": code_identity(),
            "real": real,
            "flights": flights,
            "mass": self.mass,
            "format": self.format,
        }
        results = kept_in(folder, of)
        if results:
            say(f"{len(results)} of {len(chosen)} items were made before the interruption; continuing with the rest")
        begin = time.perf_counter()
        for name in [name for name in chosen if name not in results]:
            started = time.perf_counter()
            configure_jax(x64=ITEMS[name].x64)
            more = {"given": given} if ITEMS[name].given else {}
            with together(), with_vector_copies(self.format):
                results[name] = ITEMS[name].make(folder, self.real, **more)
                results = {item: results[item] for item in chosen if item in results}
                keep(folder, results, of, facts, told)
            say(f"{len(results)}/{len(chosen)} {name}: {time.perf_counter() - started:.0f} s")
        files = (folder / TEXT, folder / NUMBERS)
        return Reproduced(results, facts, time.perf_counter() - begin, folder / PAGE, files)

    def _chosen(self, items: Mapping[str, Any]) -> list[str]:
        """Names of the items that were asked for, in the order of the paper.

        Raises:
            CfbError: an unknown name, or none.
        """
        unknown = [name for name in self.names if name not in (*items, ALL)]
        if unknown or not self.names:
            raise CfbError(
                f"{', '.join(unknown) or 'nothing'}: cannot be reproduced; choose from {ALL}, {', '.join(items)}."
            )
        return [name for name in items if ALL in self.names or name in self.names]

    def _require_fitting(self, chosen: list[str], items: Mapping[str, reproduce.Item]) -> None:
        """Check that the flights that were given can be used for the items that were asked for."""
        if self.flights is None:
            if self.mass is not None:
                raise CfbError("--mass is the mass of the drone of --flights; give --flights too, or leave --mass out.")
            return
        if self.mass is not None and not 0.005 <= self.mass <= 0.5:
            raise CfbError(f"--mass {self.mass:g}: must be in kg, from 0.005 to 0.5.")
        takers = {name for name, item in items.items() if item.given}
        if not set(chosen) <= takers or ("brushed" in chosen and len(chosen) > 1):
            raise CfbError(
                f"--flights: name the items that use them, of {', '.join(sorted(takers))}; name brushed alone, because "
                "it needs flights of a brushed drone and the others need those of a brushless one."
            )
