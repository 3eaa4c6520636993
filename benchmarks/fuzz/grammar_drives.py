"""Valid drives with known content: bags of robots, written by the libraries `mcap` and `rosbags`."""

from __future__ import annotations

import io
import math
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from app.errors import UnreadableUpload
from app.formats.format import SpooledFile
from app.formats.traces.declaration import TraceDeclaration
from app.formats.traces.read import read_trace
from app.formats.video import index_video, read_frames
from app.formats.video_file import ReadReport, VideoFile, VideoIndex, detect_video
from app.sensors.magnetometer_bar import BarDeclaration
from app.values import Floats
from benchmarks.fuzz.grammar import Check, Grammar, Rng
from benchmarks.fuzz.grammar_tables import chance, pick

_LEVELS = 12  # grey levels by which frames are told apart
SIZE_PX = (80, 64)


def grey_of(number: int) -> int:
    """Level of a frame, by its number."""
    return 16 + 18 * (number % _LEVELS)


# === Bags: messages in the order of recording, and how they are packed.


@dataclass(frozen=True, slots=True)
class _Sent:
    """A message with its topic and its time of recording. [ns since 1970]"""

    topic: str
    kind: str
    recorded_ns: int
    message: Any


@dataclass(frozen=True, slots=True)
class _Form:
    """How a bag is written."""

    container: str  # mcap, sqlite or ros1
    is_ros1: bool  # encoding of messages
    little_endian: bool
    publishers: int  # of each topic; each has a connection of its own


def _bag(rng: Rng) -> tuple[bytes, Check]:
    """Pictures and positions, or magnetic fields and speeds."""
    container = str(pick(rng, "mcap", "mcap", "sqlite", "ros1"))
    is_ros1 = container == "ros1" or (container == "mcap" and chance(rng, 0.3))
    form = _Form(
        container, is_ros1, is_ros1 or chance(rng, 0.7), int(pick(rng, 1, 1, 2)) if container != "sqlite" else 1
    )
    start_ns = 1_500_000_000_000_000_000 + int(rng.integers(0, 10**17))
    messages = _Messages(is_ros1)
    return (_pictures if chance(rng, 0.6) else _fields)(rng, form, messages, start_ns)


class _Messages:
    """Makes messages of one version of ROS."""

    def __init__(self, is_ros1: bool) -> None:
        self.store: Any = _store(is_ros1)
        self._types, self._is_ros1 = self.store.types, is_ros1

    def make(self, kind: str, *values: object) -> Any:
        """A message by the name of its type and its fields in order."""
        return self._types[kind](*values)

    def header(self, at_ns: int) -> Any:
        """With a stamp."""
        stamp = self.make("builtin_interfaces/msg/Time", at_ns // 10**9, at_ns % 10**9)
        values = (7, stamp, "base") if self._is_ros1 else (stamp, "base")
        return self.make("std_msgs/msg/Header", *values)

    def vector(self, x: float, y: float, z: float) -> Any:
        """Of three numbers."""
        return self.make("geometry_msgs/msg/Vector3", x, y, z)


@cache
def _store(is_ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)


def _write(rng: Rng, form: _Form, messages: _Messages, sent: list[_Sent]) -> tuple[bytes, bool]:
    """The bag, and whether it has an index by which it can be read."""
    sent = sorted(sent, key=lambda one: one.recorded_ns)
    if form.container == "mcap":
        return _write_mcap(rng, form, messages, sent)
    return (_write_sqlite if form.container == "sqlite" else _write_ros1)(rng, form, messages, sent), True


def _bytes_of(form: _Form, messages: _Messages, one: _Sent) -> bytes:
    if form.is_ros1:
        return bytes(messages.store.serialize_ros1(one.message, one.kind))
    return bytes(messages.store.serialize_cdr(one.message, one.kind, little_endian=form.little_endian))


def _write_mcap(rng: Rng, form: _Form, messages: _Messages, sent: list[_Sent]) -> tuple[bytes, bool]:
    from mcap.writer import CompressionType, IndexType, Writer

    has_summary = not chance(rng, 0.1)
    out = io.BytesIO()
    writer: Any = Writer(
        out, chunk_size=int(pick(rng, 500, 4096, 1 << 20)), compression=pick(rng, *CompressionType),
        use_chunking=chance(rng, 0.7),
        index_types=pick(rng, IndexType.ALL, IndexType.ALL, IndexType.CHUNK, IndexType.NONE),
        repeat_channels=has_summary, repeat_schemas=has_summary, use_statistics=chance(rng, 0.8),
        use_summary_offsets=chance(rng), enable_crcs=chance(rng),
    )  # fmt: skip
    writer.start(profile="ros1" if form.is_ros1 else "ros2")
    channels: dict[tuple[str, int], int] = {}
    for number, one in enumerate(sent):
        key = (one.topic, number % form.publishers)
        if key not in channels:
            name = one.kind.replace("/msg/", "/") if form.is_ros1 else one.kind
            schema = writer.register_schema(name, "ros1msg" if form.is_ros1 else "ros2msg", b"")
            channels[key] = writer.register_channel(one.topic, "ros1" if form.is_ros1 else "cdr", schema)
        writer.add_message(channels[key], one.recorded_ns, _bytes_of(form, messages, one), one.recorded_ns - 1000)
    writer.finish()
    return out.getvalue(), has_summary


def _write_sqlite(rng: Rng, form: _Form, messages: _Messages, sent: list[_Sent]) -> bytes:
    """The tables of rosbag2_storage_sqlite3, with messages compressed one by one or not."""
    import zstandard

    packed = chance(rng)
    with closing(sqlite3.connect(":memory:")) as database:
        database.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)")
        database.execute("CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER, metadata TEXT)")
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
            "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
            "data BLOB NOT NULL)"
        )
        database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        topics: dict[str, int] = {}
        for one in sent:
            if one.topic not in topics:
                topics[one.topic] = len(topics) + 1
                database.execute(
                    "INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (topics[one.topic], one.topic, one.kind)
                )
            data = _bytes_of(form, messages, one)
            database.execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
                (topics[one.topic], one.recorded_ns, zstandard.compress(data) if packed else data),
            )
        database.commit()
        return bytes(database.serialize())


def _write_ros1(rng: Rng, form: _Form, messages: _Messages, sent: list[_Sent]) -> bytes:
    from rosbags.rosbag1 import Writer

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.bag"
        writer = Writer(path)
        compression = pick(rng, None, *Writer.CompressionFormat)
        if compression is not None:
            writer.set_compression(compression)
        with writer:
            connections: dict[tuple[str, int], Any] = {}
            for number, one in enumerate(sent):
                key = (one.topic, number % form.publishers)
                if key not in connections:
                    connections[key] = writer.add_connection(
                        one.topic, one.kind, typestore=messages.store, callerid=f"/node{key[1]}"
                    )
                writer.write(connections[key], one.recorded_ns, _bytes_of(form, messages, one))
        return path.read_bytes()


def _without_index(content: bytes) -> Check:
    """docs/videos.md asks for an index; a bag without one is refused by that name."""

    def check() -> str:
        try:
            list(_indexed(content).time_s)
        except UnreadableUpload as error:
            return "" if "has no index" in str(error) else f"refused: {error}"
        return "a bag without an index was read"

    return check


def _indexed(content: bytes) -> VideoIndex:
    kind = detect_video(content[:65536])
    assert kind is not None, "not recognised"
    return index_video(VideoFile(SpooledFile.of(content), kind))


# --- pictures and positions ---------------------------------------------------------------------------------------


