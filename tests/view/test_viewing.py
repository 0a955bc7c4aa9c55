"""`cfb view`, recordings of flights and films: they open again, and show what was flown."""

import os
import shutil
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfb_mjx.cli import main
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.logs import read_log
from cfb_mjx.model import Quadrotor, rotors
from cfb_mjx.sysid.tracing.residuals import model_residuals
from cfb_mjx.view import film, recorder
from tests.rerun_command import rerun

LOG = shipped("data", "flight_logs", "yaw.mcap")


def test_a_log_becomes_a_recording_with_thrust_predictions_and_residuals(tmp_path, monkeypatch, capfd):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    monkeypatch.chdir(tmp_path)
    assert main(["view", str(LOG)]) == 0
    assert "recording: yaw.rrd" in capfd.readouterr().out
    found = rerun("rrd", "stats", tmp_path / "yaw.rrd", home=tmp_path)
    for entity in (
        "world/drone",
        "world/drone/thrust",
        "world/measured_path",
        "world/prediction",
        "signal/command/M1",
        "signal/rotor_speed/M4",
        "signal/body_rate/z",
        "signal/battery",
        "residual/force_x/missed",
        "residual/torque_z/missed",
    ):
        assert f"/yaw/{entity}: " in found, entity


def test_the_flight_of_a_controller_is_recorded_and_logged(tmp_path, capfd):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    outputs = ["--recording", str(tmp_path / "step.rrd"), "--log", str(tmp_path / "step.mcap")]
    assert main(["fly", "target", "--task", "step", "--plants", "2", *outputs]) == 0
    found = rerun("rrd", "stats", tmp_path / "step.rrd", home=tmp_path)
    for entity in ("world/0/drone/thrust", "world/1/drone", "world/set-point", "signal/command/M2"):
        assert f"/{entity}: " in found, entity
    assert "/world/1/drone/thrust" not in found
    log = read_log(tmp_path / "step.mcap")
    assert log.observation_delay == 0.0
    assert len(log) == 499
    # From six metres off to the target at the origin.
    assert log.position[0, 0] == pytest.approx(-6.0, abs=0.01)
    assert np.linalg.norm(log.position[-1]) < 0.1
    # The accelerometer feels what the rotors push: their thrust over the mass, along the body's z axis.
    model = Quadrotor.from_file("cfb-guards")
    felt = np.asarray(rotors.thrust(model.parameters, jnp.asarray(log.rotor_speed))).sum(axis=1) / float(
        model.parameters.mass
    )
    np.testing.assert_allclose(log.specific_force[:, 2], felt, atol=1.2)
    assert abs(np.median(log.specific_force[:, 2] - felt)) < 0.1
    # The model that flew it misses nothing: less than a hundredth of gravity, but for noise.
    missed, _ = model_residuals(model, log)
    assert np.abs(np.nanmedian(missed.specific_force[missed.valid], axis=0)).max() < 0.1
    capfd.readouterr()


needs_gl = pytest.mark.skipif(
    not any(
        subprocess.run(
            [sys.executable, "-c", "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8)"],
            env=os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
            capture_output=True,
            check=False,
        ).returncode
        == 0
        for backend in ("egl", "osmesa")
    ),
    reason="this machine has no OpenGL that draws off-screen (EGL or OSMesa)",
)


def rolling(seconds=0.4) -> film.Path3D:
    """A quarter turn about x in place, 1 m above the floor."""
    time = np.arange(0, seconds + 1e-9, 0.01)
    angle = np.pi / 2 * time / seconds
    quaternion = Rotation.from_rotvec(angle[:, None] * [1.0, 0, 0]).as_quat()[:, [3, 0, 1, 2]]
    position = np.array([0.0, 0.0, 1.0]) + time[:, None] * [0, 0.5, 0.1]
    return film.Path3D(time, position, quaternion, np.full((len(time), 4), 0.1))


@needs_gl
def test_a_film_shows_the_drone_turning(tmp_path):
    from PIL import Image

    film.write_film(tmp_path / "roll.gif", rolling(), size=(160, 120), rate=20)
    with Image.open(tmp_path / "roll.gif") as picture:
        assert picture.size == (160, 120)
        assert picture.n_frames == 9
        frames = []
        for i in range(picture.n_frames):
            picture.seek(i)
            frames.append(np.asarray(picture.convert("RGB"), float))
    # Something moves, and the sky above is bright.
    assert np.abs(frames[0] - frames[-1]).max() > 60
    assert frames[0][:5].mean() > 150


@needs_gl
def test_a_film_as_mp4(tmp_path):
    if shutil.which("ffmpeg") is None:
        pytest.importorskip("imageio_ffmpeg", reason="neither ffmpeg nor imageio-ffmpeg is installed")
    film.write_film(tmp_path / "roll.mp4", rolling(), size=(160, 120), rate=20)
    assert (tmp_path / "roll.mp4").read_bytes()[4:8] == b"ftyp"


@needs_gl
def test_slow_motion_has_more_pictures(tmp_path):
    from PIL import Image

    film.write_film(tmp_path / "slow.gif", rolling(), size=(80, 60), rate=20, speed=0.5)
    with Image.open(tmp_path / "slow.gif") as picture:
        assert picture.n_frames >= 16


def test_without_opengl_one_sentence_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    with pytest.raises(CfbError, match="no OpenGL to draw with"):
        film.write_film(tmp_path / "roll.gif", rolling())
    assert list(tmp_path.iterdir()) == []


def test_a_viewer_that_cannot_open_says_so_and_the_recording_stays(tmp_path, monkeypatch, capfd):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    # However busy the machine is.
    monkeypatch.setattr(recorder, "_VIEWER_S", 60.0)
    assert main(["view", str(LOG), "-o", str(tmp_path / "yaw.rrd"), "--spawn"]) == 2
    assert "viewer does not open here" in capfd.readouterr().err
    assert (tmp_path / "yaw.rrd").exists()
    assert main(["view", str(tmp_path / "none.rrd"), "--spawn"]) == 2
    assert "there is no such file" in capfd.readouterr().err


REFUSED = {
    "no log": (["view"], "at least one log"),
    "a film of words": (["view", str(LOG), "--video", "film.txt"], "must end in .mp4 or .gif"),
    "a recording of words": (["view", str(LOG), "-o", "flight.txt"], "must end in .rrd"),
    "a recording again": (["view", "there.rrd", "-o", "again.rrd"], "is a recording already"),
    "backwards": (["view", str(LOG), "--video", "a.gif", "--slow", "-1"], "above zero"),
    "many models": (["fly", "target", "--on", "off-nominal", "--video", "a.gif"], "flights of one model"),
    "fly a film of words": (["fly", "target", "--video", "a.avi"], "must end in .mp4 or .gif"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_shown_is_refused_in_one_sentence(case, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    arguments, words = REFUSED[case]
    assert main(arguments) == 2
    assert words in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []
