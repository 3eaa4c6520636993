"""Bags: pictures, positions and magnetic fields of MCAP files, ROS 2 bags in SQLite and ROS 1 bags."""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.bags import messages as bag_messages
from app.formats.format import SpooledFile
from app.formats.traces.declaration import TraceDeclaration
from app.formats.traces.read import read_trace
from app.formats.video import index_video, read_frames
from app.formats.video_file import ReadReport, VideoFile, VideoIndex, VideoKind, detect_video
from tests.formats.pictures import jpeg
from tests.formats.traces.recordings import bar_of
from tests.machine import require_module

mcap_writer = require_module("mcap.writer", "the extra bags")
Writer, CompressionType = mcap_writer.Writer, mcap_writer.CompressionType
Ros1Writer = require_module("rosbags.rosbag1", "the extra bags").Writer
typesys = require_module("rosbags.typesys", "the extra bags")

START_NS = 1_777_883_400_000_000_000
STEP_NS = 100_000_000
FRAMES = 12
FIELD_STEP_NS = 2_000_000


def _pictures() -> list[bytes]:
    return [jpeg(np.full((96, 128, 3), 20 * k % 250, np.uint8)) for k in range(FRAMES)]


def _messages(store: Any) -> list[tuple[str, str, int, Any]]:
    """Topic, type, time and message of each."""
    types = store.types
    time_of = types["builtin_interfaces/msg/Time"]
    head = types["std_msgs/msg/Header"]
    ros1 = "seq" in head.__dataclass_fields__

    def header(at_ns: int) -> Any:
        stamp = time_of(at_ns // 10**9, at_ns % 10**9)
        return head(0, stamp, "camera") if ros1 else head(stamp, "camera")

    listed: list[tuple[str, str, int, Any]] = []
    image, fix, status = (types[f"sensor_msgs/msg/{name}"] for name in ("CompressedImage", "NavSatFix", "NavSatStatus"))
    text = types["std_msgs/msg/String"]
    for k, data in enumerate(_pictures()):
        at = START_NS + k * STEP_NS
        listed.append(
            ("/camera/compressed", image.__msgtype__, at, image(header(at), "jpeg", np.frombuffer(data, np.uint8)))
        )
        covariance = np.array([0.25, 0, 0, 0, 0.25, 0, 0, 0, 1.0])
        position = fix(header(at), status(0, 1), 22.3 + 1e-5 * k, 114.2, 5.0, covariance, 2)
        listed.append(("/gps/fix", fix.__msgtype__, at, position))
        listed.append(("/chatter", text.__msgtype__, at, text("hello")))
    return listed


def bag_fields(store: Any, sensors: int, samples: int) -> list[tuple[str, str, int, Any]]:
    """Messages of magnetometers, whose clocks differ by a part of a sample, and speeds."""
    types = store.types
    names = "sensor_msgs/msg/MagneticField", "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Vector3"
    field, twist, vector = (types[name] for name in names)
    header, time_of = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]

    def head(at: int) -> Any:
        return header(time_of(at // 10**9, at % 10**9), "bar")

    listed: list[tuple[str, str, int, Any]] = []
    for k in range(samples):
        at = START_NS + k * FIELD_STEP_NS
        for sensor in range(sensors):
            own = at + sensor * 100_000
            value = vector(1e-8 * (own - START_NS) / FIELD_STEP_NS, 2e-5, -4e-5)
            message = field(head(own), value, np.zeros(9))
            listed.append((f"/mag_{sensor + 8}", field.__msgtype__, own + 5_000_000, message))
        if k % 20 == 0:
            moved = types["geometry_msgs/msg/Twist"](vector(12.0, 0, 0), vector(0, 0, 0))
            listed.append(("/speed", twist.__msgtype__, at, twist(head(at), moved)))
    return listed


def _raw(store: Any) -> list[tuple[str, str, int, Any]]:
    """Raw pictures, red."""
    types = store.types
    image, header, time_of = (
        types[name] for name in ("sensor_msgs/msg/Image", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    pixels = np.zeros((20, 34, 3), np.uint8)
    pixels[..., 0] = 200
    rows = np.pad(pixels.reshape(20, 102), ((0, 0), (0, 2))).ravel()
    at = [START_NS + k * STEP_NS for k in range(3)]
    head = [header(time_of(t // 10**9, t % 10**9), "camera") for t in at]
    return [("/image", image.__msgtype__, at[k], image(head[k], 20, 34, "rgb8", 0, 104, rows)) for k in range(3)]


def sqlite_bag(
    path: Path,
    listed: list[tuple[str, str, int, Any]] | None = None,
    padding: int = 0,
    packed: Callable[[bytes], bytes] = bytes,
) -> bytes:
    """A ROS 2 bag in SQLite, with the tables of rosbag2_storage_sqlite3 and some bytes that no reader asks for."""
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
    database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    topics: dict[str, int] = {}
    for topic, kind, at, message in reversed(_messages(store) if listed is None else listed):  # not in order of time
        if topic not in topics:
            topics[topic] = len(topics) + 1
            database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", (topics[topic], topic, kind))
        data = bytes(store.serialize_cdr(message, kind))
        database.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", (topics[topic], at, packed(data))
        )
    if padding:
        database.execute(f"CREATE TABLE padding AS SELECT zeroblob({padding}) AS data")
    database.commit()
    database.close()
    return path.read_bytes()


def mcap(
    listed: list[tuple[str, str, int, Any]] | None = None, *, recorded_late_ns: int = 0, encoding: str = "cdr"
) -> bytes:
    """An MCAP file with pictures, positions and text."""
    is_ros1 = encoding == "ros1"
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if is_ros1 else typesys.Stores.ROS2_HUMBLE)
    out = io.BytesIO()
    writer = Writer(out, chunk_size=4096)
    writer.start(profile="ros1" if is_ros1 else "ros2")
    channels: dict[str, int] = {}
    for topic, kind, at, message in listed or _messages(store):
        if topic not in channels:
            name = kind.replace("/msg/", "/") if is_ros1 else kind
            schema = writer.register_schema(name, "ros1msg" if is_ros1 else "ros2msg", b"")
            channels[topic] = writer.register_channel(topic, encoding, schema)
        data = store.serialize_ros1(message, kind) if is_ros1 else store.serialize_cdr(message, kind)
        writer.add_message(channels[topic], at + recorded_late_ns, bytes(data), at + recorded_late_ns)
    writer.finish()
    return out.getvalue()


def ros1(path: Path) -> bytes:
    """The same as a ROS 1 bag."""
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    with Ros1Writer(path) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, at, message in _messages(store):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], at, store.serialize_ros1(message, kind))
    return path.read_bytes()


def _indexed(data: bytes) -> VideoIndex:
    kind = detect_video(data[:16])
    assert kind is not None
    return index_video(VideoFile(SpooledFile.of(data), kind))


@pytest.mark.parametrize("kind", [VideoKind.MCAP, VideoKind.ROS1, VideoKind.ROS2_SQLITE])
def test_pictures_with_times_and_positions(kind: VideoKind, tmp_path: Path) -> None:
    make = {VideoKind.MCAP: lambda _path: mcap(), VideoKind.ROS1: ros1, VideoKind.ROS2_SQLITE: sqlite_bag}
    data = make[kind](tmp_path / "a bag?")
    index = _indexed(data)
    assert index.file.kind is kind
    assert index.time_s == pytest.approx(np.arange(FRAMES) / 10)
    assert index.created_at is not None
    assert index.created_at.timestamp() == pytest.approx(START_NS / 1e9)
    frames = list(read_frames(index, index.segments[0], ReadReport()))
    assert [frame.number for frame in frames] == list(range(FRAMES))
    assert [int(frame.bgr()[5, 5, 0]) // 20 for frame in frames[:5]] == [0, 1, 2, 3, 4]
    assert index.track is not None
    assert index.track.lat_deg == pytest.approx(22.3 + 1e-5 * np.arange(FRAMES))
    assert index.track.accuracy_m == pytest.approx(np.full(FRAMES, 0.5**0.5))
    assert "/chatter" in index.warnings[0]


def _restamped(listed: list[tuple[str, str, int, Any]], topic: str, later_ns: dict[int, int]) -> list[Any]:
    """Other stamps for single messages of a topic, by their number in it."""
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE).types
    changed, number = [], 0
    for name, kind, at, message in listed:
        if name == topic:
            if number in later_ns:
                at_ns = at + later_ns[number]
                stamp = store["builtin_interfaces/msg/Time"](at_ns // 10**9, at_ns % 10**9)
                message = replace(message, header=replace(message.header, stamp=stamp))
            number += 1
        changed.append((name, kind, at, message))
    return changed


def test_times_are_those_of_exposure_where_a_bag_was_played_and_recorded_again() -> None:
    late_ns = 184 * 86_400 * 10**9 + 250_000_000
    index = _indexed(mcap(recorded_late_ns=late_ns))
    assert index.created_at is not None
    assert index.created_at.timestamp() == pytest.approx(START_NS / 1e9)
    assert index.track is not None
    assert index.track.time_s[0] == pytest.approx(START_NS / 1e9)
    assert any("184.0 days after" in warning for warning in index.warnings)
    frames = list(read_frames(index, index.segments[0], ReadReport()))
    assert [frame.number for frame in frames] == list(range(FRAMES))
    live = _indexed(mcap(recorded_late_ns=50_000_000))
    assert not any("recorded" in warning for warning in live.warnings)


@pytest.mark.parametrize("topic", ["/camera/compressed", "/gps/fix"])
def test_times_are_those_of_recording_where_a_topic_has_no_stamps(topic: str) -> None:
    messages = _messages(typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))
    unset = {number: -(START_NS + number * STEP_NS) for number in range(FRAMES)}
    index = _indexed(mcap(_restamped(messages, topic, unset), recorded_late_ns=10**9))
    assert index.created_at is not None
    assert index.created_at.timestamp() == pytest.approx(START_NS / 1e9 + 1)
    assert index.track is not None
    assert index.track.time_s[0] == pytest.approx(START_NS / 1e9 + 1)
    assert any("times of recording are used" in warning for warning in index.warnings)


@pytest.mark.parametrize("wrong_ns", [3600 * 10**9, -3600 * 10**9])
def test_a_picture_with_a_stamp_out_of_order_is_left_out(wrong_ns: int) -> None:
    messages = _messages(typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))
    index = _indexed(mcap(_restamped(messages, "/camera/compressed", {4: wrong_ns})))
    assert index.time_s == pytest.approx(np.delete(np.arange(FRAMES), 4) / 10)
    frames = list(read_frames(index, index.segments[0], ReadReport()))
    assert [int(frame.bgr()[5, 5, 0]) // 20 for frame in frames[3:6]] == [3, 5, 6]
    assert any(warning.startswith("1 picture left out") for warning in index.warnings)


def test_an_mcap_file_with_messages_of_ros_1_is_read() -> None:
    index = _indexed(mcap(encoding="ros1"))
    assert index.time_s == pytest.approx(np.arange(FRAMES) / 10)
    assert index.track is not None
    assert index.track.lat_deg == pytest.approx(22.3 + 1e-5 * np.arange(FRAMES))
    frames = list(read_frames(index, index.segments[0], ReadReport()))
    assert [int(frame.bgr()[5, 5, 0]) // 20 for frame in frames[:3]] == [0, 1, 2]


def test_an_mcap_file_with_messages_that_are_not_of_ros_is_refused_by_their_encoding() -> None:
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    schema = writer.register_schema("sensor_msgs/msg/CompressedImage", "jsonschema", b"{}")
    writer.add_message(writer.register_channel("/camera", "json", schema), START_NS, b"{}", START_NS)
    writer.finish()
    with pytest.raises(UnsupportedUpload, match="'json'") as refused:
        _indexed(out.getvalue())
    assert "ROS 2" in str(refused.value.cure)


def test_of_several_receivers_the_one_with_positions_is_used() -> None:
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    listed = _messages(store)
    status = store.types["sensor_msgs/msg/NavSatStatus"]
    fixes = [(kind, at, message) for topic, kind, at, message in listed if topic == "/gps/fix"]
    for topic, kept in (("/aaa/fix", 0), ("/zzz/fix", 5)):
        listed += [
            (topic, kind, at, replace(message, status=status(0 if k < kept else -1, 1)))
            for k, (kind, at, message) in enumerate(fixes)
        ]
    index = _indexed(mcap(listed))
    assert index.track is not None
    assert len(index.track.time_s) == FRAMES
    assert "/zzz/fix holds 5 positions; /gps/fix is used, with 12" in index.warnings
    assert "/aaa/fix holds 0 positions; /gps/fix is used, with 12" in index.warnings


def test_messages_that_were_compressed_one_by_one(tmp_path: Path) -> None:
    zstandard = require_module("zstandard", "the extra bags")
    index = _indexed(sqlite_bag(tmp_path / "a.db3", packed=zstandard.ZstdCompressor().compress))
    assert index.time_s == pytest.approx(np.arange(FRAMES) / 10)
    frames = list(read_frames(index, index.segments[0], ReadReport()))
    assert [int(frame.bgr()[5, 5, 0]) // 20 for frame in frames[:3]] == [0, 1, 2]


def test_bags_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = mcap()
    with pytest.raises(UnreadableUpload, match="cut off"):
        _indexed(data[: len(data) // 2])
    with pytest.raises(UnsupportedUpload, match="GeoPackage"):
        detect_video(b"SQLite format 3\0" + b"\0" * 52 + b"GPKG")
    monkeypatch.setattr(bag_messages, "MAX_CHUNK_BYTES", 100)
    with pytest.raises(UploadTooLarge):
        _indexed(data)
    monkeypatch.undo()
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(UnsupportedUpload) as refused:
        _indexed(data)
    assert "waymark-roads[bags]" in refused.value.cure


def bomb(chunks: int, *, repeats: int = 1, expanded: int | None = None, time_ns: int = START_NS) -> bytes:
    """An MCAP of chunks of 3 MB of zeros; its index names each several times, and may state a false size."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=1024, compression=CompressionType.ZSTD)
    writer.start(profile="ros2")
    schema = writer.register_schema("sensor_msgs/msg/CompressedImage", "ros2msg", b"")
    channel = writer.register_channel("/camera", "cdr", schema)
    for _ in range(chunks):
        writer.add_message(channel, time_ns, bytes(3_000_000), time_ns)
    index = writer._Writer__chunk_indices if hasattr(writer, "_Writer__chunk_indices") else writer._chunk_indices
    index[:] = [replace(entry, uncompressed_size=expanded or entry.uncompressed_size) for entry in index * repeats]
    writer.finish()
    return out.getvalue()


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (bomb(2, repeats=100), "names a chunk twice"),
        (bomb(2, expanded=100), "another size than it has"),
        (bomb(100), "expand from"),
        (bomb(1, time_ns=2**63), "has the time 9223372036854775808 ns"),
        (bomb(1, time_ns=2**64 - 1), "has the time 18446744073709551615 ns"),
    ],
)
def test_an_index_that_expands_to_too_much_is_refused_before_a_chunk_is_read(data: bytes, why: str) -> None:
    assert len(data) < 100_000
    with pytest.raises((UnreadableUpload, UploadTooLarge), match=why) as refused:
        _indexed(data)
    assert (refused.value.field, bool(refused.value.limit), bool(refused.value.cure)) == ("file", True, True)


@pytest.mark.parametrize("seed", range(30))
def test_damaged_bags_raise_only_our_errors(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    make = (lambda _path: mcap(), ros1, sqlite_bag)[seed % 3]
    data = bytearray(make(tmp_path / "a.bag"))
    for _ in range(int(rng.integers(1, 40))):
        data[int(rng.integers(16, len(data)))] = int(rng.integers(256))
    try:
        index = _indexed(bytes(data))
        for frame in read_frames(index, index.segments[0], ReadReport()):
            frame.half_bgr()
    except WaymarkError:
        pass


def test_a_bag_in_sqlite_is_opened_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "a b?.db3"
    before = sqlite_bag(path)
    index = index_video(VideoFile(SpooledFile.at(path), VideoKind.ROS2_SQLITE))
    assert len(list(read_frames(index, index.segments[0], ReadReport()))) == FRAMES
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_sqlite_files_that_are_no_bags(tmp_path: Path) -> None:
    for number, tables in enumerate(("CREATE TABLE markers(id)", VIEWS)):
        path = tmp_path / f"{number}.db3"
        database = sqlite3.connect(path)
        database.executescript(tables)
        database.close()
        with pytest.raises(UnsupportedUpload, match="no ROS 2 bag"):
            _indexed(path.read_bytes())


VIEWS = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i FROM n;
"""


def test_raw_pictures(tmp_path: Path) -> None:
    index = _indexed(sqlite_bag(tmp_path / "a.db3", _raw(typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))))
    assert (index.width_px, index.height_px) == (34, 20)
    frames = list(read_frames(index, index.segments[0], ReadReport()))
    assert [frame.bgr()[19, 33].tolist() for frame in frames] == [[0, 0, 200]] * 3


RED = (200, 60, 20)


@pytest.mark.parametrize(
    ("encoding", "cell"),
    [
        ("bayer_rggb8", [[[RED[0]], [RED[1]]], [[RED[1]], [RED[2]]]]),
        ("bayer_bggr8", [[[RED[2]], [RED[1]]], [[RED[1]], [RED[0]]]]),
        ("bayer_gbrg8", [[[RED[1]], [RED[2]]], [[RED[0]], [RED[1]]]]),
        ("bayer_grbg8", [[[RED[1]], [RED[0]]], [[RED[2]], [RED[1]]]]),
        ("yuv422_yuy2", [[[100, 90], [100, 192]], [[100, 90], [100, 192]]]),
        ("uyvy", [[[90, 100], [192, 100]], [[90, 100], [192, 100]]]),
    ],
)
def test_pictures_of_machine_vision_cameras(encoding: str, cell: list[Any], tmp_path: Path) -> None:
    """One colour; its luma and colour differences by ITU-R BT.601 are 100, 90 and 192."""
    types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE).types
    rows = np.tile(np.array(cell, np.uint8), (10, 16, 1))
    image, header, time_of = (
        types[name] for name in ("sensor_msgs/msg/Image", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    head = header(time_of(START_NS // 10**9, 0), "camera")
    message = image(head, 20, 32, encoding, 0, rows[0].size, rows.ravel())
    index = _indexed(sqlite_bag(tmp_path / "a.db3", [("/image", image.__msgtype__, START_NS, message)]))
    (frame,) = read_frames(index, index.segments[0], ReadReport())
    assert frame.bgr()[9, 15].tolist() == pytest.approx(RED[::-1], abs=6)


def test_pictures_in_an_encoding_that_is_not_read_are_refused_by_its_name(tmp_path: Path) -> None:
    raw = _raw(typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))
    listed = [(topic, kind, at, replace(message, encoding="nv21")) for topic, kind, at, message in raw]
    with pytest.raises(UnsupportedUpload, match="'nv21'"):
        _indexed(sqlite_bag(tmp_path / "a.db3", listed))


def test_magnetometers_are_a_trace(tmp_path: Path) -> None:
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    data = sqlite_bag(tmp_path / "a.db3", bag_fields(store, 3, 600))
    declared = TraceDeclaration(bar=bar_of(3), axes="ISO8855")
    with (tmp_path / "a.db3").open("rb") as stream:
        traces = [read_trace({"drive.db3": given}, declared).trace for given in (data, stream)]
    for trace in traces:
        # the fields rise by 0.01 uT a sample, also between the samples of the sensors, whose clocks differ
        rising = trace.field_ut[5:-5, :, 0]
        assert rising[:, 1] == pytest.approx(rising[:, 0], abs=1e-4)
        assert np.diff(rising[:, 0]) == pytest.approx(np.full(len(rising) - 1, 0.01), abs=1e-4)
        assert trace.field_ut[5, :, 2] == pytest.approx([-40.0] * 3, abs=1e-3)
        assert trace.speed_m_s == pytest.approx(np.full(len(trace.speed_m_s), 12.0))
    with pytest.raises(InvalidParameter, match="3 topics of magnetic fields, and 14 sensors") as refused:
        read_trace({"drive.db3": data}, TraceDeclaration(axes="ISO8855"))
    assert "/mag_8 (sensor_msgs/msg/MagneticField)" in refused.value.message
    with pytest.raises(InvalidParameter, match="the bag has no pictures") as refused:
        _indexed(data)
    assert "/mag_8 (sensor_msgs/msg/MagneticField)" in refused.value.message
    assert "sensor_msgs/Image" in str(refused.value.limit)
    assert "declare the trace" in str(refused.value.cure)


def test_publishers_of_one_topic_have_channels_of_their_own() -> None:
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    listed = bag_fields(store, 3, 60)
    out = io.BytesIO()
    writer = Writer(out)
    writer.start(profile="ros2")
    channels: dict[tuple[str, int], int] = {}
    for number, (topic, kind, at, message) in enumerate([*_messages(store), *listed]):
        key = (topic, number % 2)
        if key not in channels:
            channels[key] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
        writer.add_message(channels[key], at, bytes(store.serialize_cdr(message, kind)), at)
    writer.finish()
    index = _indexed(out.getvalue())
    assert len(index.time_s) == FRAMES
    assert index.track is not None
    assert len(index.track.time_s) == FRAMES
    assert not any("/gps/fix" in warning for warning in index.warnings)
    read = read_trace({"drive": out.getvalue()}, TraceDeclaration(bar=bar_of(3), axes="FLU"))
    assert read.trace.field_ut.shape == (60, 3, 3)


def test_a_summary_without_channels_is_no_index() -> None:
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for options in ({"repeat_channels": False}, {"repeat_schemas": False}):
        out = io.BytesIO()
        writer = Writer(out, **options)
        writer.start(profile="ros2")
        topic, kind, at, message = _messages(store)[0]
        channel = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
        writer.add_message(channel, at, bytes(store.serialize_cdr(message, kind)), at)
        writer.finish()
        with pytest.raises(UnreadableUpload, match="has no index"):
            _indexed(out.getvalue())


def test_further_topics_of_speeds_are_named() -> None:
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    listed = bag_fields(store, 3, 60)
    listed += [("/wheels", kind, at, message) for topic, kind, at, message in listed if topic == "/speed"]
    read = read_trace({"drive": mcap(listed)}, TraceDeclaration(bar=bar_of(3), axes="FLU"))
    assert any("not /wheels" in warning for warning in read.report.warnings)
