"""``cfb view``."""

from __future__ import annotations

import tempfile
from pathlib import Path

from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder
from cfb_mjx.logs import read_log
from cfb_mjx.runtime import Progress, configure_jax


def run_view(
    paths: list[Path], output: Path | None, model: str, changes: list[str], spawn: bool, video: Path | None, slow: float
) -> None:
    """Read the flights, look at them with the model, show them.

    Raises:
        CfbError: bad logs, a bad model, nothing asked for, something missing that is needed, or a file that cannot be
            written.
    """
    if not paths:
        raise CfbError("view needs at least one log; see 'cfb view --help'.")
    if output is None and not spawn and video is None and paths[0].suffix != ".rrd":
        output = Path(f"{paths[0].stem}.rrd")
    if slow <= 0:
        raise CfbError(f"--slow {slow}: must be above zero.")
    require_folder(output, video)
    if any(path.suffix == ".rrd" for path in paths):
        if not spawn or output is not None or video is not None or len(paths) > 1:
            raise CfbError(f"{paths[0]}: is a recording already; open one with 'cfb view FILE.rrd --spawn'.")
        _open(paths[0])
        return
    from cfb_mjx.view.film import Path3D, check_film, write_film

    if video is not None:
        check_film(video)
    logs = [read_log(path) for path in paths]
    configure_jax(x64=True)
    import jax.numpy as jnp
    import numpy as np

    from cfb_mjx.model import Quadrotor, rotors
    from cfb_mjx.parameters import load_model_file
    from cfb_mjx.sysid import evaluate
    from cfb_mjx.sysid.sensor_faults import SensorFaults
    from cfb_mjx.sysid.tracing.residuals import model_residuals

    described = load_model_file(model, changes)
    drone = Quadrotor.from_file(described)
    faults = SensorFaults.from_mappings(described.effects, model)
    bar = Progress("residuals")
    residuals = []
    for log in logs:
        residuals.append(model_residuals(drone, faults.repaired(log)))
        bar(len(residuals), len(logs))
    if output is not None or spawn:
        from cfb_mjx.view.log_recording import write_log_recording

        evaluation = evaluate(drone, logs, progress=Progress("predictions"), faults=faults)
        path = output or Path(tempfile.gettempdir()) / f"{logs[0].name}.rrd"
        write_log_recording(path, drone, evaluation, residuals)
        print(f"recording: {path}")
        if spawn:
            _open(path)
    if video is not None:
        log, driven = logs[0], residuals[0][1]
        thrust = np.asarray(rotors.thrust(drone.changed_parameters(), jnp.asarray(driven)))
        # Where the log's zero is not the floor, the floor is below all of the flight.
        lift = np.array([0.0, 0.0, max(0.0, 0.1 - float(log.position[:, 2].min()))])
        write_film(video, Path3D(log.time, log.position + lift, log.quaternion, thrust), speed=1 / slow)
        print(f"video: {video}")


def _open(path: Path) -> None:
    from cfb_mjx.view.recorder import open_viewer

    open_viewer(path)
    print("shown in rerun's viewer")
