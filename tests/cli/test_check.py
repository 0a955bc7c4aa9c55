"""``cfb check``, and what ``cfb import`` says and writes for recordings that are not as they should be."""

import json

import numpy as np
import pytest

from cfb_mjx import cli
from cfb_mjx.files import shipped
from cfb_mjx.logs import read_log, write_tabular

SHIPPED = shipped("data", "flight_logs", "figure8.mcap")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A good flight, the same with its velocity in body axes, and one with names of its own."""
    folder = tmp_path_factory.mktemp("recordings")
    log = read_log(SHIPPED).slice(0.0, 5.0)
    write_tabular(log, folder / "good.csv")
    write_tabular(log.replace(velocity=log.velocity * [1.0, -1.0, 1.0]), folder / "mirrored.csv")
    names = {"t": "time", "u": "motor", "omega": "rpm"}
    head, rest = (folder / "good.csv").read_text().split("\n", 1)
    columns = [c.strip('"') for c in head.split(",")]
    mine = [next((new + c[len(old) :] for old, new in names.items() if c[: len(old)] == old), c) for c in columns]
    mine = [c.replace("p", "pos_", 1) if c in ("px", "py", "pz") else c for c in mine]
    (folder / "mine.csv").write_text(",".join(mine) + "\n" + rest)
    return folder


def run(capsys, *arguments):
    status = cli.main([str(a) for a in arguments])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_check_says_what_recordings_hold_and_writes_a_page(folder, tmp_path, capsys):
    found = tmp_path / "found.json"
    status, out, err = run(
        capsys, "check", SHIPPED, folder / "good.csv", folder / "mirrored.csv", "-o", tmp_path / "page", "--json", found
    )
    assert status == 2
    assert "1 of 3 recordings were refused" in err
    assert out.count("signals agree: displacement x y z") == 2
    assert "mirrored.csv: REFUSED" in out
    assert out.count("rotors of a Crazyflie Brushless carry 44.0 g") == 2
    assert "--fix velocity-axes=x,-y,z" in out
    assert "good for: fit of J_x, J_y and motors" in out
    page = (tmp_path / "page" / "index.html").read_text()
    assert page.count("<img") == 2
    assert "velocity-axes" in page
    logs = json.loads(found.read_text())["logs"]
    assert [set(v) == {"refused"} for v in logs.values()] == [False, False, True]
    good = logs[str(SHIPPED)]
    assert good["rate_hz"] == pytest.approx(250, rel=0.01)
    assert all(not r["contradicts"] for r in good["checks"]["relations"])
    assert any("fit-rotors" in line for line in good["good_for"])


def test_check_of_good_recordings_ends_well(folder, capsys):
    status, out, err = run(capsys, "check", folder / "good.csv")
    assert (status, err) == (0, "")
    assert "next time" not in out or "J_z" in out


def test_check_says_what_to_log_next_time(tmp_path, capsys):
    log = read_log(SHIPPED)
    write_tabular(log.rows(slice(0, None, 4)).replace(rotor_speed=None, battery_voltage=None), tmp_path / "poor.csv")
    status, out, _ = run(capsys, "check", tmp_path / "poor.csv")
    assert status == 0
    for hint in ("log rotor speeds", "log pm.vbat", "log at 250 Hz or more (now 62)"):
        assert hint in out


def test_check_needs_a_log(capsys):
    assert run(capsys, "check")[0] == 2


def test_a_contradiction_is_mended_when_asked(folder, tmp_path, capsys):
    out = tmp_path / "a.mcap"
    status, _, err = run(capsys, "import", folder / "mirrored.csv", "-o", out)
    assert status == 2
    assert "--fix velocity-axes=x,-y,z" in err
    assert not out.exists()
    status, said, _ = run(capsys, "import", folder / "mirrored.csv", "-o", out, "--fix", "velocity-axes=x,-y,z")
    assert status == 0
    assert "as asked" in said
    assert np.abs(read_log(out).velocity - read_log(folder / "good.csv").velocity).max() < 1e-12


def test_a_mapping_is_proposed_beside_the_output(folder, tmp_path, capsys):
    out = tmp_path / "a.mcap"
    status, _, err = run(capsys, "import", folder / "mine.csv", "-o", out)
    mapping = tmp_path / "a.mapping.yaml"
    assert status == 2
    assert f"a mapping was written to {mapping}: check it, then add --mapping {mapping}" in err
    status, said, _ = run(capsys, "import", folder / "mine.csv", "-o", out, "--mapping", mapping)
    assert status == 0, said
    assert np.abs(read_log(out).position - read_log(folder / "good.csv").position).max() < 1e-9


def test_what_to_log(capsys):
    status, card, _ = run(capsys, "import", "--print-config", "sd")
    assert status == 0
    events = card.split("on:")[1:]
    assert len(events) == 2
    for event in events:
        assert sum("." in line and "#" not in line for line in event.splitlines()[1:]) <= 20
    status, radio, _ = run(capsys, "import", "--print-config", "radio")
    sizes = {"int16_t": 2, "uint16_t": 2, "uint32_t": 4}
    blocks = [b["logconfig"]["logblock"] for b in json.loads(radio)]
    assert all(sum(sizes[v["stored_as"]] for v in b["variables"]) <= 26 for b in blocks)
    assert run(capsys, "import")[0] == 2


def test_the_logging_asked_for_is_enough_for_a_flight():
    """What --print-config asks for is what the importer's own mapping reads."""
    from cfb_mjx.logs.flight_log import REQUIRED
    from cfb_mjx.logs.variables import load_mapping

    text = shipped("configs", "logs", "config.txt").read_text()
    radio = json.loads(shipped("configs", "logs", "radio.json").read_text())
    card = [line for line in text.splitlines() if "." in line and "#" not in line]
    blocks = [v["name"] for b in radio for v in b["logconfig"]["logblock"]["variables"]]
    for names in (card, blocks):
        chosen = load_mapping().choose(names, "x")
        assert {f for f in REQUIRED if f != "time"} <= set(chosen)
        assert not any(choice.derived for choice in chosen.values())
