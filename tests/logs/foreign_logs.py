"""Writers of other people's log formats, sharing nothing with the readers: from a `FlightLog` to firmware variables."""

import csv
import json
import struct
import zlib
from types import SimpleNamespace

import numpy as np
import yaml
from mcap_ros2.writer import Writer

# Variables by log block with the C type that the firmware gives them, as characters of the struct module.
STATE = {f"stateEstimate.{v}": "f" for v in ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz")}
STATE_Z = {f"stateEstimateZ.{v}": "h" for v in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")} | {
    "stateEstimateZ.quat": "I",
    **{f"stateEstimateZ.{v}": "h" for v in ("rateRoll", "ratePitch", "rateYaw")},
}
IMU = {f"{g}.{a}": "f" for g in ("gyro", "acc") for a in "xyz"}
MOTOR = {f"motor.m{i}": "I" for i in range(1, 5)}
RPM = {f"motor.m{i}_rpm": "H" for i in range(1, 5)}
BATTERY = {"pm.vbat": "f"}
_WHOLE = "bBhHiIqQ"


def firmware_variables(log) -> dict[str, np.ndarray]:
    """Every variable above as the firmware would log it, in its units, before it is packed."""
    x = {}
    for i, a in enumerate("xyz"):
        x[f"stateEstimate.{a}"] = log.position[:, i]
        x[f"stateEstimate.v{a}"] = log.velocity[:, i]
        x[f"gyro.{a}"] = np.rad2deg(log.body_rate[:, i])
        x[f"acc.{a}"] = log.specific_force[:, i] / 9.81
        x[f"stateEstimateZ.{a}"] = 1000 * log.position[:, i]
        x[f"stateEstimateZ.v{a}"] = 1000 * log.velocity[:, i]
    for i, a in enumerate("wxyz"):
        x[f"stateEstimate.q{a}"] = log.quaternion[:, i]
    for i, a in enumerate(("rateRoll", "ratePitch", "rateYaw")):
        x[f"stateEstimateZ.{a}"] = 1000 * log.body_rate[:, i] * (-1 if a == "ratePitch" else 1)
    matrices = rotation_matrices(log.quaternion)
    for i, a in enumerate("xyz"):
        x[f"stateEstimateZ.a{a}"] = 1000 * np.einsum("nij,nj->ni", matrices, log.specific_force)[:, i]
    x["stateEstimateZ.quat"] = np.array([compress_quaternion(q) for q in log.quaternion], dtype=np.float64)
    for i in range(4):
        x[f"motor.m{i + 1}"] = 65535 * log.command[:, i]
        if log.rotor_speed is not None:
            rpm = log.rotor_speed[:, i] * 60 / (2 * np.pi)
            x[f"motor.m{i + 1}_rpm"] = np.where(np.isnan(rpm), 65535, rpm)
    if log.battery_voltage is not None:
        x["pm.vbat"] = log.battery_voltage
    roll = np.arctan2(matrices[:, 2, 1], matrices[:, 2, 2])
    pitch = np.arcsin(np.clip(-matrices[:, 2, 0], -1, 1))
    yaw = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    for name, angle in (("roll", roll), ("pitch", -pitch), ("yaw", yaw)):  # the old pitch: nose up is positive
        x[f"stabilizer.{name}"] = np.rad2deg(angle)
    return x


def rotation_matrices(q: np.ndarray) -> np.ndarray:
    """Body to world, from the textbook formula."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def compress_quaternion(q) -> int:
    """32 bits for ``[w, x, y, z]``: which of x, y, z, w is largest, then sign and nine bits of each of the others."""
    values = [q[1], q[2], q[3], q[0]]
    largest = max(range(4), key=lambda i: abs(values[i]))
    sign = -1.0 if values[largest] < 0 else 1.0
    packed = largest
    for i in range(4):
        if i != largest:
            v = sign * values[i]
            packed = packed << 10 | (v < 0) << 9 | int(511 * abs(v) * np.sqrt(2.0) + 0.5)
    return int(packed)


def event(log, variables, *, name="fixedFrequency", identifier=0xFFFF, every=1, delay=0.0, source=None):
    """An event type of a card log: every so-maniest row, stamped ``delay`` s after it."""
    data = firmware_variables(log) if source is None else source
    return SimpleNamespace(
        name=name,
        identifier=identifier,
        variables=dict(variables),
        time=log.time[::every] + delay,
        columns=[data[v][::every] for v in variables],
    )


def usd_card_bytes(events, version=2, start=12.5) -> bytes:
    """A whole card log; ``start`` is the time in s since the vehicle started."""
    out = bytearray(b"\xbc" + struct.pack("<HH", version, len(events)))
    for e in events:
        out += struct.pack("<H", e.identifier) + e.name.encode() + b"\0" + struct.pack("<H", len(e.variables))
        for variable, kind in e.variables.items():
            out += f"{variable}({kind})".encode() + b"\0"
    records = []
    for e in events:
        form = struct.Struct("<H" + "IQ"[version - 1] + "".join(e.variables.values()))
        kinds = list(e.variables.values())
        for t, *values in zip(e.time, *e.columns, strict=True):
            tick = round((start + t) * (1e6 if version == 2 else 1e3))
            packed = [round(float(v)) if k in _WHOLE else float(v) for v, k in zip(values, kinds, strict=True)]
            records.append((tick, form.pack(e.identifier, tick % 2**32 if version == 1 else tick, *packed)))
    for _, record in sorted(records, key=lambda r: r[0]):
        out += record
    return bytes(out) + struct.pack("<I", zlib.crc32(out))


def write_radio_csv(path, log, blocks, *, start_ms=4000, every=None, header="Timestamp", line_end="\n"):
    """One row per time stamp; cells of blocks that have no packet then stay empty.

    Args:
        blocks: lists of variable names. ``every``: of how many rows of the log each block has one.
    """
    data = firmware_variables(log)
    every = every or [1] * len(blocks)
    with open(path, "w", newline="") as stream:
        out = csv.writer(stream, lineterminator=line_end)
        out.writerow([header, *(v for block in blocks for v in block)])
        for k, t in enumerate(log.time):
            cells, filled = [], False
            for block, step in zip(blocks, every, strict=True):
                sent = k % step == 0
                filled |= sent
                cells += [repr(_as_sent(v, data[v][k])) if sent else "" for v in block]
            if filled:
                out.writerow([(start_ms + round(t * 1000)) % 2**24, *cells])


def _as_sent(name, value):
    kinds = STATE | STATE_Z | IMU | MOTOR | RPM | BATTERY
    return round(float(value)) if kinds.get(name, "f") in _WHOLE else float(np.float32(value))


_HEADER = """std_msgs/Header header
{rest}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_POSE = """================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_TWIST = """================================================================================
MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
================================================================================
MSG: geometry_msgs/TwistWithCovariance
geometry_msgs/Twist twist
float64[36] covariance
================================================================================
MSG: geometry_msgs/Twist
geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
DEFINITIONS = {
    "crazyflie_interfaces/msg/LogDataGeneric": _HEADER.format(rest="uint32 timestamp\nfloat32[] values"),
    "crazyflie_interfaces/msg/Status": _HEADER.format(rest="uint16 supervisor_info\nfloat32 battery_voltage"),
    "geometry_msgs/msg/PoseStamped": _HEADER.format(rest="geometry_msgs/Pose pose") + _POSE,
    "nav_msgs/msg/Odometry": _HEADER.format(
        rest="string child_frame_id\ngeometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist"
    )
    + _POSE
    + _TWIST,
}


class Bag:
    """Collects messages and writes them as a ROS 2 bag, in the order in which the computer got them."""

    def __init__(self, epoch=1_750_000_000.25, boot=100.0, doubles=False):
        """``epoch``: s since 1970 of the log's time 0; ``boot``: s since the vehicle started, then."""
        self.epoch, self.boot, self.messages = epoch, boot, []
        self.definitions = dict(DEFINITIONS)
        if doubles:
            key = "crazyflie_interfaces/msg/LogDataGeneric"
            self.definitions[key] = self.definitions[key].replace("float32[]", "float64[]")

    def _add(self, topic, kind, sent, late, content):
        stamp = round((self.epoch + sent + late) * 1e9)
        time = {"sec": stamp // 10**9, "nanosec": stamp % 10**9}
        self.messages.append((stamp, topic, kind, {"header": {"stamp": time, "frame_id": "world"}, **content}))

    def custom(self, topic, log, variables, *, every=1, late=0.004, stamped=True):
        """A custom log topic; ``late``: s (or a function of the row) that a packet is under way."""
        data = firmware_variables(log)
        for k in range(0, len(log), every):
            delay = late(k) if callable(late) else late
            tick = round((self.boot + log.time[k]) * 1000) % 2**24 if stamped else 0
            content = {"timestamp": tick, "values": [float(np.float64(data[v][k])) for v in variables]}
            self._add(topic, "crazyflie_interfaces/msg/LogDataGeneric", log.time[k], delay, content)

    def pose(self, topic, log, *, every=1, late=0.004):
        for k in range(0, len(log), every):
            delay = late(k) if callable(late) else late
            self._add(topic, "geometry_msgs/msg/PoseStamped", log.time[k], delay, {"pose": _pose(log, k)})

    def odometry(self, topic, log, *, every=1, late=0.004, degrees=True):
        """Twist in body axes, as nav_msgs asks for; rates in deg/s, as Crazyswarm2 sends them."""
        matrices = rotation_matrices(log.quaternion)
        covariance = [0.0] * 36
        for k in range(0, len(log), every):
            linear = matrices[k].T @ log.velocity[k]
            angular = np.rad2deg(log.body_rate[k]) if degrees else log.body_rate[k]
            twist = {"linear": _xyz(linear), "angular": _xyz(angular)}
            content = {
                "child_frame_id": "cf",
                "pose": {"pose": _pose(log, k), "covariance": covariance},
                "twist": {"twist": twist, "covariance": covariance},
            }
            self._add(topic, "nav_msgs/msg/Odometry", log.time[k], late, content)

    def status(self, topic, log, *, every=1):
        for k in range(0, len(log), every):
            content = {"supervisor_info": 0, "battery_voltage": float(log.battery_voltage[k])}
            self._add(topic, "crazyflie_interfaces/msg/Status", log.time[k], 0.004, content)

    def write(self, path, enable_crcs=True):
        with open(path, "wb") as stream:
            writer = Writer(stream, chunk_size=16 * 1024, enable_crcs=enable_crcs)
            kinds = {kind for _, _, kind, _ in self.messages}
            schemas = {kind: writer.register_msgdef(kind, self.definitions[kind]) for kind in sorted(kinds)}
            for stamp, topic, kind, content in sorted(self.messages, key=lambda m: m[0]):
                writer.write_message(topic, schemas[kind], content, stamp, stamp)
            writer.finish()


def _xyz(v):
    return dict(zip("xyz", map(float, v), strict=True))


def _pose(log, k):
    w, x, y, z = map(float, log.quaternion[k])
    return {"position": _xyz(log.position[k]), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def write_crazyflies_yaml(path, topics, robot="cf231"):
    """A crazyflies.yaml whose custom topics are spread over its three levels."""
    levels = [{}, {}, {}]
    for i, (name, variables) in enumerate(topics.items()):
        levels[i % 3][name] = {"frequency": 100, "vars": list(variables)}
    blocks = [{"firmware_logging": {"enabled": True, "custom_topics": level}} for level in levels]
    robots = {robot: {"enabled": True, "type": "cf21bl", **blocks[0]}, "cf5": {"enabled": False, "type": "cf21bl"}}
    document = {"fileversion": 3, "robots": robots, "robot_types": {"cf21bl": blocks[1]}, "all": blocks[2]}
    path.write_text(yaml.safe_dump(document))


def _filled(kind, content, store):
    """A message of the bag library from nested mappings."""
    from rosbags.interfaces import Nodetype

    values = {}
    for name, (node, detail) in store.get_msgdef(kind).fields:
        given = content.get(name)
        if node == Nodetype.NAME:
            values[name] = _filled(detail, given or {}, store)
        elif node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            values[name] = np.asarray(given, dtype=detail[0][1][0])
        else:
            values[name] = given if given is not None else ("" if detail[0] == "string" else 0)
    return store.types[kind](**values)


def write_sqlite(folder, messages, bits):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "crazyflie_interfaces/msg/LogDataGeneric"
    definition = f"std_msgs/Header header\nuint32 timestamp\nfloat{bits}[] values\n"
    store.register(get_types_from_msg(definition, kind))
    with Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {}
        for stamp, topic, kind, content in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], stamp, store.serialize_cdr(_filled(kind, content, store), kind))


def write_ros1(path, messages):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "crazyflie_driver/msg/GenericLogData"
    store.register(get_types_from_msg("std_msgs/Header header\nfloat64[] values\n", kind))
    with Writer(path) as writer:
        connections = {}
        for stamp, topic, name, content in messages:
            name = kind if "LogData" in name else name
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], stamp, store.serialize_ros1(_filled(name, content, store), name))


