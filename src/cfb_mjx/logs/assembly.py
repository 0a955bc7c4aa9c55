"""Build a `FlightLog` from streams of logged variables: choose variables, convert units, merge onto one clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import rotation
from cfb_mjx.logs.alignment import nominal_command
from cfb_mjx.logs.flight_log import REQUIRED, FlightLog, quantise_time
from cfb_mjx.logs.motion_capture import Capture, compared, with_pose_of
from cfb_mjx.logs.streams import Stream, central_difference, fresh, hold, neighbours
from cfb_mjx.logs.variables import Choice, VariableMap

_DERIVED = {
    "velocity": "velocity: not logged; central differences of the positions, which look one sample ahead and carry "
    "their noise. Log stateEstimate.vx vy vz.",
    "body_rate": "body rate: not logged; central differences of the attitude, with its delay and smoothing. Log "
    "gyro.x y z.",
    "specific_force": "specific force: not logged; central differences of the velocity plus gravity, in body axes, "
    "with the velocity's delay and smoothing. Log acc.x y z.",
    "command": "command: not logged; computed as the command that a nominal motor of the Crazyflie needs for these "
    "rotor speeds. Log the duty.",
}
_GRAVITY = np.array([0.0, 0.0, 9.81])
_LATE = 0.002  # s; a held pose older than this on average gets a note (a quarter of the default observation delay)
COMMAND_NOTE = (
    "motor.m1..m4 is the command sent to the ESC: after battery compensation and thrust limit, where the firmware has "
    "them."
)


@dataclasses.dataclass
class Import:
    """Streams read by an importer, with its notes and warnings.

    Attributes:
        format: name of the format.
        streams: streams with time in s on one clock.
        preferred: name of the stream whose rows become the rows of the log, if it holds the gyro.
        notes: facts about the data.
        warnings: reasons to doubt the data.
        metadata: further entries for the log's metadata.
    """

    format: str
    streams: list[Stream]
    preferred: str | None = None
    notes: list[str] = dataclasses.field(default_factory=list)
    warnings: list[str] = dataclasses.field(default_factory=list)
    metadata: dict = dataclasses.field(default_factory=dict)


def assemble(read: Import, mapping: VariableMap, path: Path) -> FlightLog:
    """Merge the streams onto the rows of the one that holds the gyro. Samples of other streams are held.

    Rows before the first sample of a required variable are dropped, and so are rows whose required sample is older than
    three intervals of its stream + 0.5 ms (a pause becomes a gap). A rotor speed of that age becomes NaN. A battery
    voltage is held at any age; rows before its first sample get the first sample.

    Args:
        read: the streams.
        mapping: assigns variables to columns.
        path: the file, for messages and metadata.

    Raises:
        CfbError: required variables are missing (all are listed), or fewer than two rows remain.
    """
    streams = [s for s in read.streams if len(s.time)]
    home = _homes(streams)
    spoiled = _spoiled_quaternions(streams, mapping, home)
    read.notes.extend(f"{v} was sent as float32, which cannot hold its 32 bits; it was not used." for v in spoiled)
    chosen = mapping.choose(set(home) - set(spoiled), path)
    reference = _reference(streams, home, chosen, read.preferred)
    for name in reference.values:
        home[name] = reference
    merger = _Merger(reference, home, chosen)
    fields = {f: merger.field(f, c) for f, c in chosen.items() if not c.derived}
    _into_frames(fields, chosen)
    for field, choice in chosen.items():
        if choice.derived:
            fields[field] = merger.derived(field, fields)
            parts = mapping.logged_parts(field, home)
            beside = f" ({', '.join(parts)} alone is not sufficient.)" if parts else ""
            held = (
                f" {merger.beyond:.1%} of the commands were outside [0, 1] and were clipped." if merger.beyond else ""
            )
            read.warnings.append(_DERIVED[field] + beside + (held if field == "command" else ""))
    battery = _backfilled(fields["battery_voltage"][:, 0]) if "battery_voltage" in fields else None
    keep = np.all([merger.usable[f] for f in chosen if f in REQUIRED], axis=0)
    if keep.sum() < 2:
        raise CfbError(
            f"{path}: {int(keep.sum())} of {len(keep)} rows of {reference.name} have every required variable, at least "
            "2 are needed; log all of them during the same time."
        )
    rows = reference.time[keep]
    fields = {f: v[keep] for f, v in fields.items()}
    rotor_speed = fields.get("rotor_speed")
    if rotor_speed is not None and np.isnan(rotor_speed).all():
        rotor_speed = None
    held = merger.report()
    if (late := max((held[s.name]["mean_age_ms"] for s in merger.poses(chosen)), default=0.0)) > _LATE * 1e3:
        read.notes.append(
            f"pose or velocity are held; the samples are {late:.1f} ms old on average, which adds to the observation "
            "delay."
        )
    names = ("position", "velocity", "quaternion", "body_rate", "specific_force", "command")
    log = FlightLog(
        time=quantise_time(rows - rows[0]),
        **{f: fields[f] for f in names},
        rotor_speed=rotor_speed,
        battery_voltage=None if battery is None else battery[keep],
        metadata={
            "name": path.stem,
            "source": path.name,
            "format": read.format,
            "observation_delay": mapping.observation_delay,
            "firmware": {**mapping.firmware, "command": COMMAND_NOTE},
            "variables": {"mapping": mapping.name, **{f: c.report() for f, c in chosen.items()}},
            "merging": {
                "rows_of": reference.name,
                "held": held,
                "dropped_rows": int((~keep).sum()),
                "time_of_first_row": float(rows[0]),
            },
            **read.metadata,
        },
    )
    log = log.replace(metadata={"notes": read.notes, "warnings": read.warnings})
    return _with_capture(log, home, chosen, mapping, path)


def _with_capture(
    log: FlightLog, home: dict[str, Stream], chosen: dict[str, Choice], mapping: VariableMap, path: Path
) -> FlightLog:
    """The log with pose and velocity by motion capture if requested; else with a note if motion capture differs."""
    for choices in mapping.motion_capture:
        names = [name for choice in choices for name in choice.variables]
        if not all(name in home for name in names) or len({home[name].name for name in names}) > 1:
            continue
        if not mapping.by_motion_capture and chosen["quaternion"].variables == choices[1].variables:
            return log
        stream = home[names[0]]
        pose = (_in_si(np.stack([stream.values[v] for v in choice.variables], axis=1), choice) for choice in choices)
        capture = Capture(stream.time - log.metadata["merging"]["time_of_first_row"], *pose)
        if mapping.by_motion_capture:
            return with_pose_of(log, capture)
        try:
            said = compared(log, with_pose_of(log, capture))
        except CfbError:  # Motion capture was not requested, and is not usable (positions without attitude, say).
            return log
        return log.replace(metadata={"notes": [*log.metadata["notes"], said]}) if said else log
    if mapping.by_motion_capture:
        wanted = " or ".join(" ".join(v for c in choices for v in c.variables) for choices in mapping.motion_capture)
        raise CfbError(
            f"{path}: no motion capture with position and attitude was logged ({wanted or 'the mapping names none'}); "
            "leave out --motion-capture to take the estimate."
        )
    return log


def _homes(streams: Sequence[Stream]) -> dict[str, Stream]:
    """Variable to the stream with the most samples of it."""
    home: dict[str, Stream] = {}
    for stream in streams:
        for name in stream.values:
            if name not in home or len(stream.time) > len(home[name].time):
                home[name] = stream
    return home


def _spoiled_quaternions(streams, mapping: VariableMap, home: dict[str, Stream]) -> list[str]:
    compressed = [c.variables[0] for c in mapping.choices.get("quaternion", ()) if c.form == "compressed"]
    return [name for name in compressed if name in home and home[name].float32]


def _reference(streams, home, chosen: dict[str, Choice], preferred: str | None) -> Stream:
    # Without a gyro, the rates are derived from the quaternion.
    gyro = chosen["body_rate"].variables or chosen["quaternion"].variables
    for stream in streams:
        if stream.name == preferred and all(v in stream.values for v in gyro):
            return stream
    return home[gyro[0]]


class _Merger:
    """Brings variables onto the rows of the reference stream, field by field, and records which rows are usable."""

    def __init__(self, reference: Stream, home: dict[str, Stream], chosen: dict[str, Choice]):
        self.reference, self.home, self.chosen = reference, home, chosen
        self.usable: dict[str, np.ndarray] = {}
        self.beyond = 0.0  # share of derived commands outside [0, 1], which were clipped
        self._held: dict[str, tuple[Stream, np.ndarray, np.ndarray]] = {}

    def field(self, field: str, choice: Choice) -> np.ndarray:
        """(rows, columns) in SI units, not yet rotated; NaN where a variable has no sample."""
        columns, usable = zip(*(self._column(v) for v in choice.variables), strict=True)
        self.usable[field] = np.all(usable, axis=0)
        raw = np.stack(columns, axis=1)
        if field != "rotor_speed":
            # A cell without a value, for example "nan" written by a script, is unknown in that row.
            self.usable[field] &= ~np.isnan(raw).any(axis=1)
        if field == "rotor_speed":
            raw = np.where(self.usable[field][:, None] & ~np.isin(raw, choice.invalid), raw, np.nan)
        elif choice.invalid:
            bad = np.isin(raw, choice.invalid).any(axis=1)
            self.usable[field] &= ~bad
        return _in_si(raw, choice)

    def derived(self, field: str, fields: dict[str, np.ndarray]) -> np.ndarray:
        """(rows, columns) of a field that was not logged, computed from the samples of another field."""
        if field == "body_rate":
            source, unit = self._samples("quaternion", fields)
            rate = _turning_rate(source, rotation.tidy(unit))
            rate, self.usable[field] = self._place_all(source, rate)
            return rate
        if field == "command":
            # All four rotor speeds of a row were read at the same time.
            speed = fields["rotor_speed"]
            known = np.all(np.isfinite(speed), axis=1)
            self.usable[field] = known
            needed = nominal_command(self.reference.time, np.where(known[:, None], speed, 0.0))
            command = np.clip(needed, 0.0, 1.0)
            self.beyond = float(np.mean((needed != command)[known])) if known.any() else 0.0
            return command
        if field == "velocity":
            source, position = self._samples("position", fields)
            velocity, self.usable[field] = self._place_all(source, central_difference(source, position))
            return velocity
        source, velocity = self._samples("velocity", fields)
        acceleration, ok = self._place_all(source, central_difference(source, velocity))
        self.usable[field] = ok & self.usable["quaternion"]
        return rotation.to_body(rotation.tidy(_held_where(fields["quaternion"], ok)), acceleration + _GRAVITY)

    def _samples(self, field: str, fields: dict[str, np.ndarray]) -> tuple[Stream, np.ndarray]:
        """A vector at its own samples: its stream without repeated samples, and the values there in SI units.

        For a vector whose columns come from several streams, or are in body axes, the rows of the log are used instead.
        """
        choice = self.chosen[field]
        if choice.derived:
            source, values = self._samples(choice.derived, fields)
            return source, central_difference(source, values)
        homes = {self.home[v].name for v in choice.variables}
        if len(homes) == 1 and choice.frame != "body":
            stream = self.home[choice.variables[0]]
            values = _in_si(np.stack([stream.values[v] for v in choice.variables], axis=1), choice)
            keep = fresh(values) & np.isfinite(values).all(axis=1)
            # The name differs from the stream's, because its held samples have ages of their own.
            return dataclasses.replace(stream, name=f"{stream.name}: {field}", time=stream.time[keep]), values[keep]
        keep = self.usable[field]
        return Stream(f"rows: {field}", self.reference.time[keep], {}), fields[field][keep]

    def _place_all(self, source: Stream, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        columns, usable = zip(*(self._place(source, column) for column in values.T), strict=True)
        placed = np.stack(columns, axis=1)
        return placed, np.all(usable, axis=0) & np.isfinite(placed).all(axis=1)

    def _column(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        stream = self.home[name]
        return self._place(stream, stream.values[name])

    def _place(self, stream: Stream, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if stream is self.reference:
            return values, np.ones(len(values), dtype=bool)
        if stream.name not in self._held:
            self._held[stream.name] = (stream, *hold(stream, self.reference.time))
        _, index, age = self._held[stream.name]
        return np.where(np.isnan(age), np.nan, values[index]), np.isfinite(age)

    def poses(self, chosen: dict[str, Choice]) -> list[Stream]:
        """The held streams that position, velocity and quaternion come from."""
        names = {v for f in ("position", "velocity", "quaternion") for v in chosen[f].variables}
        return [s for s, *_ in self._held.values() if names & set(s.values)]

    def report(self) -> dict:
        """For each held stream, its interval and the ages of the samples used, ms."""
        out = {}
        for name, (stream, _, age) in self._held.items():
            fresh = age[np.isfinite(age)]
            out[name] = {
                "interval_ms": round(stream.interval * 1e3, 6),
                "mean_age_ms": round(float(fresh.mean()) * 1e3, 6) if len(fresh) else 0.0,
                "max_age_ms": round(float(fresh.max()) * 1e3, 6) if len(fresh) else 0.0,
                "rows_before_first": int(np.isnan(age).sum()),
                "rows_too_old": int(np.isinf(age).sum()),
            }
        return out


def _in_si(raw: np.ndarray, choice: Choice) -> np.ndarray:
    """Logged numbers (n, columns) in SI units, every form of attitude as a quaternion. Not yet rotated."""
    if choice.form == "compressed":
        return decompress_quaternion(raw[:, 0])
    values = raw * choice.factors
    return rotation.from_euler(values) if choice.form == "euler" else values


def _turning_rate(source: Stream, quaternion: np.ndarray) -> np.ndarray:
    """Body rate, rad/s, (n, 3): rotation between the samples before and after each one, over the time between them."""
    before, after, span = neighbours(source)
    turned = rotation.multiply(rotation.conjugate(quaternion[before]), quaternion[after])
    # The sample is in the middle of this rotation, so its vector is right in the sample's axes to second order.
    return rotation.rotation_vector(turned) / np.where(span > 0, span, np.nan)[:, None]


def _held_where(quaternion: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The quaternions, with the identity where they are not known."""
    fine = known & (np.linalg.norm(quaternion, axis=1) > 0)
    return np.where(fine[:, None], quaternion, [1.0, 0.0, 0.0, 0.0])


