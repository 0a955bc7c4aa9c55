"""Recognise the columns of bench tables by the names that common programs use, and convert them to SI."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.tabular import Table, require_numbers
from cfb_mjx.optional import not_none

GRAVITY = 9.81
RPM = 2 * np.pi / 60
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    # Unit to (factor, offset): SI = (value - offset) * factor.
    "t": {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "us": (1e-6, 0.0)},
    "u": {"1": (1.0, 0.0), "%": (1e-2, 0.0), "pwm": (1 / 65535, 0.0), "us": (1e-3, 1000.0)},
    "omega": {"rad/s": (1.0, 0.0), "rpm": (RPM, 0.0), "hz": (2 * np.pi, 0.0), "rev/s": (2 * np.pi, 0.0)},
    "force": {
        "n": (1.0, 0.0),
        "mn": (1e-3, 0.0),
        "g": (1e-3 * GRAVITY, 0.0),
        "gf": (1e-3 * GRAVITY, 0.0),
        "kg": (GRAVITY, 0.0),
        "kgf": (GRAVITY, 0.0),
        "lbf": (4.4482216, 0.0),
        "ozf": (0.27801385, 0.0),
    },
    "torque": {
        "nm": (1.0, 0.0),
        "mnm": (1e-3, 0.0),
        "nmm": (1e-3, 0.0),
        "gfcm": (9.80665e-5, 0.0),
        "kgfcm": (9.80665e-2, 0.0),
        "ozfin": (7.0615518e-3, 0.0),
        "lbfin": (0.11298483, 0.0),
    },
    "vbat": {"v": (1.0, 0.0), "mv": (1e-3, 0.0)},
}
# Names without blanks, the preferred one first, each with its unit if the header has none.
_NAMES: dict[str, tuple[tuple[str, str], ...]] = {
    "t": (("t", "s"), ("time", "s"), ("timestamp", "s")),
    "u": (
        ("u", "1"),
        ("command", "1"),
        ("duty", "1"),
        ("pwm", "pwm"),
        ("throttle", "%"),
        ("escsignal", "us"),
        ("escthrottle", "us"),
        ("esc", "us"),
    ),
    "omega": (
        ("omega", "rad/s"),
        ("rpm", "rpm"),
        ("motoropticalspeed", "rpm"),
        ("rotationalspeed", "rpm"),
        ("rotationspeed", "rpm"),
        ("motorspeed", "rpm"),
        ("motorelectricalspeed", "rpm"),
    ),
    "force": (("force", "n"), ("thrust", "n"), ("forcefz", "n"), ("weight", "g"), ("load", "g"), ("lift", "g")),
    "torque": (("torque", "nm"), ("torquemz", "nm")),
    "vbat": (("vbat", "v"), ("voltage", "v"), ("v", "v"), ("battery", "v")),
}
_NUMBERED = re.compile(r"(?P<name>[a-z]+?)_?(?P<motor>[1-4])?")
_UNIT_AT_END = re.compile(r"(?P<name>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]\s*")
_LETTERS = {"µ": "u", "μ": "u"}  # micro sign and Greek letter
_APART = 0.02  # relative difference allowed between two sensors of the same speed


class _Header(NamedTuple):
    name: str
    unit: str | None
    stand: str
    """Powertrain or side of the test stand; empty if the header does not name one."""


class Columns(NamedTuple):
    """Columns in SI.

    Attributes:
        values: columns by ``t``, ``u``, ``omega``, ``force``, ``torque``, ``vbat``; numbered ones by ``u1``, ``omega1``
        names: the same keys to the column's name in the file, for messages.
        unit_said: the keys whose unit is given in the header.
    """

    values: dict[str, np.ndarray]
    names: dict[str, str]
    unit_said: frozenset[str]


def keys_of(table: Table) -> dict[str, list[str]]:
    """Quantities of a table (keys as in `Columns`) to the columns that hold them, the preferred one first."""
    found: dict[str, list[tuple[int, str]]] = {}
    for column in table:
        match = _NUMBERED.fullmatch(_header(column).name)
        if match is None:
            continue
        for key, names in _NAMES.items():
            rank = next((i for i, (name, _) in enumerate(names) if name == match["name"]), None)
            if rank is not None and not (match["motor"] and key not in ("u", "omega")):
                found.setdefault(key + (match["motor"] or ""), []).append((rank, column))
    return {key: [column for _, column in sorted(columns, key=lambda c: c[0])] for key, columns in found.items()}


def in_si(table: Table, path: Path, notes: list[str]) -> Columns:
    """The recognised columns, in SI. Of several columns for one quantity, the preferred one with nonzero readings.

    Args:
        table: the table as read.
        path: the file, for messages.
        notes: receives disagreements between sensors of the same speed.

    Raises:
        CfbError: several powertrains side by side, cells that are not numbers, an unknown unit.
    """
    found = keys_of(table)
    stands = sorted({_header(c).stand for columns in found.values() for c in columns} - {""})
    if len(stands) > 1:
        raise CfbError(
            f"{path}: holds {len(stands)} powertrains side by side ({', '.join(stands)}); keep the columns of one."
        )
    require_numbers(table, [column for columns in found.values() for column in columns], path)
    values, names, said = {}, {}, set()
    for key, columns in found.items():
        readings = {column: _converted(table, key, column, path) for column in columns}
        lively = {column: float(np.mean(np.nan_to_num(v) != 0)) if len(v) else 0.0 for column, v in readings.items()}
        chosen = next(c for c in columns if lively[c] >= max(lively.values()) / 2)
        if key.startswith("omega"):
            _compare(chosen, {c: v for c, v in readings.items() if lively[c] > 0}, path, notes)
        values[key], names[key] = readings[chosen], chosen
        if _header(chosen).unit is not None:
            said.add(key)
    return Columns(values, names, frozenset(said))


def _header(column: str) -> _Header:
    text = column.strip().lower()
    for letter, plain in _LETTERS.items():
        text = text.replace(letter, plain)
    stand, dash, rest = text.partition(" - ")
    stand, text = (stand, rest) if dash else ("", text)
    match = _UNIT_AT_END.fullmatch(text)
    name, unit = (match["name"], match["unit"]) if match else (text, None)
    unit = None if unit is None else re.sub(r"[\s·⋅*.]", "", unit)
    # Brackets before the unit explain the name: "force Fz (thrust) (N)".
    name = re.sub(r"[\[(][^\[\]()]*[\])]", "", name)
    side = re.fullmatch(r"(?P<name>.{3,}?) (?P<side>[ab])", name.strip())
    if side and not stand:
        name, stand = side["name"], side["side"]
    return _Header(re.sub(r"\s", "", name), unit, stand)


def _converted(table: Table, key: str, column: str, path: Path) -> np.ndarray:
    kind, header = key.rstrip("1234"), _header(column)
    default = dict(_NAMES[kind])[not_none(_NUMBERED.fullmatch(header.name))["name"]]
    known, unit = _UNITS[kind], default if header.unit is None else header.unit
    if unit not in known:
        raise CfbError(f"{path}: column {column} is in {unit}, which is not one of {', '.join(known)}; convert it.")
    factor, zero = known[unit]
    values = np.asarray(table[column], float)
    # A column named pwm may hold a duty of 0 to 1.
    if unit == "pwm" and np.nanmax(np.abs(values), initial=0.0) <= 1.001:
        factor = 1.0
    return (values - zero) * factor


def _compare(chosen: str, readings: dict[str, np.ndarray], path: Path, notes: list[str]) -> None:
    """Add a note if two sensors of the same speed disagree, which means a wrong number of poles or marks."""
    for column, values in readings.items():
        both = (values > 0) & (readings[chosen] > 0)
        if column == chosen or both.sum() < 3:
            continue
        ratio = float(np.median(values[both] / readings[chosen][both]))
        if abs(ratio - 1) > _APART:
            notes.append(
                f"{path.name}: {column} reads {ratio:.3f} times {chosen}, which was used; one of them has a wrong "
                "number of poles or marks."
            )
