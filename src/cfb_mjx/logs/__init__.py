"""Flight logs: reading, checking, writing, aligning and resampling measured flights.

Importing this package loads numpy only; pyarrow, mcap and protobuf are loaded by the function that needs them.
"""

from cfb_mjx.logs.alignment import AlignmentEstimate, apply_shift, estimate_command_shift
from cfb_mjx.logs.crazyswarm import read_crazyswarm
from cfb_mjx.logs.flight_log import FlightLog, require_own_names
from cfb_mjx.logs.foxglove import read_foxglove
from cfb_mjx.logs.idsia import read_idsia
from cfb_mjx.logs.mcap_reader import read_mcap
from cfb_mjx.logs.mcap_writer import write_mcap
from cfb_mjx.logs.radio_csv import read_radio_csv
from cfb_mjx.logs.reading import FORMATS, read_log
from cfb_mjx.logs.resample import resample, with_other
from cfb_mjx.logs.tabular import read_tabular, write_tabular
from cfb_mjx.logs.ulog import read_ulog
from cfb_mjx.logs.usd_card import read_usd_card
from cfb_mjx.logs.validation import validate
from cfb_mjx.logs.variables import VariableMap, load_mapping

__all__ = [
    "FORMATS",
    "AlignmentEstimate",
    "FlightLog",
    "VariableMap",
    "apply_shift",
    "estimate_command_shift",
    "load_mapping",
    "read_crazyswarm",
    "read_foxglove",
    "read_idsia",
    "read_log",
    "read_mcap",
    "read_radio_csv",
    "read_tabular",
    "read_ulog",
    "read_usd_card",
    "require_own_names",
    "resample",
    "validate",
    "with_other",
    "write_mcap",
    "write_tabular",
]
