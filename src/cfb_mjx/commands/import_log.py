"""``cfb import``: convert a flight log of any supported format to MCAP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from cfb_mjx.commands.command import Command, File, Logs, Pairs, Result, Spans, Written, command
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped, write_text

if TYPE_CHECKING:
    from cfb_mjx.logs import FlightLog
    from cfb_mjx.logs.gate import Verdict
    from cfb_mjx.logs.proposal import UnknownNames


@dataclass(frozen=True, kw_only=True)
class ReadingOptions(Command):
    """Options for reading logs whose content is not clear from the file alone.

    Attributes:
        mapping: YAML file that says which logged variable, column or field holds which quantity.
        topics_yaml: crazyflies.yaml with the variable names of the custom topics of a Crazyswarm2 bag.
        robot: name of the robot whose flight is read, for a Crazyswarm2 bag or a table with several robots.
        time_unit: unit of the time column of a radio csv: s, ms, us or ns. Default: found from the column.
        motion_capture: take pose and velocity from motion capture that was logged beside the estimate.
        keep_ground: keep the rows that were recorded on the ground or in the hand.
        cut: time spans to leave out, s of the recording: 12.5:15, :3 (all up to 3 s) or 40: (all from 40 s on).
        fix: change of unit, axes or order, by the name that an error message gives, for instance velocity-frame=body.
    """

    mapping: File = None
    topics_yaml: File = None
    robot: str | None = None
    time_unit: str | None = None
    motion_capture: bool = False
    keep_ground: bool = False
    cut: Spans = ()
    fix: Pairs = ()

    def reading(self) -> dict[str, Any]:
        """The options as keyword arguments of `cfb_mjx.logs.read_log`."""
        return {
            "mapping": self.mapping,
            "topics_yaml": self.topics_yaml,
            "robot": self.robot,
            "time_unit": self.time_unit,
            "motion_capture": self.motion_capture,
            "keep_ground": self.keep_ground,
            "cut": self.cut,
            "fix": self.fix,
        }


@dataclass(frozen=True)
class Imported(Result):
    """A flight that was converted.

    Attributes:
        log: the flight, as written.
        verdict: the agreement of its signals.
        output: path of the MCAP file.
    """

    log: FlightLog
    verdict: Verdict
    output: Path

    def __str__(self) -> str:
        from cfb_mjx.logs.alignment import describe_alignment
        from cfb_mjx.logs.uses import extent, remarks

        log = self.log
        cleaning = log.metadata.get("cleaning") or {}
        counted = [key for key in cleaning if key.startswith("dropped") or key in _COUNTED]
        return "\n  ".join(
            [
                f"{self.output}: {extent(log)}",
                f"rotor speed {'measured' if log.rotor_speed is not None else 'not measured'}; {_battery(log)}",
                *(f"{key.replace('_', ' ')}: {cleaning[key]}" for key in counted if cleaning[key]),
                self.verdict.summary(),
                describe_alignment(log.metadata["alignment"]),
                *remarks(log),
            ]
        )


_COUNTED = ("held_rows_kept", "invalid_rotor_speeds")
_LOGGING = {"sd": "config.txt", "radio": "radio.json"}


@command
class Import(ReadingOptions):
    """Convert a flight log to MCAP.

    Checks units, frames and time stamps, and prints what was changed. A log whose signals contradict each other is
    refused; the error says which option corrects it.

    Attributes:
        sources: flight log to read, in one of the formats listed in docs/logs.md.
            Supported are parquet, csv, MCAP (also of other programs), micro SD card binaries of the Crazyflie,
            ROS bags (file or folder), radio csv, .npz, .mat, and ULog of PX4.
            Several tables, such as cfclient writes for each log block, are read as one flight.
        output: MCAP file to write. Required, except with --print-config.
        format: format of the source; auto finds it from the content.
        motor_shift: time by which the motor columns of an IDSIA log are delayed, s; 0 leaves them as recorded.
            Default: the shift is estimated.
        print_config: print what to log, and read nothing.
            sd: the config.txt of the micro SD card deck; radio: the log blocks for cfclient.
    """

    sources: Logs = ()
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None
    format: Literal["auto", "tabular", "idsia", "mcap", "usd_card", "crazyswarm", "radio_csv", "ulog", "foxglove"] = (
        "auto"
    )
    motor_shift: float | None = None
    print_config: Literal["sd", "radio"] | None = None

    def run(self) -> Imported | Written:
        """Convert the log, or return what to log if that was asked for.

        Raises:
            CfbError: as `cfb_mjx.logs.read_log`; or the output does not end in .mcap, or is the source itself.
        """
        if self.print_config is not None:
            text = shipped("configs", "logs", _LOGGING[self.print_config]).read_text(encoding="utf-8")
            return Written(text.removesuffix("\n"))
        if not self.sources or self.output is None:
            raise CfbError("import needs a log and -o FILE.mcap; see 'cfb import --help'.")
        _require_output(self.output, self.sources)
        from cfb_mjx.logs import estimate_command_shift, write_mcap
        from cfb_mjx.logs.proposal import UnknownNames
        from cfb_mjx.logs.reading import read_judged

        format = None if self.format == "auto" else self.format
        try:
            log, verdict = read_judged(self.sources, format, motor_shift=self.motor_shift, **self.reading())
        except UnknownNames as error:
            raise _proposed(error, self.output.with_suffix(".mapping.yaml")) from None
        if log.metadata.get("alignment") is None:
            log = log.replace(metadata={"alignment": {**estimate_command_shift(log).report(), "applied": False}})
        write_mcap(log, self.output)
        return Imported(log, verdict, self.output)


def _require_output(output: Path, sources: tuple[Path, ...]) -> None:
    if output.suffix != ".mcap":
        raise CfbError(f"{output}: the output must end in .mcap.")
    if output.exists() and any(source.exists() and output.samefile(source) for source in sources):
        raise CfbError(f"{output}: the output is the source itself; choose another name.")


def _proposed(error: UnknownNames, mapping: Path) -> CfbError:
    """Write the proposed mapping of a table with unknown column names, and return the error that names the file."""
    write_text(mapping, error.mapping)
    said = str(error).partition("; cfb import")[0]
    return CfbError(f"{said}; a mapping was written to {mapping}: check it, then add --mapping {mapping}.")


def _battery(log: FlightLog) -> str:
    import numpy as np

    voltage = log.battery_voltage
    if voltage is None:
        return "no battery voltage"
    return f"battery {np.nanmin(voltage):.2f} to {np.nanmax(voltage):.2f} V"
