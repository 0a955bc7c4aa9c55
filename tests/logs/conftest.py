from pathlib import Path

import pytest
from synthetic_logs import make_flight

from cfb_mjx.logs import FlightLog

SHARED = Path(__file__).resolve().parents[2].parent / "shared"


@pytest.fixture(scope="session")
def flight() -> FlightLog:
    return make_flight()


@pytest.fixture(scope="session")
def short() -> FlightLog:
    return make_flight(duration=0.4, rate=100.0)


@pytest.fixture(scope="session")
def real_flights() -> list[Path]:
    files = sorted(SHARED.glob("real/*/*.parquet"))
    if not files:
        pytest.skip("the real flights (shared/real beside the repository) are not here; they are third-party data")
    return files


@pytest.fixture(scope="session")
def blind_logs() -> list[Path]:
    files = sorted(SHARED.glob("blind/case_*/log_*.parquet"))
    if not files:
        pytest.skip("the simulated campaigns (shared/blind beside the repository) are not here")
    return files
