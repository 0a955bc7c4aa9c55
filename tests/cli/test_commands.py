"""The commands as scripts call them: results, help, and how light they start."""

import json
import os
import subprocess
import sys

import pytest

KEYS = ("windows", "commands_in", "rotor_speed_in", "hold", "logs")


def test_help_names_every_command_and_loads_nothing_heavy(cfb):
    done = cfb("--help")
    assert done.returncode == 0
    for name in ("import", "evaluate", "fit", "fit-rotors", "excite", "bench", "demo"):
        assert name in done.stdout
    heavy = "{'jax', 'mujoco', 'tyro', 'numpy'}"
    code = f"import sys, cfb_mjx.cli as c; c.main(['--help']); print(sorted({heavy} & set(sys.modules)))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).endswith("[]\n")


def test_import_of_the_package_loads_nothing_heavy():
    code = "import sys, cfb_mjx; print(sorted({'jax','mujoco','brax','rerun','matplotlib'} & set(sys.modules)))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"


@pytest.mark.parametrize("name", ["import", "evaluate", "fit", "fit-rotors", "excite", "bench", "demo"])
def test_every_command_explains_itself(cfb, name):
    done = cfb(name, "--help")
    assert done.returncode == 0
    assert "usage: cfb " + name in done.stdout


def test_evaluate_gives_the_same_numbers_from_every_format(cfb, files, tmp_path):
    found = {}
    for kind in ("mcap", "parquet", "csv"):
        done = cfb("evaluate", files / f"flight.{kind}", "--json", tmp_path / f"{kind}.json")
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        found[kind] = json.loads((tmp_path / f"{kind}.json").read_text())
    result = found["mcap"]
    assert set(KEYS) <= set(result)
    assert set(result["logs"]["flight"]) == {"windows", "commands_in", "rotor_speed_in", "hold"}
    assert result["rotor_speed_in"] is None
    assert result["windows"] == 7
    for quantity, unit in (("position", "m"), ("velocity", "mps"), ("attitude", "deg"), ("rate", "radps")):
        for statistic in ("rmse", "mean", "median"):
            for horizon in ("0.05", "0.1", "0.2", "0.5"):
                key = f"{quantity}_{statistic}_{unit}@{horizon}s"
                low, high = result["intervals"]["commands_in"][key]
                assert low <= high
                assert result["commands_in"][key] == pytest.approx(found["parquet"]["commands_in"][key], rel=1e-9)
                assert result["commands_in"][key] == pytest.approx(found["csv"]["commands_in"][key], rel=1e-6)
    assert result["environment"]["jax"]


def test_a_changed_parameter_changes_the_prediction(cfb, files, tmp_path):
    for name, change in (("a", []), ("b", ["--set", "mass=0.05"])):
        assert cfb("evaluate", files / "flight.mcap", "--json", tmp_path / f"{name}.json", *change).returncode == 0
    a, b = (json.loads((tmp_path / f"{n}.json").read_text())["commands_in"] for n in "ab")
    assert b["velocity_rmse_mps@0.5s"] > 1.05 * a["velocity_rmse_mps@0.5s"]


def test_a_predictor_has_an_observer_of_its_own(cfb, files, tmp_path):
    told = {}
    for model in ("cfb-idsia", "cfb-idsia-predictor"):
        path = tmp_path / f"{model}.json"
        done = cfb("evaluate", files / "flight.mcap", "--model", model, "--observer", "--json", path)
        assert done.returncode == 0, done.stderr
        told[model] = json.loads(path.read_text())["observer"]
    assert told["cfb-idsia"]["torque_time"] > told["cfb-idsia-predictor"]["torque_time"]


def test_evaluate_draws_a_figure(cfb, files, tmp_path):
    done = cfb("evaluate", files / "flight.mcap", "--figure", tmp_path / "f.png")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")


def test_import_reports_and_reads_back(cfb, files, tmp_path):
    done = cfb("import", files / "flight.csv", "-o", tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert "625 rows" in done.stdout
    assert cfb("evaluate", tmp_path / "out.mcap").returncode == 0


PEER = """#!{python}
import sys
print("ready 9.9 1.5 100", flush=True)
for _ in sys.stdin:
    print(0.02, flush=True)
"""


def test_bench_writes_its_rows(cfb, tmp_path):
    # In place of a Python with crazyflow and l2f; they take 20 ms for 100 steps.
    (tmp_path / "peer").write_text(PEER.format(python=sys.executable))
    (tmp_path / "peer").chmod(0o755)
    files = ("--json", tmp_path / "b.json", "--markdown", tmp_path / "b.md")
    done = cfb("bench", "--drones", "8", "--quick", "--peer-python", tmp_path / "peer", *files)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "b.json").read_text())
    assert {(p["name"], p["version"], p["what"], p["drones"]) for p in result["peers"]} == {
        ("crazyflow", "9.9", "rollout", 8),
        ("l2f", "9.9", "rollout", 8),
    }
    assert [p["steps_per_s"] for p in result["peers"]] == pytest.approx([8 * 100 / 0.02] * len(result["peers"]))
    assert "crazyflow 9.9" in done.stdout
    rows = result["rows"]
    assert {row["what"] for row in rows} == {"rollout", "rollout_kept", "rollout_randomised"}
    for row in rows:
        assert row["drones"] == 8
        assert row["steps_per_s"] > 0
        assert row["compile_s"] > 0
        assert row["peak_mb"] > 0
    assert "steps/s" in (tmp_path / "b.md").read_text()


def test_changes_may_be_given_together_or_one_by_one():
    """An argument given twice once replaced the first without a word."""
    from cfb_mjx.commands.line import parse

    words = ["target", "-o", "out", "--set", "seed=1", "ppo.steps=9", "--set", "ppo.unroll=3"]
    assert parse("train", words).set == ("seed=1", "ppo.steps=9", "ppo.unroll=3")
    assert parse("train", words[:3]).set == ()


def test_the_flag_that_breaks_derivatives_of_the_mjx_body_is_taken_back(monkeypatch):
    from cfb_mjx import runtime

    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    monkeypatch.setattr(runtime.metadata, "version", lambda name: {"jaxlib": "0.10.1"}[name])
    runtime.set_up_xla()
    assert runtime.XLA_CPU_FLAGS in os.environ["XLA_FLAGS"]
    runtime.differentiate_mjx()
    assert os.environ["XLA_FLAGS"] == "--xla_force_host_platform_device_count=2"


@pytest.mark.parametrize("version", ["0.11.0", "0.12.0.1", "1.0.0"])
def test_an_option_that_slows_newer_jaxlibs_down_is_not_set_for_them(monkeypatch, version):
    """With jaxlib 0.12 a rollout that keeps its states ran 150 times slower with it."""
    from cfb_mjx import runtime

    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(runtime.metadata, "version", lambda name: {"jaxlib": version}[name])
    runtime.set_up_xla()
    assert "xla_backend_extra_options" not in os.environ.get("XLA_FLAGS", "")


def test_several_devices_without_any_flags_of_xla():
    code = (
        "import os; os.environ.pop('XLA_FLAGS', None); import cfb_mjx.runtime as r; "
        "r._option_helps = lambda: False; r.configure_jax(x64=False, devices=2); "
        "import jax; print(jax.device_count())"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "2"
