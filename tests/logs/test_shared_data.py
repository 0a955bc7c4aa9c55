"""Third-party flights and simulated campaigns, read where they lie beside the repository; skipped elsewhere."""

import json

import numpy as np
import pytest
from synthetic_logs import same_data

from cfb_mjx.logs import estimate_command_shift, read_log, write_mcap

# ms by which an independent analysis delays the motor columns (README of the data).
SHIFT_MS = {
    "multisine_20251017_run1": 1,
    "multisine_20251017_run2": 1,
    "multisine_20251017_run3": 11,
    "multisine_20251017_run4": 15,
    "random1_20251017_run1": 10,
    "random1_20251017_run3": 20,
    "random1_20251017_run4": 11,
    "random2_20251017_run2": 1,
    "random2_20251017_run3": 13,
    "square_20251017_run3": 1,
    "square_20251017_run4": 1,
}


def test_real_flights_are_accepted_and_aligned(real_flights):
    known = [p for p in real_flights if p.stem in SHIFT_MS]
    assert len(known) == len(SHIFT_MS)
    for path in known:
        log = read_log(path)
        report = log.metadata["alignment"]
        assert report["reliable"], path.name
        assert report["shift_ms"] == pytest.approx(SHIFT_MS[path.stem], abs=4.0), path.name
        assert report["applied_ms"] == pytest.approx(SHIFT_MS[path.stem], abs=6.0), path.name
        # What is left is the lag of the measuring chain, the same on every flight.
        assert estimate_command_shift(log).shift_s == pytest.approx(0.0035, abs=0.003), path.name
        assert np.median(log.specific_force[:, 2]) == pytest.approx(9.9, abs=0.3)
        assert log.metadata["vehicle_mass"] == 0.045


def test_a_real_flight_survives_mcap(real_flights, tmp_path):
    log = read_log(real_flights[0])
    write_mcap(log, tmp_path / "flight.mcap")
    assert same_data(read_log(tmp_path / "flight.mcap"), log)


def test_every_blind_log_is_accepted(blind_logs):
    manifests = {p.parent: json.loads((p.parent / "manifest.json").read_text()) for p in blind_logs}
    for path in blind_logs:
        facts = next(e for e in manifests[path.parent]["logs"] if e["name"] == path.stem)
        log = read_log(path)
        assert len(log) == facts["rows"]
        assert (log.rotor_speed is not None) == facts["has_rotor_speed"]
        assert (len(log.gaps()) > 0) == facts["dropouts"], path
        assert log.metadata["observation_delay"] is None
