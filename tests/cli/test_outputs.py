"""Commands that write several files: a rerun that is stopped between them leaves those of the run before."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from cfb_mjx import cli
from cfb_mjx.logs import FlightLog, write_mcap
from cfb_mjx.parameters import load_model_file

BENCH = Path(__file__).resolve().parents[2] / "data" / "bench"


def stop(*arguments, **options):
    """As Ctrl-C, or a disk that is full, would."""
    raise KeyboardInterrupt


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_fit_stopped_at_its_figure_leaves_model_numbers_and_figure_of_the_run_before(tmp_path, monkeypatch, capsys):
    names = {"-o": "rotors.yaml", "--json": "rotors.json", "--figure": "rotors.png"}
    words = [word for option, name in names.items() for word in (option, str(tmp_path / name))]
    arguments = ["fit-rotors", str(BENCH / "rotor_points.csv"), *words]
    assert cli.main(arguments) == 0
    before = contents(tmp_path)
    assert set(before) == set(names.values())
    monkeypatch.setattr("cfb_mjx.view.rotors.rotor_figure", stop)
    assert cli.main([*arguments, "--set", "mass=0.04"]) == 130
    assert contents(tmp_path) == before
    assert "model:" not in capsys.readouterr().out.split("figure:")[-1]


def test_a_loop_stopped_at_its_report_leaves_model_and_report_of_the_run_before(flight, tmp_path, monkeypatch):
    time = np.arange(0, 11.0, 0.004)
    at = np.arange(len(time)) % len(flight.time)
    fields = ("position", "velocity", "quaternion", "body_rate", "specific_force", "command")
    values = {name: getattr(flight, name)[at] for name in fields}
    # The same rows again to the last bit are a copy, which is refused.
    values["body_rate"] = values["body_rate"] + 1e-6 * np.random.default_rng(0).normal(size=values["body_rate"].shape)
    for name in ("fit", "held"):
        log = FlightLog(time, **values, rotor_speed=None, battery_voltage=None, metadata=flight.metadata)
        write_mcap(log, tmp_path / f"{name}.mcap")
        values = values | {"position": values["position"] + 1.0}
    folder = tmp_path / "out"
    folder.mkdir()
    for name in ("model.yaml", "report.html", "report.json", "residual.rrd"):
        (folder / name).write_text("old")
    nothing = {"reported": [], "unexplained": None, "together": None}
    outcome = SimpleNamespace(model_file=lambda *_: load_model_file("cfb"), to_json=dict, **nothing)
    monkeypatch.setattr("cfb_mjx.sysid.tracing.closing.close_loop", lambda *_, **__: outcome)
    monkeypatch.setattr("cfb_mjx.view.closing.write_report", stop)
    arguments = ["close-loop", "--fit", tmp_path / "fit.mcap", "--held-out", tmp_path / "held.mcap", "-o", folder]
    assert cli.main(list(map(str, arguments))) == 130
    assert set(contents(folder).values()) == {b"old"}
