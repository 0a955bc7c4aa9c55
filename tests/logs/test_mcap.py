import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from synthetic_logs import make_flight, same_data

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import mcap_schema, read_log, read_mcap, validate, write_mcap


@pytest.fixture
def path(tmp_path):
    return tmp_path / "flight_03.mcap"


def rewrite(path, change):
    """Write the file again, message by message, through ``change(topic, row, message) -> message or None``."""
    with open(path, "rb") as stream:
        reader = make_reader(stream)
        messages = list(reader.iter_messages(log_time_order=False))
        records = list(reader.iter_metadata())
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start()
        for record in records:
            if (metadata := change("metadata", 0, dict(record.metadata))) is not None:
                writer.add_metadata(record.name, metadata)
        ids, rows = {}, {}
        for schema, channel, message in messages:
            topic = channel.topic
            row = rows[topic] = rows.get(topic, -1) + 1
            decoded = mcap_schema.message_class(schema.name, schema.data).FromString(message.data)
            decoded = change(topic, row, decoded)
            if decoded is None:
                continue
            if topic not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[topic] = writer.register_channel(topic, channel.message_encoding, number)
            writer.add_message(ids[topic], message.log_time, decoded.SerializeToString(), message.publish_time)
        writer.finish()


def test_round_trip_is_bit_exact(flight, path):
    speed = flight.rotor_speed.copy()
    speed[5, 1] = np.nan
    velocity = flight.velocity.copy()
    velocity[3] = -0.0, 5e-324, 1e300
    log = flight.replace(
        rotor_speed=speed, velocity=velocity, metadata={"notes": ["é", 1.5, None], "vehicle_mass": 0.045}
    )
    write_mcap(log, path)
    back = read_mcap(path)
    assert same_data(back, log)
    assert back.name == "flight_03"
    assert back.metadata["source"] == "flight_03.mcap"
    assert back.metadata["format"] == "mcap"
    assert back.metadata["origin"] == {"name": "synthetic", "source": "synthetic", "format": "memory"}
    assert back.metadata["notes"] == ["é", 1.5, None]
    assert back.metadata["vehicle_mass"] == 0.045
    assert back.observation_delay == 0.0
    write_mcap(back, path)
    assert read_mcap(path).metadata == back.metadata  # the first origin is kept


@pytest.mark.parametrize("offset", [0.0, -3.25, 1.7e9])
def test_time_before_zero_and_since_the_epoch(short, path, offset):
    log = short.replace(time=short.time + offset)
    write_mcap(log, path)
    assert np.abs(read_log(path).time - log.time).max() <= 1e-9 + np.spacing(abs(offset))


def test_optional_signals(short, path):
    log = short.replace(rotor_speed=None, battery_voltage=None)
    write_mcap(log, path)
    assert same_data(read_log(path), log)


def test_topics_and_schemas_describe_themselves(short, path):
    write_mcap(short, path)
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()} == mcap_schema.MESSAGES
        assert {s.encoding for s in summary.schemas.values()} == {"protobuf"}
        (record,) = reader.iter_metadata()
        schema, _, message = next(reader.iter_messages(topics="/pose"))
    assert record.name == "cfb_mjx.flight_log"
    assert "z up" in record.metadata["conventions"]
    assert json.loads(record.metadata["metadata"])["name"] == "synthetic"
    pose = mcap_schema.message_class(schema.name, schema.data).FromString(message.data)
    assert pose.frame_id == "world"
    assert pose.pose.orientation.w == short.quaternion[0, 0]
    numbers = {f.name: f.number for f in pose.DESCRIPTOR.fields}
    assert numbers == {"timestamp": 1, "frame_id": 2, "pose": 3}
    assert [f.name for f in pose.pose.orientation.DESCRIPTOR.fields] == ["x", "y", "z", "w"]


