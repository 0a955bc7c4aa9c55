"""Film a flight with MuJoCo: the drone above the floor, its path, and the thrust of each rotor.

Rendering is off-screen, with EGL or OSMesa, whichever is available.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import replacing, require_ending, shipped

SUFFIXES = (".mp4", ".gif")
SIZE, RATE = (640, 480), 25.0
"""Width and height of the frames in pixels, and frames per second."""
_WAY_POINTS = 400
_BACKENDS = ("egl", "osmesa")
_SKY = '<asset><texture type="skybox" builtin="flat" rgb1=".86 .91 .96" width="32" height="192"/>'


class Path3D(NamedTuple):
    """A flight to be filmed."""

    time: np.ndarray
    """(n,) s."""
    position: np.ndarray
    """(n, 3) m, world, the floor at z = 0."""
    quaternion: np.ndarray
    """(n, 4), body to world."""
    thrust: np.ndarray
    """(n, 4) N."""


def check_film(path: str | Path) -> Path:
    """The path, if its ending is a supported format of films.

    Raises:
        CfbError: the ending is not supported.
    """
    return require_ending(path, SUFFIXES, f"a film must end in {' or '.join(SUFFIXES)}")


def write_film(
    path: str | Path,
    flight: Path3D,
    size: tuple[int, int] = SIZE,
    rate: float = RATE,
    speed: float = 1.0,
    azimuth_deg: float = 180.0,
) -> None:
    """Film a flight.

    Args:
        path: file to write, ``.mp4`` or ``.gif``.
        flight: the flight; each frame shows the first row at or after its time.
        size: width and height, pixels; even numbers.
        rate: frames per second.
        speed: playback speed; 0.25 is slow motion.
        azimuth_deg: viewing direction of the camera, from x towards y. At 180 it looks along -x, y points to the right,
            and flips about x are seen face on.

    Raises:
        CfbError: there is no OpenGL for off-screen rendering, no ffmpeg for ``.mp4``, the ending is not supported, or
            the file cannot be written.
    """
    path = check_film(path)
    if len(flight.time) < 2:
        raise CfbError(f"{path}: there is nothing to film; the flight has fewer than two rows.")
    encoder = _ffmpeg(path) if path.suffix.lower() == ".mp4" else None
    pictures = _pictures(path, flight, size, rate / speed, azimuth_deg)
    with replacing(path) as temporary:
        if encoder is None:
            _write_gif(temporary, pictures, rate)
        else:
            _write_mp4(encoder, temporary, pictures, size, rate)


def _pictures(path: Path, flight: Path3D, size, rate: float, azimuth_deg: float) -> np.ndarray:
    """Frames (n, height, width, 3), rendered in a separate process with the first OpenGL backend that works."""
    with tempfile.TemporaryDirectory(prefix="cfb-film-") as folder:
        job = Path(folder) / "job.npz"
        np.savez(job, **_job(flight, size, rate, azimuth_deg))
        command, said = [sys.executable, "-m", "cfb_mjx.view.render", str(job)], ""
        wanted = os.environ.get("MUJOCO_GL")
        for backend in (wanted,) if wanted else _BACKENDS:
            environment = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
            done = subprocess.run(command, capture_output=True, env=environment)
            if done.returncode == 0:
                break
            said = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or [""]
        else:
            raise CfbError(
                f"{path}: MuJoCo finds no OpenGL to draw with ({said[0][:120]}); install EGL or OSMesa "
                "(Debian: apt install libegl1 libgl1-mesa-dri, or libosmesa6)."
            )
    width, height = size
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


def _job(flight: Path3D, size, rate: float, azimuth_deg: float) -> dict[str, Any]:
    """Input of `render`: frames, camera and path."""
    duration = flight.time[-1] - flight.time[0]
    times = flight.time[0] + np.arange(int(duration * rate) + 1) / rate
    rows = np.searchsorted(flight.time, times).clip(0, len(flight.time) - 1)
    stride = max(1, len(flight.time) // _WAY_POINTS)
    low, high = flight.position.min(axis=0), flight.position.max(axis=0)
    # The camera is far enough to show the whole path, unless the drone would become too small.
    reach = float(np.clip(np.linalg.norm(high - low), 0.5, 3.0))
    middle = 0.5 * (low + high)
    near = np.linalg.norm(flight.position[rows] - middle, axis=1) < 1.2 * reach
    look_at = np.where(near[:, None], middle, flight.position[rows])
    return {
        "xml": np.array(shipped("assets", "cfb.xml").read_text(encoding="utf-8").replace("<asset>", _SKY, 1)),
        "size": np.array(size),
        "camera": np.array([azimuth_deg, -8.0, 1.1 * reach + 0.35]),
        "position": flight.position[rows],
        "quaternion": flight.quaternion[rows],
        "thrust": np.nan_to_num(flight.thrust[rows]),
        "look_at": look_at,
        "way": flight.position[::stride],
        "passed": rows // stride,
    }


def _ffmpeg(path: Path) -> str:
    """Path of the encoder: the system's ffmpeg, or the one of imageio-ffmpeg."""
    if found := shutil.which("ffmpeg"):
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError:
        raise CfbError(f"{path}: .mp4 needs ffmpeg; run 'pip install imageio-ffmpeg', or write a .gif.") from None
    return get_ffmpeg_exe()


def _write_mp4(encoder: str, path: Path, pictures: np.ndarray, size, rate: float) -> None:
    command = [encoder, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{size[0]}x{size[1]}", "-r", f"{rate:g}", "-i", "-", "-c:v", "libx264", "-pix_fmt", "yuv420p"]
    command += ["-crf", "23", "-movflags", "+faststart", "-f", "mp4", str(path)]
    done = subprocess.run(command, input=pictures.tobytes(), capture_output=True)
    if done.returncode:
        raise CfbError(f"{path}: ffmpeg failed ({done.stderr.decode(errors='replace').strip()[:200]}).")


def _write_gif(path: Path, pictures: np.ndarray, rate: float) -> None:
    from PIL import Image

    # Most of a frame is sky and floor; this method also keeps the colours of small objects.
    method, plain = Image.Quantize.MAXCOVERAGE, Image.Dither.NONE
    images = [Image.fromarray(p).quantize(64, method=method, dither=plain) for p in pictures]
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=round(1e3 / rate), loop=0)
