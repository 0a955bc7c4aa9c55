"""What ``cfb import`` and ``cfb check`` take; see `cfb_mjx.cli.commands`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from cfb_mjx.cli.argument_types import File, Pairs, Spans, flat
from cfb_mjx.errors import CfbError


def import_log(
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG...")] = (),
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None,
    format: Literal[
        "auto", "tabular", "idsia", "mcap", "usd_card", "crazyswarm", "radio_csv", "ulog", "foxglove"
    ] = "auto",
    motor_shift: float | None = None,
    mapping: File = None,
    topics_yaml: File = None,
    robot: str | None = None,
    time_unit: str | None = None,
    motion_capture: bool = False,
    keep_ground: bool = False,
    cut: Spans = (),
    fix: Pairs = (),
    print_config: Literal["sd", "radio"] | None = None,
) -> None:
    """Convert a flight log to MCAP.

    Checks units, frames and time stamps on the way, and says what it changed.

    Args:
        sources: log to read: parquet, csv, MCAP, Crazyflie micro SD card binary, ROS bag or its folder, radio csv,
            .npz, .mat, PX4's ULog, an MCAP of others; several tables, as cfclient writes one per log block, are one
            flight.
        output: MCAP file to write.
        format: layout of the source; auto looks at its content.
        motor_shift: s by which to delay the motor columns of an IDSIA log instead of the estimated shift.
        mapping: YAML saying which logged variable, column or field is what.
        topics_yaml: crazyflies.yaml with the variable names of the custom topics of a Crazyswarm2 bag.
        robot: whose flight to read from a Crazyswarm2 bag or a table of several.
        time_unit: unit of the time column of a radio csv: s, ms, us or ns.
        motion_capture: take pose and velocity from motion capture that was logged beside the estimate.
        keep_ground: leave in what was recorded on the ground and in the hand.
        cut: seconds of the recording to leave out, for instance 12.5:15, :3 (all up to 3 s) or 40: (all from then on).
        fix: a change of unit, axes or order, as a refusal names it, for instance velocity-frame=body.
        print_config: print what to log, and read nothing: the config.txt of the micro SD card deck, or the log
            blocks of the radio for cfclient.
    """
    from cfb_mjx.cli.importing import print_logging, run_import

    if print_config is not None:
        print_logging(print_config)
        return
    if not sources or output is None:
        raise CfbError("import needs a log and -o FILE.mcap; see 'cfb import --help'.")
    options = {"motor_shift": motor_shift, "mapping": mapping, "topics_yaml": topics_yaml, "robot": robot}
    options |= {"time_unit": time_unit, "keep_ground": keep_ground, "cut": flat(cut), "fix": flat(fix)}
    options |= {"motion_capture": motion_capture}
    run_import(list(sources), output, None if format == "auto" else format, options)


def check(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG...")],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = None,
    json: File = None,
    mapping: File = None,
    topics_yaml: File = None,
    robot: str | None = None,
    time_unit: str | None = None,
    motion_capture: bool = False,
    keep_ground: bool = False,
    cut: Spans = (),
    fix: Pairs = (),
) -> None:
    """Say what recordings hold, whether their signals agree, what they are good for and what to log next time.

    Every recording is read as by import, by itself; one that is refused stops none of the others.

    Args:
        logs: recordings of any format.
        output: folder for a page with figures (index.html).
        json: write the results here.
        mapping: as for import.
        topics_yaml: as for import.
        robot: as for import.
        time_unit: as for import.
        motion_capture: as for import.
        keep_ground: as for import.
        cut: as for import.
        fix: as for import.
    """
    if not logs:
        raise CfbError("check needs at least one log; see 'cfb check --help'.")
    from cfb_mjx.cli.checking import run_check

    options = {"mapping": mapping, "topics_yaml": topics_yaml, "robot": robot, "time_unit": time_unit}
    options |= {"keep_ground": keep_ground, "cut": flat(cut), "fix": flat(fix)}
    options |= {"motion_capture": motion_capture}
    if refused := run_check(list(logs), output, json, options):
        raise CfbError(f"{refused} of {len(logs)} recordings were refused, for the reasons above.")
