"""The MCAP logs open in rerun's own loader."""

import pytest

from cfb_mjx.logs import write_mcap
from tests.rerun_command import rerun

pytest.importorskip("rerun", reason="rerun-sdk is not installed")


def test_rerun_draws_the_pose_and_reads_every_topic(short, tmp_path):
    write_mcap(short, tmp_path / "flight.mcap")
    rerun("mcap", "convert", tmp_path / "flight.mcap", "-o", tmp_path / "flight.rrd", home=tmp_path)
    stats = rerun("rrd", "stats", tmp_path / "flight.rrd", home=tmp_path)
    for entity in ("/pose", "/velocity", "/body_rate", "/specific_force", "/command", "/rotor_speed", "/battery"):
        assert f"\n{entity}: " in stats
    # Foxglove's message is understood, not merely carried along.
    assert "InstancePoses3D:translations" in stats
    assert "InstancePoses3D:quaternions" in stats
    rows = next(line for line in stats.splitlines() if line.startswith("num_rows ="))
    assert int("".join(c for c in rows if c.isdigit())) >= 7 * len(short)
