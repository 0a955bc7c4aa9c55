"""The wheel works in a clean environment outside the repository: shipped assets and presets are found."""

import json
import os
import subprocess
import sys
from pathlib import Path

from cfb_mjx.control.policy_file import shipped_policies
from cfb_mjx.parameters import preset_names

ROOT = Path(__file__).resolve().parents[2]
PROBE = """
import cfb_mjx, json, pathlib, sys
from cfb_mjx.files import shipped
expected = json.loads(sys.argv[1])
from cfb_mjx.model import MjxBody, Quadrotor
from cfb_mjx.parameters import load_randomisation, preset_names
assert "site-packages" in cfb_mjx.__file__ or "target" in cfb_mjx.__file__, cfb_mjx.__file__
assert str(shipped("assets", "cfb.xml")).startswith(str(pathlib.Path(cfb_mjx.__file__).parent))
assert preset_names() == expected["presets"]
load_randomisation()
Quadrotor.from_file("cf21b-500", body=MjxBody(floor=True))
from cfb_mjx.control.policy_file import load_policy, shipped_policies
from cfb_mjx.parameters import load_model_file
from cfb_mjx.train import load_config
from cfb_mjx.train.flying import load_plants
assert list(shipped_policies()) == expected["policies"]
assert shipped("data", "study", "ppo", "1-0.npz").exists()
for policy in shipped_policies().values():
    load_policy(policy)
load_config("target-adaptive")
from cfb_mjx.commands import load
from cfb_mjx.sweep import load_sweep, tasks_of
assert len(tasks_of(load_sweep("randomisation", load))) == 12
load_plants(load_model_file("cfb-guards"))
from cfb_mjx.deploy.deployment import find_deployment
from cfb_mjx.deploy.export import export_policy
assert len(export_policy(find_deployment("double-flip"), "exported").sources) == 4
assert (pathlib.Path(cfb_mjx.__file__).parent / "deploy/emulated/stm32f405.ld").exists()
assert (pathlib.Path(cfb_mjx.__file__).parent / "py.typed").exists()
print("fine")
"""


def test_wheel_carries_its_data(tmp_path):
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    target = tmp_path / "target"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(target), str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
    # The editable install must not shine through: the target comes first on the path, and we are elsewhere.
    environment = {**os.environ, "PYTHONPATH": str(target)}
    # What the checkout has is what the wheel has to have: a list typed here would go stale with the next policy.
    expected = json.dumps({"presets": preset_names(), "policies": list(shipped_policies())})
    done = subprocess.run(
        [sys.executable, "-c", PROBE, expected],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith("fine")
    names = {p.name for p in target.iterdir()}
    assert "assets" not in names
    assert "configs" not in names
