"""Propose a mapping for a table with unknown column names, from the names and the size of the values."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import yaml

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import rotation
from cfb_mjx.logs.radio_csv import clock_of
from cfb_mjx.logs.tabular import Text
from cfb_mjx.logs.variables import DERIVED_FROM, FORMAT, UNITS

_AXES = {"x": 0, "y": 1, "z": 2}
_MEMBERS = {**_AXES, "w": 3, **{str(i): i for i in range(5)}}
# Field, and the pattern of a column name without its axis or number.
_STEMS: tuple[tuple[str, str], ...] = (
    ("body_rate", r"gyro(scope)?|ang(ular)?vel(ocity)?|angvelb?|bodyrates?|omegab?|rates?|w"),
    ("specific_force", r"acc(el|elerometer|eleration)?|linearacceleration|specificforce|imuacc|a"),
    ("velocity", r"(lin(ear)?)?vel(ocity)?|v|dot|speed"),
    ("quaternion", r"q(uat(ernion)?)?|orientation|rot(ation)?|att(itude)?|poseorientation"),
    ("position", r"|p(os(ition)?)?|translation|loc(ation)?|poseposition"),
    ("command", r"u|m(otor)?s?m?|pwmm?|cmds?m?|commands?m?|duty|throttle|action|motorpwm|motorcmd|thrustpwm|mpwm"),
    ("rotor_speed", r"r|rpms?m?|rotor(speed|vel(ocity)?)?s?|motor(rpm|speed)s?|omegam|erpm|mrpm"),
)
_ANGLES = re.compile(r"(.*?)(roll|pitch|yaw|phi|theta|psi)", re.IGNORECASE)
_THRUST = frozenset(["n", "mn", "g", "gf", "kgf"])
_RATES = re.compile(r"(roll|pitch|yaw)(rate|dot|speed|vel)|(?:body)?rate(roll|pitch|yaw)", re.IGNORECASE)
_BATTERY = re.compile(r"(pm)?v?bat(tery)?(_?(voltage|v|mv))?|voltage|vbat.*", re.IGNORECASE)
_GROUPS = re.compile(
    r"^((state_?estimate|state|pose|odom(etry)?|imu|twist|sensors?|drone|cf\d*|data|log)[._/ ]+)+(?=.)", re.IGNORECASE
)


class UnknownNames(CfbError):
    """The columns of a table have unknown names.

    Attributes:
        mapping: text of the mapping file proposed for it.
    """

    def __init__(self, message: str, mapping: str):
        super().__init__(message)
        self.mapping = mapping


class Proposal(NamedTuple):
    """A mapping file as text, and the fields it fills."""

    text: str
    fields: tuple[str, ...]


def propose(table: Mapping[str, np.ndarray | Text]) -> Proposal | None:
    """Propose a mapping for the columns of a table; None if their names do not suggest a flight."""
    numbers = _numbers(table)
    found = _fields(numbers)
    if _missing(numbers, found) or min((len(v) for v in numbers.values()), default=0) < 2:
        return None
    return _document(found, numbers)


def lacking(table: Mapping[str, np.ndarray | Text]) -> list[str]:
    """Required signals, in words, for which no column has a suitable name."""
    numbers = _numbers(table)
    return _missing(numbers, _fields(numbers))


def _numbers(table: Mapping[str, np.ndarray | Text]) -> dict[str, np.ndarray]:
    return {name: np.asarray(v, float) for name, v in table.items() if not isinstance(v, Text)}


def _missing(numbers: Mapping[str, np.ndarray], found: Mapping[str, list[str]]) -> list[str]:
    needed = {
        "time": clock_of(numbers) is not None,
        "position": "position" in found,
        "attitude": bool({"quaternion", "angles"} & set(found)),
        "motors (commands or rotor speeds)": bool({"command", "rotor_speed"} & set(found)),
    }
    return [what for what, there in needed.items() if not there]


def _fields(numbers: Mapping[str, np.ndarray]) -> dict[str, list[str]]:
    """Field to its columns, according to their names."""
    found = _families(numbers)
    if "quaternion" not in found:
        angles = {m[2].lower(): n for n in numbers if (m := _ANGLES.fullmatch(_plain(n))) and not m[1].endswith("rate")}
        names = [angles.get(a) or angles.get(b) for a, b in (("roll", "phi"), ("pitch", "theta"), ("yaw", "psi"))]
        known = [name for name in names if name is not None]
        if len(known) == len(names):
            found["angles"] = known
    if "body_rate" not in found:
        rates = {(m[1] or m[3]).lower(): n for n in numbers if (m := _RATES.fullmatch(_plain(n)))}
        if len(rates) == 3:
            found["body_rate"] = [rates[a] for a in ("roll", "pitch", "yaw")]
    battery = next((n for n in numbers if _BATTERY.fullmatch(_plain(n))), None)
    if battery is not None:
        found["battery_voltage"] = [battery]
    return found


def _plain(name: str) -> str:
    return re.sub(r"[\s._/\[\]()-]", "", _GROUPS.sub("", name.strip())).lower()


def _families(numbers: Mapping[str, np.ndarray]) -> dict[str, list[str]]:
    """Field to its columns, in order; the names of these columns differ only in an axis or a number."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in numbers:
        bare = re.sub(r"\[[^\]]*\]|\([^)]*\)", "", name)
        plain = _plain(bare)
        match = re.fullmatch(r"(?:(?P<stem>.*?)(?P<last>[xyzw0-4])|(?P<first>[xyz])(?P<rest>dot|vel|acc))", plain)
        if match is None:
            continue
        stem, member = (match["stem"], match["last"]) if match["last"] else (match["rest"], match["first"])
        groups.setdefault((stem, _unit_of(name)), {}).setdefault(member, name)
    found: dict[str, list[str]] = {}
    for (stem, unit), members in groups.items():
        kinds = [field for field, pattern in _STEMS if re.fullmatch(f"(?:state|est|kalman)?(?:{pattern})", stem)]
        if set("wxyz") <= set(members) and "quaternion" in kinds:
            found.setdefault("quaternion", [members[a] for a in "wxyz"])
        elif (
            set("xyz") <= set(members) and kinds and kinds[0] in ("body_rate", "specific_force", "velocity", "position")
        ):
            found.setdefault(kinds[0], [members[a] for a in "xyz"])
        four = next((d for d in ("1234", "0123") if set(d) <= set(members)), None)
        motors = [k for k in kinds if k in ("command", "rotor_speed")] or (["rotor_speed"] if stem == "omega" else [])
        if four and motors and unit not in _THRUST:
            found.setdefault(motors[0], [members[d] for d in four])
    return found