def _pictures(rng: Rng, form: _Form, messages: _Messages, start_ns: int) -> tuple[bytes, Check]:
    """Cameras and receivers. The compressed topic, and the receiver with the most positions, are used."""
    count = int(rng.integers(2, 10))
    exposed_ns = start_ns + np.cumsum(rng.integers(5_000_000, 200_000_000, count))
    late_ns = int(pick(rng, 0, 3_000_000, 250_000_000, 5_000_000_000, 40 * 86_400 * 10**9))
    has_stamps = not chance(rng, 0.15)
    recorded_ns = exposed_ns + late_ns + rng.integers(0, 4_000_000, count)
    is_raw = chance(rng, 0.4)
    sent = list(_camera(rng, messages, exposed_ns if has_stamps else exposed_ns * 0, recorded_ns, is_raw=is_raw))
    if not is_raw and chance(rng):  # the raw pictures of the same camera, with other levels
        other = _camera(rng, messages, exposed_ns, recorded_ns + 1, is_raw=True, topic="/a/image", first=5)
        sent += list(other)
    if chance(rng):
        text = messages.make("std_msgs/msg/String", "hello")
        sent += [_Sent("/chatter", "std_msgs/msg/String", int(at), text) for at in recorded_ns]
    wanted: tuple[Floats, Floats, Floats] | None = None  # times [s], latitudes [deg], accuracies [m]
    most = 0
    for number in range(int(pick(rng, 0, 1, 1, 2, 3))):
        fixes, stated = _receiver(
            rng, messages, f"/gps{number}/fix", int(exposed_ns[0]), late_ns, has_stamps=has_stamps
        )
        while (
            len(stated[0]) and len(stated[0]) == most
        ):  # of two with as many, the more accurate counts: not tested here
            fixes, stated = _receiver(
                rng, messages, f"/gps{number}/fix", int(exposed_ns[0]), late_ns, has_stamps=has_stamps
            )
        sent += fixes
        if len(stated[0]) > most:
            wanted, most = stated, len(stated[0])
    content, has_index = _write(rng, form, messages, sent)
    if not has_index:
        return content, _without_index(content)
    frame_ns = exposed_ns if has_stamps else recorded_ns

    def check() -> str:
        index = _indexed(content)
        if len(index.time_s) != count:
            return f"{len(index.time_s)} of {count} pictures {index.warnings}"
        if np.abs(index.time_s - (frame_ns - frame_ns[0]) * 1e-9).max() > 1e-9 * count:
            return f"times of pictures off by {np.abs(index.time_s - (frame_ns - frame_ns[0]) * 1e-9).max()} s"
        if index.created_at is None or abs(index.created_at.timestamp() - frame_ns[0] * 1e-9) > 2e-6:
            return f"begins at {index.created_at}, not {frame_ns[0]}"
        if any("left out" in warning for warning in index.warnings):
            return f"left out: {index.warnings}"
        if not has_stamps and not any("times of recording" in warning for warning in index.warnings):
            return "no warning about times of recording"
        if has_stamps and late_ns > 1_010_000_000 and not any("recorded" in warning for warning in index.warnings):
            return "no warning about a bag that was recorded again"
        return _other_levels(index) or _other_track(index, wanted)

    return content, check


def _other_levels(index: VideoIndex) -> str:
    levels = [
        (frame.number, float(np.median(frame.grey())))
        for segment in index.segments
        for frame in read_frames(index, segment, ReadReport())
    ]
    if [number for number, _ in levels] != list(range(len(index.time_s))):
        return f"pictures {[number for number, _ in levels]} of {len(index.time_s)}"
    wrong = [(number, level, grey_of(number)) for number, level in levels if abs(level - grey_of(number)) > 5]
    return f"levels of pictures: number, level, as written: {wrong}" if wrong else ""


def _other_track(index: VideoIndex, wanted: tuple[Floats, Floats, Floats] | None) -> str:
    track = index.track
    if wanted is None or track is None:
        return "" if wanted is None and track is None else f"a track: {track is not None}, wanted: {wanted is not None}"
    time_s, lat_deg, accuracy_m = wanted
    if len(track.time_s) != len(time_s):
        return f"{len(track.time_s)} of {len(time_s)} positions"
    if np.abs(track.time_s - time_s).max() > 2e-6 or np.abs(track.lat_deg - lat_deg).max() > 1e-10:
        return "times or latitudes of the track"
    return "" if np.allclose(track.accuracy_m, accuracy_m, equal_nan=True) else "accuracies of the track"


def _camera(
    rng: Rng, messages: _Messages, exposed_ns: Any, recorded_ns: Any, *, is_raw: bool, topic: str = "/front/image",
    first: int = 0,
) -> Iterator[_Sent]:  # fmt: skip
    """Uniform pictures whose level is their number."""
    width, height = SIZE_PX
    encoding = str(pick(rng, "bgr8", "rgb8", "mono8", "bgra8", "rgba8"))
    bytes_each, padding = {"mono8": 1, "bgra8": 4, "rgba8": 4}.get(encoding, 3), int(pick(rng, 0, 0, 5))
    form = str(pick(rng, "jpeg", "png"))
    for number, (at, recorded) in enumerate(zip(exposed_ns.tolist(), recorded_ns.tolist(), strict=True)):
        level = grey_of(number + first)
        if is_raw:
            rows = np.full((height, width * bytes_each + padding), level, np.uint8)
            rows[:, width * bytes_each :] = 255 - level
            kind = "sensor_msgs/msg/Image"
            message = messages.make(
                kind, messages.header(at), height, width, encoding, 0, rows.shape[1], rows.ravel()
            )  # fmt: skip
        else:
            kind = "sensor_msgs/msg/CompressedImage"
            _, data = cv2.imencode(f".{form}", np.full((height, width, 3), level, np.uint8))
            message = messages.make(kind, messages.header(at), form, data.ravel())
        yield _Sent(topic if is_raw else f"{topic}/compressed", kind, recorded, message)


