"""Files of other kinds are named for what they are, with the way on; ROS bags of every storage are read."""

import gzip
import io
import pickle
import zipfile

import foreign_logs as foreign
import numpy as np
import pytest
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log


def zipped(name):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(name, b"x")
    return buffer.getvalue()


def saved(save, *values, **named):
    buffer = io.BytesIO()
    save(buffer, *values, **named)
    return buffer.getvalue()


KINDS = {
    "a.csv": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "a Git LFS pointer", "git lfs pull"),
    "a.h5": (b"\x89HDF\r\n\x1a\n" + bytes(50), "HDF5", "h5py"),
    "a.rrd": (b"RRF2" + bytes(60), "rerun recording", "parquet"),
    "a.csv.gz": (gzip.compress(b"t\n1\n"), "gzip", "gunzip"),
    "a.xlsx": (zipped("xl/workbook.xml"), "Excel workbook", "csv"),
    "a.zip": (zipped("flight.csv"), "zip archive", "unpack"),
    "a.pkl": (pickle.dumps({"t": [0.0]}), "Python pickle", "can run any code"),
    "b.pkl": (pickle.dumps(np.zeros(3)), "NumPy pickle", "can run any code"),
    "a.json": (b'{"t": [0.0]}\n', "JSON", "parquet"),
    "a.html": (b"<!DOCTYPE html><html></html>", "HTML page", "login"),
    "a.npy": (saved(np.save, np.zeros(3)), "NumPy array", "parquet"),
    "a.mcap": (b"version https://git-lfs.github.com/spec/v1\n", "a Git LFS pointer", "git lfs pull"),
}


@pytest.mark.parametrize("name", KINDS)
def test_a_file_is_named_for_what_it_is(tmp_path, name):
    data, kind, remedy = KINDS[name]
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(CfbError) as refusal:
        read_log(path)
    message = str(refusal.value)
    assert message.startswith(f"{path}: this is ")
    assert kind in message
    assert remedy in message
    assert "damaged" not in message


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=2.0, rate=100.0)


IMU, MOTOR, STATE = list(foreign.IMU), list(foreign.MOTOR), list(foreign.STATE)


@pytest.fixture(scope="module")
def messages(flight):
    bag = foreign.Bag(doubles=True)
    bag.custom("/cf231/imu", flight, IMU + MOTOR)
    bag.custom("/cf231/state", flight, STATE)
    bag.pose("/cf231/pose", flight)
    return sorted(bag.messages, key=lambda m: m[0])


@pytest.fixture(scope="module")
def topics(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "crazyflies.yaml"
    foreign.write_crazyflies_yaml(path, {"imu": IMU + MOTOR, "state": STATE})
    return path


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("whole", [True, False])
def test_a_bag_in_sqlite_is_read(flight, messages, topics, tmp_path, bits, whole):
    foreign.write_sqlite(tmp_path / "bag", messages, bits)
    (database,) = (tmp_path / "bag").glob("*.db3")
    log = read_log(tmp_path / "bag" if whole else database, topics_yaml=topics)
    for field in ("position", "velocity", "body_rate", "specific_force"):
        assert np.abs(getattr(log, field) - getattr(flight, field)).max() < 1e-4, field
    assert any("no checksums" in note for note in log.metadata["notes"])
    with pytest.raises(CfbError, match=r"a ROS 2 bag in sqlite3 storage: no logged variables .*--topics-yaml"):
        read_log(database)


def test_a_bag_of_ros_1_is_read(flight, messages, tmp_path):
    path = tmp_path / "flight.bag"
    foreign.write_ros1(path, messages)
    names = tmp_path / "launch.yaml"
    names.write_text(
        f"genericLogTopics: [imu, state]\ngenericLogTopic_imu_Variables: {IMU + MOTOR}\n"
        f"genericLogTopic_state_Variables: {STATE}\n"
    )
    log = read_log(path, topics_yaml=names)
    for field in ("position", "velocity", "body_rate", "specific_force"):
        assert np.abs(getattr(log, field) - getattr(flight, field)).max() < 1e-4, field
    with pytest.raises(CfbError, match="a ROS 1 bag: no logged variables"):
        read_log(path)


def test_bags_that_cannot_be_read(tmp_path):
    database = tmp_path / "a.db3"
    database.write_bytes(b"SQLite format 3\0" + bytes(200))
    with pytest.raises(CfbError, match="this ROS 2 bag in sqlite3 storage cannot be read"):
        read_log(database)
    bag = tmp_path / "a.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n" + bytes(50))
    with pytest.raises(CfbError, match="this ROS 1 bag cannot be read"):
        read_log(bag)
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("a: 1\n")
    with pytest.raises(CfbError, match=r"holds no \.mcap and no \.db3"):
        read_log(folder)