ULOG_TOPICS = {
    "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
    "actuator_motors": "uint64_t timestamp;float[4] control;",
    "battery_status": "uint64_t timestamp;float voltage_v;",
}
_DOWN = np.array([1.0, -1.0, -1.0])


def _ulog_message(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(log, topics=tuple(ULOG_TOPICS)):
    """The flight as PX4 writes it: north east down, forward right down, its own motor order."""
    values = {
        "vehicle_local_position": np.concatenate([log.position * _DOWN, log.velocity * _DOWN], axis=1),
        "vehicle_attitude": log.quaternion * [1, 1, -1, -1],
        "sensor_combined": np.concatenate([log.body_rate * _DOWN, log.specific_force * _DOWN], axis=1),
        "actuator_motors": log.command[:, [0, 2, 3, 1]],
        "battery_status": log.battery_voltage[:, None],
    }
    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + _ulog_message("B", bytes(40))
    data += b"".join(_ulog_message("F", f"{name}:{ULOG_TOPICS[name]}".encode()) for name in topics)
    data += b"".join(_ulog_message("A", struct.pack("<BH", 0, i) + name.encode()) for i, name in enumerate(topics))
    for row, time in enumerate(log.time):
        for i, name in enumerate(topics):
            numbers = values[name][row].astype("<f4").tobytes()
            data += _ulog_message("D", struct.pack("<HQ", i, round(1e6 * (5 + time))) + numbers)
    return data


START = 1_772_419_726_250_000_000  # ns: when messages of JSON and protobuf begin


def xyz(v):
    return dict(zip("xyz", map(float, v), strict=True))


def wxyz(q):
    return dict(zip("wxyz", map(float, q), strict=True))


def stamp(t, names=("sec", "nsec")):
    now = START + round(t * 1e9)
    return dict(zip(names, divmod(now, 1_000_000_000), strict=True))


def write_channels(path, channels, late=0.0, described=True):
    """``channels``: topic to (schema name, encoding, description, payloads by time)."""
    from mcap.writer import Writer

    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="a lab's recorder")
        for topic, (name, encoding, schema_data, payloads) in channels.items():
            kind = "jsonschema" if encoding == "json" else "protobuf"
            schema = writer.register_schema(name=name, encoding=kind, data=schema_data) if described else 0
            channel = writer.register_channel(topic=topic, message_encoding=encoding, schema_id=schema)
            for t, data in payloads:
                writer.add_message(channel, log_time=START + round((t + late) * 1e9), data=data, publish_time=0)
        writer.finish()