def _receiver(
    rng: Rng, messages: _Messages, topic: str, start_ns: int, late_ns: int, *, has_stamps: bool
) -> tuple[list[_Sent], tuple[Floats, Floats, Floats]]:
    """Fixes, and the times, latitudes and accuracies of those that are positions."""
    count, is_dead = int(rng.integers(2, 30)), chance(rng, 0.2)
    at_ns = start_ns + int(rng.integers(0, 50_000_000)) + np.arange(count) * int(pick(rng, 50_000_000, 200_000_000))
    recorded_ns = at_ns + late_ns + rng.integers(0, 9_000_000, count)
    lat_deg = float(rng.uniform(-60, 60)) + 1e-6 * np.arange(count)
    kind = int(pick(rng, 0, 1, 2, 3))  # of the covariance: unknown, approximated, diagonal, known
    sent, kept = [], []
    for k in range(count):
        is_fix = not is_dead and not chance(rng, 0.15)
        east_m2, north_m2 = (round(float(value), 4) for value in rng.uniform(0.01, 9, 2))
        covariance = np.array([east_m2, 0.1, 0, 0.1, north_m2, 0, 0, 0, 20.0])
        status = messages.make("sensor_msgs/msg/NavSatStatus", int(pick(rng, 0, 1, 2)) if is_fix else -1, 1)
        nowhere: tuple[float, float, float] = pick(rng, (math.nan,) * 3, (0.0,) * 3)
        position = (float(lat_deg[k]), 114.2, 5.0) if is_fix else nowhere
        fix = messages.make(
            "sensor_msgs/msg/NavSatFix", messages.header(int(at_ns[k]) if has_stamps else 0), status, *position,
            covariance, kind,
        )  # fmt: skip
        sent.append(_Sent(topic, "sensor_msgs/msg/NavSatFix", int(recorded_ns[k]), fix))
        if is_fix:
            at = int(at_ns[k] if has_stamps else recorded_ns[k])
            kept.append((at * 1e-9, lat_deg[k], math.sqrt(east_m2 + north_m2) if kind else math.nan))
    table = np.array(kept, float).reshape(-1, 3)
    return sent, (table[:, 0], table[:, 1], table[:, 2])


# --- magnetic fields and speeds -----------------------------------------------------------------------------------


