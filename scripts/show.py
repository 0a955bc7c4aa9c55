"""Make the images of docs/viewing.md: an animation of the double flip, and Rerun's viewer with a recording.

python scripts/show.py

Takes a minute. The image of the viewer needs a display. Without one, put `xvfb-run -s '-screen 0 4000x3000x24'` before
the command; the screen is large so that the pointer is outside the image.
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
    """Write the animation and the image of the viewer."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        log, recording, shot = (Path(name) / f for f in ("double-flip.mcap", "double-flip.rrd", "shot.png"))
        assert cfb(["fly", "double-flip", "--log", str(log)]) == 0
        _film(log, FOLDER / "double-flip.gif")
        # A model with a tenth too much thrust, so that the recording shows a difference.
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