def as_json(log, make):
    return [(t, json.dumps(make(row, t)).encode()) for row, t in enumerate(log.time)]


def json_channels(log, transform=False, motors="motor"):
    """A flight in JSON messages of common schemas: a pose or a transform, IMU readings, a velocity, named motors."""

    def pose(row, t):
        return {
            "timestamp": stamp(t),
            "frame_id": "world",
            "pose": {"position": xyz(log.position[row]), "orientation": wxyz(log.quaternion[row])},
        }

    def placed(row, t):
        inner = {"translation": xyz(log.position[row]), "rotation": wxyz(log.quaternion[row])}
        return {"timestamp": stamp(t), "parent_frame_id": "world", "child_frame_id": "cf", "transform": inner}

    def imu(row, t):
        return {
            "header": {"stamp": stamp(t, ("sec", "nanosec")), "frame_id": "cf"},
            "angular_velocity": xyz(log.body_rate[row]),
            "linear_acceleration": xyz(log.specific_force[row]),
        }

    named = lambda row, t: {  # noqa: E731
        "timestamp": stamp(t), motors: {f"m{i}": float(round(65535 * u)) for i, u in enumerate(log.command[row], 1)}
    }  # fmt: skip
    velocity = lambda row, t: {"timestamp": stamp(t), "velocity": xyz(log.velocity[row])}  # noqa: E731
    place = ("FrameTransform", placed) if transform else ("foxglove.PoseInFrame", pose)
    return {
        "/tf" if transform else "/cf1/pose": (place[0], "json", b"{}", as_json(log, place[1])),
        "/cf1/imu": ("Imu", "json", b"{}", as_json(log, imu)),
        "/cf1/velocity": ("Twist", "json", b"{}", as_json(log, velocity)),
        "/cf1/log": ("Log", "json", b"{}", as_json(log, named)),
    }
