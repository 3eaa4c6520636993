"""Bags: pictures and positions of MCAP files and ROS 1 bags."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mcap", reason="the extra bags is not installed")
pytest.importorskip("rosbags", reason="the extra bags is not installed")

from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.bags import messages as bag_messages
from app.formats.spooled_file import SpooledFile
from app.formats.video.container import VideoFile, VideoKind, detect_video
from app.formats.video.frames import ReadReport, read_frames
from app.formats.video.index import VideoIndex, index_video
from tests.formats.pictures import jpeg

START_NS = 1_777_883_400_000_000_000
STEP_NS = 100_000_000
FRAMES = 12


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


def mcap() -> bytes:
    """An MCAP file with pictures, positions and text."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    out = io.BytesIO()
    writer = Writer(out, chunk_size=4096)
    writer.start(profile="ros2")
    channels: dict[str, int] = {}
    for topic, kind, at, message in _messages(store):
        if topic not in channels:
            schema = writer.register_schema(kind, "ros2msg", b"")
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channels[topic], at, bytes(store.serialize_cdr(message, kind)), at)
    writer.finish()
    return out.getvalue()


def ros1(path: Path) -> bytes:
    """The same as a ROS 1 bag."""
    store = get_typestore(Stores.ROS1_NOETIC)
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


@pytest.mark.parametrize("kind", [VideoKind.MCAP, VideoKind.ROS1])
def test_pictures_with_times_and_positions(kind: VideoKind, tmp_path: Path) -> None:
    data = mcap() if kind is VideoKind.MCAP else ros1(tmp_path / "a.bag")
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


def test_bags_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = mcap()
    with pytest.raises(UnreadableUpload, match="cut off"):
        _indexed(data[: len(data) // 2])
    with pytest.raises(UnsupportedUpload, match="SQLite"):
        detect_video(b"SQLite format 3\0" + b"\0" * 100)
    monkeypatch.setattr(bag_messages, "MAX_CHUNK_BYTES", 100)
    with pytest.raises(UploadTooLarge):
        _indexed(data)
    monkeypatch.undo()
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(UnsupportedUpload) as refused:
        _indexed(data)
    assert "waymark[bags]" in refused.value.cure


@pytest.mark.parametrize("seed", range(30))
def test_damaged_bags_raise_only_our_errors(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    data = bytearray(mcap() if seed % 2 else ros1(tmp_path / "a.bag"))
    for _ in range(int(rng.integers(1, 40))):
        data[int(rng.integers(16, len(data)))] = int(rng.integers(256))
    try:
        index = _indexed(bytes(data))
        for frame in read_frames(index, index.segments[0], ReadReport()):
            frame.half_bgr()
    except WaymarkError:
        pass
