"""``cfb view``: show flights in rerun or as a video."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cfb_mjx.commands.command import Command, File, Logs, Model, Pairs, Result, command, lines_of
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder
from cfb_mjx.optional import not_none


@dataclass(frozen=True)
class Viewed(Result):
    """The files that show the flights.

    Attributes:
        recording: path of the recording, if one was written.
        shown: whether rerun's viewer was opened.
        video: path of the video, if one was written.
    """

    recording: Path | None = None
    shown: bool = False
    video: Path | None = None

    def __str__(self) -> str:
        shown = ["shown in rerun's viewer"] if self.shown else []
        return "\n".join([*lines_of({"recording": self.recording}), *shown, *lines_of({"video": self.video})])


@command
class View(Command):
    """Show flights: write a recording for rerun, open rerun's viewer, or make a video.

    A recording shows the drone in 3D with the thrust of its rotors, the measured trajectory, the predictions of the
    model over half a second, the commands, and the residuals of the model (force per mass and torque per inertia).
    Flight logs of `cfb fly --log` can be shown too.

    Attributes:
        logs: flight logs (MCAP, parquet, csv), or one recording (.rrd) with --spawn.
        output: recording to write (.rrd).
            Default: the name of the first log, in the current folder.
            With --spawn the default is a temporary file, with --video alone no file.
        model: preset or model YAML, for thrust, predictions and residuals.
        set: changes to the model's parameters, for instance mass=0.045 (kg).
        spawn: open rerun's viewer.
        video: file for a video of the first flight (.mp4 or .gif).
        slow: factor by which the video is slower than the flight, above 0.
    """

    logs: Logs
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    model: Model = "cfb-guards"
    set: Pairs = ()
    spawn: bool = False
    video: File = None
    slow: float = 1.0

    def run(self) -> Viewed:
        """Read the flights, compute predictions and residuals of the model, and show them.

        Raises:
            CfbError: bad logs, an invalid model, a program that is not installed, or a file that cannot be written.
        """
        output = self._checked_output()
        if self._opens_recording:
            from cfb_mjx.view.recorder import open_viewer

            open_viewer(self.logs[0])
            return Viewed(shown=True)
        from cfb_mjx.logs import read_log
        from cfb_mjx.runtime import Progress, configure_jax

        logs = [read_log(path) for path in self.logs]  # before jax loads, so that a bad log is refused at once
        configure_jax(x64=True)
        from cfb_mjx.model import Quadrotor
        from cfb_mjx.parameters import load_model_file
        from cfb_mjx.sysid import evaluate
        from cfb_mjx.sysid.sensor_faults import SensorFaults
        from cfb_mjx.sysid.tracing.residuals import model_residuals
        from cfb_mjx.view.log_recording import write_log_film, write_log_recording
        from cfb_mjx.view.recorder import open_viewer

        described = load_model_file(self.model, self.set)
        drone = Quadrotor.from_file(described)
        faults = SensorFaults.from_mappings(described.effects, self.model)
        bar, residuals = Progress("residuals"), []
        for log in logs:
            residuals.append(model_residuals(drone, faults.repaired(log)))
            bar(len(residuals), len(logs))
        if output is None and self.spawn:
            output = Path(tempfile.gettempdir()) / f"{logs[0].name}.rrd"
        if output is not None:
            evaluation = evaluate(drone, logs, progress=Progress("predictions"), faults=faults)
            write_log_recording(output, drone, evaluation, residuals)
        if self.spawn:
            open_viewer(not_none(output))
        if self.video is not None:
            write_log_film(self.video, drone, logs[0], residuals[0][1], self.slow)
        return Viewed(output, self.spawn, self.video)

    @property
    def _opens_recording(self) -> bool:
        return any(path.suffix == ".rrd" for path in self.logs)

    def _checked_output(self) -> Path | None:
        """Check the arguments; return the recording to write, or None if no name for it is known yet.

        Raises:
            CfbError: no logs, a number outside its range, or an output in a missing folder or with the wrong ending.
        """
        if not self.logs:
            raise CfbError("view needs at least one log; see 'cfb view --help'.")
        output = self.output
        if output is None and not self.spawn and self.video is None and not self._opens_recording:
            output = Path(f"{self.logs[0].stem}.rrd")
        if self.slow <= 0:
            raise CfbError(f"--slow {self.slow}: must be above zero.")
        require_folder(output, self.video)
        if self._opens_recording and (not self.spawn or output or self.video or len(self.logs) > 1):
            raise CfbError(f"{self.logs[0]}: is a recording already; open one with 'cfb view FILE.rrd --spawn'.")
        if self.video is not None:
            from cfb_mjx.view.film import check_film

            check_film(self.video)
        return output
