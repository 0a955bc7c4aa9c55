"""docs/my-drone.md walked through with the recordings of four labs: import, check, evaluate.

Each lab keeps the same flight in its own way. The commands are those of the page, with the files' names in them.
"""

import json
import re
import shlex
from pathlib import Path

import foreign_logs as foreign
import numpy as np
import pytest

from cfb_mjx import cli
from cfb_mjx.files import shipped
from cfb_mjx.logs import read_log

PAGE = Path(__file__).resolve().parents[2] / "docs" / "my-drone.md"


@pytest.fixture(scope="module")
def flight():
    return read_log(shipped("data", "flight_logs", "figure8.mcap")).slice(0.0, 6.0)


def command_of_the_page(start: str) -> list[str]:
    """The words of the page's command that begins like this, without its comment."""
    lines = re.findall(rf"^{re.escape(start)}.*$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert lines, f"{PAGE.name} has no command {start}"
    return shlex.split(lines[0].split("#")[0])[1:]


def card(flight, folder):
    """Micro SD card, with what the motors got and rotor speeds."""
    pwm = {f"pwm.m{i}_pwm": "I" for i in range(1, 5)}
    data = foreign.firmware_variables(flight)
    data |= {f"pwm.m{i}_pwm": data[f"motor.m{i}"] for i in range(1, 5)}
    variables = foreign.STATE | foreign.IMU | pwm | foreign.RPM | foreign.BATTERY
    (folder / "log07").write_bytes(foreign.usd_card_bytes([foreign.event(flight, variables, source=data)]))
    return ["log07"], []


def bag(flight, folder):
    """ROS 2 Humble: a bag in sqlite3, names of custom topics in the crazyflies.yaml."""
    names = [*foreign.STATE, *foreign.IMU, *foreign.MOTOR]
    made = foreign.Bag(doubles=True)
    made.custom("/cf231/all", flight, names)
    foreign.write_sqlite(folder / "bag", sorted(made.messages, key=lambda m: m[0]), 64)
    foreign.write_crazyflies_yaml(folder / "crazyflies.yaml", {"all": names})
    return ["bag"], ["--topics-yaml", "crazyflies.yaml", "--robot", "cf231"]


def blocks(flight, folder):
    """cfclient: one file per log block."""
    state, imu, motor = list(foreign.STATE), list(foreign.IMU), list(foreign.MOTOR)
    slow = flight.rows(slice(0, None, 2))
    for number, names in enumerate((state[:6], state[6:], imu, motor), 1):
        foreign.write_radio_csv(folder / f"block{number}.csv", slow, [names])
    return [f"block{number}.csv" for number in range(1, 5)], []


def table(flight, folder):
    """A script of one's own: other names, semicolons, decimal commas, degrees and percent."""
    columns = {"time": flight.time}
    for stem, values in (
        ("pos_", flight.position),
        ("vel_", flight.velocity),
        ("gyro_", np.degrees(flight.body_rate)),
        ("acc_", flight.specific_force / 9.81),
    ):
        columns |= {stem + a: c for a, c in zip("xyz", values.T, strict=True)}
    columns |= {"q" + a: c for a, c in zip("wxyz", flight.quaternion.T, strict=True)}
    columns |= {f"motor{i}": 100 * c for i, c in enumerate(flight.command.T, 1)}
    rows = np.stack(list(columns.values()), axis=1)
    lines = [";".join(columns), *(";".join(repr(float(x)).replace(".", ",") for x in row) for row in rows)]
    (folder / "log10").write_text("\n".join([*lines, ""]), encoding="utf-8")
    return ["log10"], ["--mapping", "mine.yaml"]


LABS = {
    "07": (card, "cfb import log07"),
    "08": (bag, "cfb import bag"),
    "11": (blocks, "cfb import block"),
    "10": (table, "cfb import log10"),
}


def test_from_recordings_to_an_error(flight, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("flights").mkdir()
    for name, (write, start) in LABS.items():
        files, options = write(flight, tmp_path)
        words = command_of_the_page(start)
        assert words[0] == "import"
        assert f"flights/{name}.mcap" in words
        assert [w for w in words if w.startswith("--")] == [o for o in options if o.startswith("--")], start
        arguments = ["import", *files, "-o", f"flights/{name}.mcap"]
        if name == "10":
            assert cli.main(arguments) == 2
            Path(f"flights/{name}.mapping.yaml").rename("mine.yaml")  # after a look at it
        assert cli.main([*arguments, *options]) == 0, capsys.readouterr().err
        log = read_log(f"flights/{name}.mcap")
        assert abs(log.duration - flight.duration) < 0.02
        assert log.metadata["warnings"] == []
    flights = sorted(str(p) for p in Path("flights").glob("*.mcap"))
    checked = command_of_the_page("cfb check")
    assert checked[:2] == ["check", "flights/*.mcap"]
    capsys.readouterr()
    assert cli.main(["check", *flights, *checked[2:]]) == 0
    assert capsys.readouterr().out.count("signals agree: displacement x y z") == 4
    assert Path("checked/index.html").exists()
    evaluated = command_of_the_page("cfb evaluate flights/*.mcap --set mass=0.0385 --figure")
    assert cli.main(["evaluate", *flights, *evaluated[2:]]) == 0
    logs = json.loads(Path("before.json").read_text())["logs"]
    errors = [entry["commands_in"]["attitude_mean_deg@0.1s"] for entry in logs.values()]
    assert len(errors) == 4
    assert max(errors) < 1.3 * min(errors)  # the same flight, whoever kept it