def _into_frames(fields: dict[str, np.ndarray], chosen: dict[str, Choice]) -> None:
    """Rotate a velocity logged in body axes to the world, and a specific force logged in world axes to the body."""
    if chosen["velocity"].frame != "body" and chosen["specific_force"].frame != "world":
        return
    norm = np.linalg.norm(fields["quaternion"], axis=1, keepdims=True)
    q = fields["quaternion"] / np.where(norm > 0, norm, np.nan)
    if chosen["velocity"].frame == "body":
        fields["velocity"] = rotation.to_world(q, fields["velocity"])
    if chosen["specific_force"].frame == "world":
        fields["specific_force"] = rotation.to_body(q, fields["specific_force"])


def _backfilled(values: np.ndarray) -> np.ndarray | None:
    known = np.flatnonzero(~np.isnan(values))
    if not len(known):
        return None
    return np.where(np.arange(len(values)) < known[0], values[known[0]], values)


def decompress_quaternion(packed: np.ndarray) -> np.ndarray:
    """Unit quaternions ``[w, x, y, z]`` (n, 4) from the firmware's 32-bit form (n,); NaN stays NaN.

    The two top bits give the index of the largest of x, y, z, w, which is positive and left out. The others follow in
    that order with ten bits each: a sign and nine bits of magnitude in units of 1 / (511 sqrt 2). The resolution is
    0.0014, about 0.2 degrees. Source: ``quatcompress.h`` of bitcraze/crazyflie-firmware (J. A. Preiss).
    """
    packed = np.asarray(packed, dtype=np.float64)
    valid = (packed >= 0) & (packed < 2.0**32)
    bits = np.where(valid, packed, 0.0).astype(np.uint64)
    largest = (bits >> np.uint64(30)).astype(int)
    small = np.empty((len(bits), 3))
    for i, shift in enumerate((20, 10, 0)):
        part = (bits >> np.uint64(shift)) & np.uint64(0x3FF)
        small[:, i] = (part & np.uint64(0x1FF)) / (511.0 * np.sqrt(2.0)) * np.where(part >> np.uint64(9), -1.0, 1.0)
    rest = np.sqrt(np.maximum(1.0 - np.sum(small**2, axis=1), 0.0))
    xyzw = np.empty((len(bits), 4))
    for k in range(4):
        others = [i for i in range(4) if i != k]
        mine = largest == k
        xyzw[np.ix_(mine, others)] = small[mine]
        xyzw[mine, k] = rest[mine]
    return np.where(valid[:, None], xyzw[:, [3, 0, 1, 2]], np.nan)
