"""Arrays by name, and mappings proposed for names of one's own."""

import io
import zipfile

import numpy as np
import pytest
import scipy.io
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log, rotation
from cfb_mjx.logs.proposal import UnknownNames, propose
from cfb_mjx.logs.variables import load_mapping


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=4.0, rate=200.0)


def roll_pitch_yaw(q):
    w, x, y, z = q.T
    return np.degrees(
        [
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(2 * (w * y - z * x)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ]
    )


def habits(log):
    """The flight under the names of several people."""
    p, v, q, w = log.position, log.velocity, log.quaternion, log.body_rate
    f, u, s = log.specific_force, log.command, log.rotor_speed
    xyz = lambda stem, values: {stem.format(a): c for a, c in zip("xyz", values.T, strict=True)}  # noqa: E731
    four = lambda stem, values: {stem.format(i): c for i, c in enumerate(values.T, 1)}  # noqa: E731
    quat = lambda stem: {stem.format(a): c for a, c in zip("wxyz", q.T, strict=True)}  # noqa: E731
    return {
        "bare": {"time": log.time} | xyz("{}", p) | xyz("v{}", v) | quat("q{}") | xyz("gyro{}", np.degrees(w))
        | xyz("acc{}", f / 9.81) | four("m{}", np.round(65535 * u)),
        "long": {"t": log.time} | xyz("position_{}", p) | xyz("linear_velocity_{}", v) | quat("orientation_{}")
        | xyz("angular_velocity_{}", w) | xyz("linear_acceleration_{}", f) | four("motor_{}", 100 * u)
        | four("rpm{}", s * 30 / np.pi),
        "with units": {"Time (s)": log.time} | xyz("pos.{} [m]", p) | xyz("vel.{} [m/s]", v) | quat("quat.{}")
        | xyz("omega.{} [rad/s]", w) | xyz("accel.{} [m/s^2]", f) | four("cmd{}", u) | {"vbat": 3900 + 0 * log.time},
        "simulator": {"time": log.time} | xyz("{}", p) | xyz("{}dot", v) | quat("q{}") | xyz("w{}", w) | four("u{}", u),
        "one prefix": {"timeTick": 4e5 + 1e3 * log.time} | xyz("state{}", p) | xyz("stateV{}", v)
        | dict(zip(("roll", "pitch", "yaw"), roll_pitch_yaw(q), strict=True)) | four("motor{}", np.round(65535 * u))
        | dict(zip(("roll rate", "pitch rate", "yaw rate"), w.T, strict=True)) | {"voltage": 4.0 + 0 * log.time},
        "thrust beside duty": {"time[ms]": 1e3 * log.time} | xyz("{}[m]", p) | xyz("v{}[m/s]", v) | xyz("a{}[m/s^2]", f)
        | quat("q{}") | four("u{}[N]", 0.2 * u) | four("u{}[PWM]", u) | xyz("w{}[rad/s]", w),
        "angles": {"timestamp_ms": 1e3 * log.time} | xyz("p{}", p)
        | dict(zip(("roll", "pitch", "yaw"), roll_pitch_yaw(q), strict=True)) | four("motor{}", u),
    }  # fmt: skip


@pytest.mark.parametrize(
    "name", ["bare", "long", "with units", "simulator", "one prefix", "thrust beside duty", "angles"]
)
def test_a_mapping_is_proposed_and_reads_the_flight(flight, tmp_path, name):
    columns = habits(flight)[name]
    path = tmp_path / "mine.csv"
    rows = np.stack(list(columns.values()), axis=1)
    path.write_text("\n".join([",".join(columns), *(",".join(repr(float(x)) for x in row) for row in rows), ""]))
    with pytest.raises(UnknownNames, match=r"mine\.csv: its columns have unknown names, .*--mapping FILE") as error:
        read_log(path)
    proposed = tmp_path / "mine.yaml"
    proposed.write_text(error.value.mapping)
    load_mapping(proposed)
    log = read_log(path, mapping=proposed)
    inner = slice(2, len(log) - 2)
    assert np.abs(log.position - flight.position).max() < 1e-6
    assert np.abs(log.velocity - flight.velocity)[inner].max() < 0.05
    assert np.abs(log.body_rate - flight.body_rate)[inner].max() < 0.25  # derived from the attitude in the last
    assert np.abs(log.specific_force - flight.specific_force)[inner].max() < 1.5
    assert np.abs(log.command - flight.command).max() < 1e-4
    assert (log.rotor_speed is not None) == (name == "long")
    if name == "with units":
        assert log.battery_voltage[0] == pytest.approx(3.9)


def test_what_is_no_flight_gets_no_proposal():
    n = np.zeros(5)
    assert propose({"t": n, "x": n, "y": n, "z": n}) is None  # no attitude, no commands
    assert (
        propose({"x": n, "y": n, "z": n, "qw": n, "qx": n, "qy": n, "qz": n, "m1": n, "m2": n, "m3": n, "m4": n})
        is None
    )


def arrays(log):
    return {
        "time": log.time,
        "pos": log.position,
        "vel": log.velocity,
        "quat": log.quaternion,
        "gyro": log.body_rate,
        "acc": log.specific_force.T,
        "cmd": log.command,
        "dt": np.array(0.005),
    }


@pytest.mark.parametrize("ending", [".npz", ".mat"])
def test_arrays_by_name(flight, tmp_path, ending):
    path = tmp_path / f"flight{ending}"
    if ending == ".npz":
        np.savez(path, **arrays(flight))
    else:
        scipy.io.savemat(path, arrays(flight))
    with pytest.raises(UnknownNames) as error:
        read_log(path)
    mapping = tmp_path / "mine.yaml"
    mapping.write_text(error.value.mapping)
    log = read_log(path, mapping=mapping)
    for field in ("position", "velocity", "quaternion", "body_rate", "specific_force", "command"):
        assert np.abs(getattr(log, field) - getattr(flight, field)).max() < 1e-9, field


def test_a_quaternion_with_its_scalar_last(flight, tmp_path):
    """As SciPy has it, and simulators after it."""
    path = tmp_path / "flight.npz"
    np.savez(path, **(arrays(flight) | {"quat": np.roll(flight.quaternion, -1, axis=1)}))
    with pytest.raises(UnknownNames) as error:
        read_log(path)
    mapping = tmp_path / "mine.yaml"
    mapping.write_text(error.value.mapping)
    log = read_log(path, mapping=mapping)
    assert np.abs(log.quaternion - flight.quaternion).max() < 1e-9
    assert any("array quat was read as a quaternion x, y, z, w" in note for note in log.metadata["notes"])


def test_arrays_of_simulators_in_worlds_and_drones(flight, tmp_path):
    """As crazyflow keeps them: (steps, worlds, drones, k), scalar last, the rate in world axes."""
    path = tmp_path / "flight.npz"

    def saved(copies=1, **changes):
        states = {
            "pos": flight.position,
            "quat": np.roll(flight.quaternion, -1, axis=1),
            "vel": flight.velocity,
            "ang_vel": rotation.to_world(flight.quaternion, flight.body_rate),
            "rotor_vel": flight.rotor_speed,
        }
        shaped = {name: np.repeat(v[:, None, None, :], copies, axis=1) for name, v in states.items()}
        np.savez(path, **({"time": flight.time} | shaped | changes))

    saved()
    with pytest.raises(UnknownNames) as error:
        read_log(path)
    mapping = tmp_path / "mine.yaml"
    mapping.write_text(error.value.mapping)
    with pytest.raises(CfbError, match="--fix gyro-frame=world"):
        read_log(path, mapping=mapping)
    log = read_log(path, mapping=mapping, fix=["gyro-frame=world"])
    assert np.abs(log.body_rate - flight.body_rate[: len(log)]).max() < 1e-9
    saved(copies=3)
    with pytest.raises(CfbError, match=r"array \w+ has shape \(800, 3, [34]\), so it holds several drones"):
        read_log(path)


def test_arrays_without_motors_are_told_what_they_lack(flight, tmp_path):
    path = tmp_path / "flight.npz"
    np.savez(path, time=flight.time, pos=flight.position, quat=flight.quaternion, cmd_f=flight.time * 0)
    with pytest.raises(
        CfbError, match=r"has arrays time, pos\.x, .* to hold motors \(commands or rotor speeds\); record"
    ):
        read_log(path)


def test_arrays_in_the_tabular_layout_need_no_mapping(flight, tmp_path):
    path = tmp_path / "flight.npz"
    names = {"p": "position", "v": "velocity", "q": "quaternion", "w": "body_rate", "a": "specific_force"}
    columns = {}
    for letter, field in names.items():
        values = getattr(flight, field)
        axes = "wxyz"[-values.shape[1] :]
        columns |= {f"{letter}{axis}": column for axis, column in zip(axes, values.T, strict=True)}
    np.savez(path, t=flight.time, **columns, **{f"u{i + 1}": flight.command[:, i] for i in range(4)})
    assert np.abs(read_log(path).velocity - flight.velocity).max() < 1e-12


def bomb():
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("t.npy", "w", force_zip64=True) as file,
    ):
        for _ in range(300):
            file.write(bytes(1 << 20))
    return buffer.getvalue()


