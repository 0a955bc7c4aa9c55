"""Flight logs: reading, checking, writing, aligning and resampling measured flights.

Importing this package loads numpy only; pyarrow, mcap and protobuf are loaded by the function that needs them.
"""

from cfb_mjx.logs.alignment import AlignmentEstimate, apply_shift, estimate_command_shift
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.idsia import read_idsia
from cfb_mjx.logs.mcap_reader import read_mcap
from cfb_mjx.logs.mcap_writer import write_mcap
from cfb_mjx.logs.reading import FORMATS, read_log
from cfb_mjx.logs.resample import resample
from cfb_mjx.logs.tabular import read_tabular, write_tabular
from cfb_mjx.logs.validation import validate

__all__ = [
    "FORMATS",
    "AlignmentEstimate",
    "FlightLog",
    "apply_shift",
    "estimate_command_shift",
    "read_idsia",
    "read_log",
    "read_mcap",
    "read_tabular",
    "resample",
    "validate",
    "write_mcap",
    "write_tabular",
]