def _fields(rng: Rng, form: _Form, messages: _Messages, start_ns: int) -> tuple[bytes, Check]:
    """Magnetometers of their own clocks and a speed; fields are linear in time, so that they can be joined exactly."""
    sensors, step_ns = int(rng.integers(3, 5)), int(pick(rng, 2_000_000, 5_000_000, 8_000_000))
    names = [f"/bar/mag_{number + int(pick(rng, 8, 8, 98))}" for number in range(sensors)]  # in the order of numbers
    names = sorted(set(names), key=lambda name: int(name.rsplit("_", 1)[1]))
    count = int(rng.integers(20, 60))
    late_ns = int(rng.integers(0, 20_000_000))
    base_t = rng.uniform(-3e-5, 3e-5, (sensors, 3)) + np.array((0, 0, -4e-5))
    slope_t = rng.uniform(-2e-6, 2e-6, (sensors, 3))
    sent: list[_Sent] = []
    first_ns = np.zeros(0, np.int64)
    for number, name in enumerate(names):
        own_ns = (
            start_ns
            + int(rng.integers(0, step_ns))
            + np.cumsum(rng.integers(step_ns * 9 // 10, step_ns * 11 // 10, count))
        )
        first_ns = own_ns if number == 0 else first_ns
        for at in own_ns.tolist():
            field_t = base_t[number] + slope_t[number] * ((at - start_ns) * 1e-9)
            field = messages.make(
                "sensor_msgs/msg/MagneticField", messages.header(at), messages.vector(*field_t.tolist()), np.zeros(9)
            )
            sent.append(_Sent(name, "sensor_msgs/msg/MagneticField", at + late_ns, field))
    kind = str(pick(rng, "TwistStamped", "TwistWithCovarianceStamped", "Odometry"))
    speed_ns = start_ns + np.arange(0, count * step_ns, 20_000_000) + int(rng.integers(0, 3_000_000))
    speed_m_s = np.round(rng.uniform(-3, 30, len(speed_ns)), 3)
    for at, value in zip(speed_ns.tolist(), speed_m_s.tolist(), strict=True):
        sent.append(_Sent("/odom", *_speed(messages, kind, at, at + late_ns, value)))
    other = chance(rng, 0.3)
    if other:
        for at in speed_ns.tolist():
            sent.append(_Sent("/wheels/odom", *_speed(messages, "Odometry", at, at + late_ns, 99.0)))
    if chance(rng, 0.3):
        text = messages.make("std_msgs/msg/String", "hello")
        sent.append(_Sent("/chatter", "std_msgs/msg/String", start_ns, text))
    content, has_index = _write(rng, form, messages, sent)
    if not has_index:
        return content, _without_index(content)
    bar = BarDeclaration.model_validate({"sensors": [{"position_m": (0.0, 0.16 * k, 0.0)} for k in range(sensors)]})
    declaration = TraceDeclaration(bar=bar, axes="FLU")

    def check() -> str:
        read = read_trace({"drive": content}, declaration)
        trace = read.trace
        t_s = (first_ns - first_ns[0]) * 1e-9
        if len(trace.t_s) != count or np.abs(trace.t_s - t_s).max() > 1e-6:
            return f"times of {len(trace.t_s)} of {count} samples"
        wanted_ut = 1e6 * (base_t + slope_t * ((first_ns - start_ns) * 1e-9)[:, None, None])
        known = np.isfinite(trace.field_ut).all(2)
        if not known[:, 0].all() or known.mean() < 0.75:
            return f"{known.mean():.2f} of the fields"
        off_ut = np.abs(trace.field_ut - wanted_ut)[known].max()
        if off_ut > 1e-3:
            return f"fields off by {off_ut:.4f} uT"
        speed_t_s = (speed_ns - first_ns[0]) * 1e-9
        if len(trace.speed_t_s) != len(speed_t_s) or np.abs(trace.speed_t_s - speed_t_s).max() > 1e-6:
            return "times of speeds"
        if np.abs(trace.speed_m_s - speed_m_s).max() > 1e-9:
            return "speeds"
        if other and not any("/wheels/odom" in warning for warning in read.report.warnings):
            return "another topic of speeds is not used, without a warning"
        return ""

    return content, check


def _speed(messages: _Messages, kind: str, at_ns: int, recorded_ns: int, speed_m_s: float) -> tuple[str, int, Any]:
    """Type, time of recording and message of a speed."""
    twist = messages.make(
        "geometry_msgs/msg/Twist", messages.vector(speed_m_s, 0.3, 0.0), messages.vector(0.0, 0.0, 0.2)
    )
    header = messages.header(at_ns)
    if kind == "TwistStamped":
        return (
            "geometry_msgs/msg/TwistStamped",
            recorded_ns,
            messages.make("geometry_msgs/msg/TwistStamped", header, twist),
        )
    moved = messages.make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
    if kind == "TwistWithCovarianceStamped":
        name = "geometry_msgs/msg/TwistWithCovarianceStamped"
        return name, recorded_ns, messages.make(name, header, moved)
    place = messages.make("geometry_msgs/msg/Point", 1.0, 2.0, 3.0)
    turn = messages.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    pose = messages.make(
        "geometry_msgs/msg/PoseWithCovariance", messages.make("geometry_msgs/msg/Pose", place, turn), np.zeros(36)
    )
    return "nav_msgs/msg/Odometry", recorded_ns, messages.make("nav_msgs/msg/Odometry", header, "base", pose, moved)


DRIVE_GRAMMARS: dict[str, Grammar] = {"bag": _bag}
