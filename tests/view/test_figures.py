"""Figures are written, show something, and refuse what they cannot draw."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import matplotlib.colors
import matplotlib.image
import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor
from cfb_mjx.sysid import evaluate
from cfb_mjx.view import Section, html_page, prediction_figure, spread_figure, style
from cfb_mjx.view.prediction import euler_deg
from cfb_mjx.view.spread import tilt_deg
from tests.simulated_log import simulated_log


@pytest.fixture(scope="module")
def evaluation():
    """Two short flights: one with a gap and partly without rotor speed, one without any."""
    log = simulated_log(3.0)
    rotor_speed = np.array(log.rotor_speed)
    rotor_speed[log.time < 1.2] = np.nan
    broken = log.replace(rotor_speed=rotor_speed, metadata={"name": "broken"}).rows(
        (log.time < 2.3) | (log.time > 2.36)
    )
    bare = log.replace(rotor_speed=None, metadata={"name": "bare"})
    return evaluate(Quadrotor.from_file("cfb-guards"), [broken, bare])


def _pixels(image: np.ndarray, colour: str) -> int:
    """Number of pixels of nearly this colour."""
    return int(np.all(np.abs(image[..., :3] - matplotlib.colors.to_rgb(colour)) < 0.05, axis=-1).sum())


@pytest.mark.parametrize("name", ["broken", "bare"])
def test_prediction_figure_shows_something(evaluation, tmp_path, name):
    path = tmp_path / "figure.png"
    prediction_figure(evaluation, path, name)
    image = matplotlib.image.imread(path)
    assert image.shape[0] > 800
    assert image.shape[1] > 1200
    drawn = {colour: _pixels(image, colour) for colour in ("#222222", "#0072B2", "#D55E00", "#8C8C8C")}
    assert (drawn.pop("#D55E00") > 1000) == (name == "broken")
    assert min(drawn.values()) > 500
    assert list(tmp_path.iterdir()) == [path]


def test_svg_is_wellformed_and_reproducible(tmp_path):
    time = np.linspace(0, 0.5, 6)
    random = np.random.default_rng(0)
    position, tilt = random.normal(size=(50, 6, 3)), random.uniform(0, 90, (50, 6))
    reference = time, position[0], tilt[0]
    for name in ("a.svg", "b.svg"):
        spread_figure(time, position, tilt, tmp_path / name, reference=reference, title="50 drones")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    text = "".join(ElementTree.parse(tmp_path / "a.svg").getroot().itertext())
    for expected in ("50 drones", "tilt, deg", "position z, m", "time, s", "5 to 95 %", "measured"):
        assert expected in text


@pytest.mark.parametrize(("form", "begin"), [("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_vector_copies_lie_beside_the_figure_or_in_a_folder(tmp_path, form, begin):
    figure, elsewhere = style.new_figure(2, 1), tmp_path / "figures"
    elsewhere.mkdir()
    with style.with_vector_copies(form):
        style.save(figure, tmp_path / "a.png")
        style.save(figure, tmp_path / f"b.{form}")
        with style.with_vector_copies(form, elsewhere):
            style.save(figure, tmp_path / "c.png")
    style.save(figure, tmp_path / "d.png")
    found = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")}
    assert found == {"a.png", f"a.{form}", f"b.{form}", "c.png", f"figures/c.{form}", "d.png"}
    assert (tmp_path / f"a.{form}").read_bytes().startswith(begin)


def test_bad_requests_are_refused(evaluation, tmp_path):
    with pytest.raises(CfbError, match=r"\.svg, \.png"):
        prediction_figure(evaluation, tmp_path / "figure.bmp")
    with pytest.raises(CfbError, match="choose one of broken, bare"):
        prediction_figure(evaluation, tmp_path / "figure.png", "other")
    with pytest.raises(CfbError, match="does not exist"):
        spread_figure(np.arange(2), np.zeros((3, 2, 3)), np.zeros((3, 2)), tmp_path / "no" / "figure.png")
    assert list(tmp_path.iterdir()) == []


def test_angles():
    half = np.radians(30) / 2
    q = np.array(
        [[np.cos(half), np.sin(half), 0, 0], [np.cos(half), 0, np.sin(half), 0], [np.cos(half), 0, 0, -np.sin(half)]]
    )
    np.testing.assert_allclose(euler_deg(q), np.diag([30, 30, -30]), atol=1e-12)
    np.testing.assert_allclose(tilt_deg(q), [30, 30, 0], atol=1e-12)


def test_page_is_selfcontained_and_escaped(tmp_path):
    figure = tmp_path / "figure.png"
    figure.write_bytes(b"\x89PNG")
    table = ("caption", ["a", "b"], [["x < y", "1"]])
    page = html_page("title & more", "lead", [Section("one", ["text <b>"], [table], [(figure, "a figure")])], {"v": 1})
    assert "title &amp; more" in page
    assert "text &lt;b&gt;" in page
    assert "x &lt; y" in page
    assert 'src="data:image/png;base64,iVBORw=="' in page
    assert "http" not in page
    assert Path(figure).exists()
