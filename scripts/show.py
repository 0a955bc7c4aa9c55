"""Make the pictures of docs/viewing.md: a film of the double flip and rerun's viewer on a recording.

python scripts/show.py             (a minute; the viewer's picture needs a display, or before the command
                               xvfb-run -s '-screen 0 4000x3000x24', large so that no pointer is over it)
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from campaign import ROOT

from cfb_mjx.cli import main as cfb

FOLDER = ROOT / "docs" / "viewing"


def main() -> None:
    """Film, then take the picture."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        log, recording, shot = (Path(name) / f for f in ("double-flip.mcap", "double-flip.rrd", "shot.png"))
        assert cfb(["fly", "double-flip", "--log", str(log)]) == 0
        _film(log, FOLDER / "double-flip.gif")
        # Rotors that give a tenth less than the model thinks: something to see.
        assert cfb(["view", str(log), "-o", str(recording), "--set", "thrust_scale=1.1,1.1,1.1,1.1"]) == 0
        command = [sys.executable, "-m", "rerun", str(recording), "--screenshot-to", str(shot)]
        subprocess.run([*command, "--window-size", "1400x800"], check=True)
        _shrink(shot, FOLDER / "recording.png")


def _film(log: Path, path: Path) -> None:
    import jax.numpy as jnp
    import numpy as np

    from cfb_mjx.logs import read_log
    from cfb_mjx.model import Quadrotor, rotors
    from cfb_mjx.train.flips import FLOOR_M
    from cfb_mjx.view.film import Path3D, write_film

    flight = read_log(log)
    rows = flight.time < 2.4
    parameters = Quadrotor.from_file("cfb-guards").parameters
    thrust = np.asarray(rotors.thrust(parameters, jnp.asarray(flight.rotor_speed)))
    above = flight.position + np.array([0.0, 0.0, FLOOR_M])
    shown = Path3D(flight.time[rows], above[rows], flight.quaternion[rows], thrust[rows])
    write_film(path, shown, size=(480, 360), rate=20, speed=0.5)


def _shrink(found: Path, path: Path) -> None:
    from PIL import Image

    with Image.open(found) as picture:
        small = picture.convert("RGB").resize((1400, 800), Image.Resampling.LANCZOS)
        small.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main()
