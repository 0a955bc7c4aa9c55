"""What ``cfb sweep`` takes; see `cfb_mjx.cli.commands`."""

from __future__ import annotations

from typing import Annotated

import tyro

from cfb_mjx.cli.argument_types import Output


def sweep(
    config: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG")],
    output: Output,
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None,
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    retries: int = 3,
    part: Annotated[str | None, tyro.conf.arg(metavar="I/N")] = None,
    dry_run: bool = False,
) -> None:
    """Run a command many times over: seeds, randomisation, refits of many drones; on this machine or a cluster.

    Every task lands in DIR/done/NAME, once and whole; results.csv has a row for each, and grows as they land. A worker
    that dies is replaced; a task with bad input is noted in DIR/failed and does not hold the others up. Started again,
    it goes on where it was: what is done is kept, what failed is tried again. Needs Ray: pip install 'cfb_mjx[sweep]'.

    Args:
        config: sweep YAML, or the name of a shipped one (firmware-pid, randomisation, refits).
        output: folder for the results.
        address: of a Ray cluster to use (auto: the one this machine belongs to), in place of this machine alone; all
            its machines must see the folder.
        workers: most tasks at a time; by default as many as there is room for.
        retries: more attempts at a task whose worker dies, or that breaks.
        part: only every N-th task from the I-th on, for N jobs that share the folder and need no cluster.
        dry_run: list the tasks with their command lines, and do nothing.
    """
    from cfb_mjx.cli.sweeping import run_sweep

    run_sweep(config, output, address, workers, retries, part, dry_run)