def test_failure_leaves_the_earlier_file(short, path, monkeypatch):
    write_mcap(short, path)
    before = path.read_bytes()
    monkeypatch.setattr(Writer, "finish", lambda self: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(CfbError, match="No space left"):
        write_mcap(short, path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_truncated(short, path):
    write_mcap(short, path)
    whole = path.read_bytes()
    for size in (len(whole) - 1, len(whole) // 2, 9):
        path.write_bytes(whole[:size])
        with pytest.raises(CfbError, match=r"flight_03\.mcap: the MCAP file is cut short"):
            read_log(path)


def test_corrupted(short, path):
    write_mcap(short, path)
    whole = bytearray(path.read_bytes())
    # Inside the metadata record, which no chunk checksum covers, and inside the compressed chunk.
    for position in (whole.index(b"SI units"), len(whole) // 2):
        damaged = whole.copy()
        damaged[position] ^= 0x20
        path.write_bytes(bytes(damaged))
        with pytest.raises(CfbError, match="the MCAP file is damaged"):
            read_log(path)


def test_not_an_mcap(path):
    path.write_bytes(b"no log at all")
    with pytest.raises(CfbError, match="this is not an MCAP file"):
        read_log(path)
    path.write_bytes(b"")
    with pytest.raises(CfbError, match="the file is empty"):
        read_log(path)
    path.unlink()
    with pytest.raises(CfbError, match="no such file"):
        read_log(path)


@pytest.mark.parametrize("topics", [["/pose", "/imu/data"], []])
def test_someone_elses_mcap(path, topics):
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        for topic in topics:
            schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", b"float64 x")
            writer.add_message(writer.register_channel(topic, "cdr", schema), 0, b"\0" * 12, 0)
        writer.finish()
    listed = ", ".join(sorted(topics)) or "none"
    with pytest.raises(CfbError, match=f"this MCAP has topics {listed}; it was not written by cfb_mjx"):
        read_log(path)


def test_different_rates(short, path):
    write_mcap(short, path)
    rewrite(path, lambda topic, row, m: None if topic == "/command" and row % 2 else m)
    with pytest.raises(CfbError, match=r"/command has 20 messages, /pose 40.*resample"):
        read_log(path)


def test_different_stamps(short, path):
    write_mcap(short, path)

    def late(topic, row, message):
        if topic == "/body_rate" and row == 4:
            message.timestamp.nanos += 5
        return message

    rewrite(path, late)
    with pytest.raises(CfbError, match=r"message 4 of /body_rate is at .*resample"):
        read_log(path)


def test_missing_topic(short, path):
    write_mcap(short, path)
    rewrite(path, lambda topic, row, m: None if topic == "/velocity" else m)
    with pytest.raises(CfbError, match="lacks the topic /velocity"):
        read_log(path)


def test_other_format_version(short, path):
    write_mcap(short, path)
    rewrite(path, lambda topic, row, m: m | {"format_version": "99"} if topic == "metadata" else m)
    with pytest.raises(CfbError, match=r"format version '99'.*update"):
        read_log(path)


def test_damaged_metadata(short, path):
    write_mcap(short, path)
    rewrite(path, lambda topic, row, m: m | {"metadata": "{"} if topic == "metadata" else m)
    with pytest.raises(CfbError, match="export the log again"):
        read_log(path)


def test_empty_log(short, path):
    write_mcap(short.rows(slice(0, 0)), path)
    with pytest.raises(CfbError, match="0 rows"):
        read_log(path)


@settings(max_examples=120, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_damaged_bytes_never_surprise(short, tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.mcap"
    write_mcap(short, path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))
    path.write_bytes(bytes(content[:cut]))
    try:
        log = read_log(path)
    except CfbError as error:
        message = str(error)
        assert message.count("damaged.mcap: ") == 1
        assert "\n" not in message
    else:
        assert same_data(log, short)  # checksums: what reads is what was written
        validate(log, path)


@settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    seed=st.integers(0, 3),
    rotor=st.booleans(),
    jitter=st.floats(0.0, 0.8),
    drop=st.floats(0.0, 0.3),
)
def test_any_log_survives(tmp_path_factory, seed, rotor, jitter, drop):
    log = make_flight(0.5, 100.0, seed, rotor_speed=rotor, jitter=jitter, drop=[(0.1, 0.1 + drop)])
    path = tmp_path_factory.getbasetemp() / "any.mcap"
    write_mcap(log, path)
    assert same_data(read_log(path), log)