def objects():
    buffer = io.BytesIO()
    np.savez(buffer, t=np.array([{"a": 1}], dtype=object))
    return buffer.getvalue()


def short():
    buffer = io.BytesIO()
    np.savez(buffer, t=np.zeros(1000))
    return buffer.getvalue()[:2000]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (bomb, "would take 300 MiB"),
        (objects, "Python objects in place of numbers"),
        (short, "is damaged or cut short"),
        (lambda: b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + bytes(20), "MATLAB file"),
    ],
    ids=["bomb", "objects", "short", "mat"],
)
def test_archives_that_are_not_read(tmp_path, data, said):
    path = tmp_path / "flight.npz"
    path.write_bytes(data())
    with pytest.raises(CfbError, match=said) as error:
        read_log(path)
    assert "\n" not in str(error.value)


def test_a_log_of_gym_pybullet_drones(flight, tmp_path):
    """States (drones, 16, steps): Euler angles, angular velocity in the world, rpm; no commands."""
    from cfb_mjx.logs import rotation

    world = rotation.to_world(flight.quaternion, flight.body_rate)
    angles = np.radians(roll_pitch_yaw(flight.quaternion))
    rpm = flight.rotor_speed.T * 30 / np.pi
    states = np.concatenate([flight.position.T, flight.velocity.T, angles, world.T, rpm])[None]
    path = tmp_path / "flight.npz"
    np.savez(path, timestamps=flight.time[None], states=states, controls=np.zeros((1, 12, len(flight))))
    with pytest.raises(UnknownNames) as error:
        read_log(path)
    mapping = tmp_path / "mine.yaml"
    mapping.write_text(error.value.mapping)
    log = read_log(path, mapping=mapping)
    assert np.abs(log.body_rate - flight.body_rate).max() < 1e-9
    assert np.abs(log.rotor_speed - flight.rotor_speed).max() < 1e-6
    assert np.abs(log.command - flight.command)[5:-5].max() < 0.06
    assert sum("not logged" in warning for warning in log.metadata["warnings"]) == 2
    np.savez(path, timestamps=np.zeros((2, 5)), states=np.zeros((2, 16, 5)))
    with pytest.raises(CfbError, match="the flights of 2 drones"):
        read_log(path)