def _unit_of(name: str) -> str:
    """Unit in brackets at the end of a header, in lower case."""
    match = re.search(r"[\[(]([^\[\]()]*)[\])]\s*$", name)
    return match[1].strip().lower() if match else ""


def _document(found: dict[str, list[str]], numbers: Mapping[str, np.ndarray]) -> Proposal:
    values = {field: np.stack([numbers[n] for n in names], axis=1) for field, names in found.items()}
    fields: dict[str, list[dict]] = {}
    for field, names in found.items():
        entry: dict = {"variables": names}
        said = _unit_of(names[0])
        known = UNITS["quaternion" if field == "angles" else field]
        unit = said if said in known else _unit(field, values)
        if field == "angles":
            entry |= {"form": "euler", "unit": unit}
        elif field != "quaternion":
            entry["unit"] = unit
        fields["quaternion" if field == "angles" else field] = [entry]
    for field, source in DERIVED_FROM.items():
        if field not in fields:
            fields[field] = [{"derived": source}]
    body = yaml.safe_dump(
        {"format": FORMAT, "name": "proposed", "fields": fields}, sort_keys=False, default_flow_style=None
    )
    head = (
        "# Proposed from the columns' names and the size of their values: check every line, units and signs first.\n"
        "# configs/logs/crazyflie.yaml explains the keys; a Crazyflie logs pitch with the opposite sign ([1, -1, 1]).\n"
    )
    return Proposal(head + body, tuple(fields))


def _unit(field: str, values: Mapping[str, np.ndarray]) -> str:
    """Guess the unit from the size of the values."""
    known = values[field][np.isfinite(values[field]).all(axis=1)]
    size = float(np.median(np.linalg.norm(known, axis=1))) if len(known) else 0.0
    top = float(np.abs(known).max(initial=0.0))
    if field == "specific_force":
        return "g" if size < 3 else "m/s^2" if size < 100 else "mm/s^2"
    if field == "command":
        return "1" if top <= 1.01 else "percent" if top <= 100.5 else "pwm16"
    if field == "rotor_speed":
        return "rpm" if size / 2 > 3500 else "rad/s"
    if field == "battery_voltage":
        return "mV" if size > 100 else "V"
    if field == "angles":
        return "deg" if top > 3.2 else "rad"
    if field == "body_rate":
        return _rate_unit(known, values)
    return {"position": "m", "velocity": "m/s"}.get(field, "1")


def _rate_unit(rate: np.ndarray, values: Mapping[str, np.ndarray]) -> str:
    """Guess the unit of the gyro: compare its size with the rotation of the attitude from row to row."""
    if "quaternion" in values and len(values["quaternion"]) == len(rate):
        q = rotation.tidy(values["quaternion"])
        turned = np.linalg.norm(rotation.rotation_vector(rotation.multiply(rotation.conjugate(q[:-1]), q[1:])), axis=1)
        spread = float(np.sum(turned)) / max(len(turned), 1)
        # With intervals of 1 to 20 ms, the rotation per row is 1/1000 to 1/50 of a rate in rad/s, and a 57th of that
        # for a rate in deg/s.
        ratio = spread / max(float(np.mean(np.linalg.norm(rate, axis=1))), 1e-9)
        if spread > 1e-5:
            return "deg/s" if ratio < 7e-4 else "rad/s"
    return "deg/s" if float(np.abs(rate).max(initial=0.0)) > 40.0 else "rad/s"
