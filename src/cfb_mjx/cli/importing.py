"""``cfb import``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped, write_text
from cfb_mjx.logs import estimate_command_shift, write_mcap
from cfb_mjx.logs.alignment import describe_alignment
from cfb_mjx.logs.proposal import UnknownNames
from cfb_mjx.logs.reading import read_judged


def run_import(sources: list[Path], output: Path, format: str | None, options: dict[str, Any]) -> None:
    """Convert ``sources``, one flight, to the MCAP ``output`` and report what was read.

    Raises:
        CfbError: see `cfb_mjx.logs.read_log`; or the output is not an .mcap, or is the source itself.
    """
    if output.suffix != ".mcap":
        raise CfbError(f"{output}: the output must end in .mcap.")
    if output.exists() and any(source.exists() and output.samefile(source) for source in sources):
        raise CfbError(f"{output}: is the source itself; choose another name.")
    try:
        log, verdict = read_judged(sources, format, **options)
    except UnknownNames as error:
        proposed = output.with_suffix(".mapping.yaml")
        write_text(proposed, error.mapping)
        said = str(error).partition("; cfb import")[0]
        raise CfbError(
            f"{said}; a mapping was written to {proposed}: check it, then add --mapping {proposed}."
        ) from None
    alignment = log.metadata.get("alignment")
    if alignment is None:
        alignment = {**estimate_command_shift(log).report(), "applied": False}
        log = log.replace(metadata={"alignment": alignment})
    write_mcap(log, output)
    gaps = len(log.gaps())
    rate = 1 / log.nominal_interval
    print(
        f"{output}: {len(log.time)} rows, {log.duration:.1f} s at {rate:.0f} Hz, {gaps} gap{'s' if gaps != 1 else ''}"
    )
    print(f"  rotor speed {'measured' if log.rotor_speed is not None else 'not measured'}", end="; ")
    voltage = log.battery_voltage
    print(
        f"battery {np.nanmin(voltage):.2f} to {np.nanmax(voltage):.2f} V"
        if voltage is not None
        else "no battery voltage"
    )
    for key, value in (log.metadata.get("cleaning") or {}).items():
        if value and (key.startswith("dropped") or key in ("held_rows_kept", "invalid_rotor_speeds")):
            print(f"  {key.replace('_', ' ')}: {value}")
    print(f"  {verdict.summary()}")
    print(f"  {describe_alignment(alignment)}")
    for line in [*(log.metadata.get("warnings") or ()), *(log.metadata.get("notes") or ())]:
        print(f"  {line}")


def print_logging(kind: str) -> None:
    """Print what to log: ``sd`` for the micro SD card deck, ``radio`` for cfclient."""
    name = {"sd": "config.txt", "radio": "radio.json"}[kind]
    print(shipped("configs", "logs", name).read_text(encoding="utf-8"), end="")