def test_a_log_of_rotorpy(flight, tmp_path):
    """RotorPy writes r1..r4 in rad/s and no accelerometer."""
    columns = {"time": flight.time}
    columns |= dict(zip("xyz", flight.position.T, strict=True))
    columns |= {f"{a}dot": c for a, c in zip("xyz", flight.velocity.T, strict=True)}
    columns |= {f"q{a}": c for a, c in zip("wxyz", flight.quaternion.T, strict=True)}
    columns |= {f"w{a}": c for a, c in zip("xyz", flight.body_rate.T, strict=True)}
    columns |= {f"wind{a}": 0 * flight.time for a in "xyz"} | {
        f"r{i}": c for i, c in enumerate(flight.rotor_speed.T, 1)
    }
    path = tmp_path / "flight.csv"
    rows = np.stack(list(columns.values()), axis=1)
    path.write_text("\n".join([",".join(columns), *(",".join(repr(float(x)) for x in row) for row in rows), ""]))
    with pytest.raises(UnknownNames) as error:
        read_log(path)
    mapping = tmp_path / "mine.yaml"
    mapping.write_text(error.value.mapping)
    log = read_log(path, mapping=mapping)
    assert np.abs(log.velocity - flight.velocity).max() < 1e-9
    assert np.abs(log.rotor_speed - flight.rotor_speed).max() < 1e-6
    assert np.abs(log.specific_force - flight.specific_force)[3:-3].max() < 1.0
