"""Videos: recognition, the fixed demuxers, times, gaps, segments, rotation, damage."""

from __future__ import annotations

import gc
import io
import struct
import tempfile
import zipfile
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import psutil
import pytest

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.format import HEAD_BYTES, ArchiveLimits, SpooledFile
from app.formats.video import index_video, read_frames
from app.formats.video_file import (
    ReadReport,
    VideoFile,
    VideoIndex,
    VideoKind,
    VideoLimits,
    VideoSegment,
    detect_video,
    holds_video,
    open_packed_video,
)

WIDTH, HEIGHT = 160, 120


def picture(number: int) -> np.ndarray[Any, Any]:
    """A frame whose left half is red, and whose brightness on the right is its number."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, : WIDTH // 2] = (0, 0, 220)
    image[:, WIDTH // 2 :] = 8 * (number % 30)
    return image


def video(
    frames: int = 20, *, codec: str = "mpeg4", form: str = "mp4", stamps: list[int] | None = None, group: int = 5,
    between: int = 0,
) -> bytes:  # fmt: skip
    """An encoded video at 10 Hz; `stamps` are times in tenths of a second, `between` the B-frames in a row."""
    out = io.BytesIO()
    with av.open(out, "w", format=form) as container:
        stream: Any = container.add_stream(codec, rate=10)
        stream.codec_context.max_b_frames = between
        stream.width, stream.height = WIDTH, HEIGHT
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if codec == "libx264":
            x264 = f"log-level=none:scenecut=0:keyint={group}:bframes={between}:b-adapt=0:open-gop=1"
            stream.options = {"preset": "ultrafast", "x264-params": x264}
        for number in range(frames):
            frame = av.VideoFrame.from_ndarray(picture(number), format="bgr24")
            frame.pts, frame.time_base = (stamps or list(range(frames)))[number], Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return out.getvalue()


def indexed(data: bytes, kind: VideoKind = VideoKind.MP4, **options: Any) -> VideoIndex:
    return index_video(VideoFile(SpooledFile.of(data), kind), **options)


def numbers(index: VideoIndex, first: int = 0, end: int | None = None) -> list[int]:
    segment = VideoSegment(first, len(index.stamps) if end is None else end)
    return [frame.number for frame in read_frames(index, segment, ReadReport())]


@pytest.mark.parametrize(
    ("codec", "form", "kind"),
    [
        ("libx264", "mp4", VideoKind.MP4),
        ("mpeg4", "mov", VideoKind.MP4),
        ("mjpeg", "avi", VideoKind.AVI),
        ("mjpeg", "mjpeg", VideoKind.MJPEG),
        ("libx264", "mpegts", VideoKind.MPEG_TS),
        ("libx264", "matroska", VideoKind.MATROSKA),
        ("mjpeg", "matroska", VideoKind.MATROSKA),
    ],
)
def test_every_frame_comes_with_its_number_and_time(codec: str, form: str, kind: VideoKind) -> None:
    data = video(codec=codec, form=form)
    assert detect_video(data[:HEAD_BYTES], is_stream=True) is kind
    index = indexed(data, kind, rate_hz=10.0 if kind is VideoKind.MJPEG else None)
    assert index.time_s == pytest.approx(np.arange(20) / 10, abs=1e-3 if kind is VideoKind.MATROSKA else 2e-5)
    assert numbers(index) == list(range(20))
    assert numbers(index, 10) == list(range(10, 20))
    for frame in read_frames(index, VideoSegment(7, 8), ReadReport()):
        full, half = frame.bgr(), frame.half_bgr()
        assert abs(int(full[60, 120, 1]) - 56) < 12
        assert full[60, 40, 2] > 180
        assert half.shape == (60, 80, 3)
        assert half[30, 20, 2] > 150
        assert half[30, 20, 1] < 60


def test_a_jpeg_is_a_stream_only_where_a_rate_is_declared() -> None:
    data = video(3, codec="mjpeg", form="mjpeg")
    assert detect_video(data[:16]) is None
    with pytest.raises(InvalidParameter, match="no times"):
        indexed(data, VideoKind.MJPEG)


def test_a_variable_rate_and_a_clock_that_jumps() -> None:
    stamps = [0, 1, 3, 4, 5, 6, 7, 8, 60, 61]
    index = indexed(video(10, stamps=stamps))
    assert index.time_s == pytest.approx(np.array(stamps) / 10)
    assert [(gap.after_frame, gap.before_frame, gap.seconds) for gap in index.gaps] == [(7, 8, 5.2)]


def cut_video() -> bytes:
    """The first 70 % of a video of 100 frames that begins with its index."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "whole.mp4"
        fast = {"movflags": "faststart"}
        with av.open(io.BytesIO(video(100))) as source, av.open(str(path), "w", format="mp4", options=fast) as target:
            stream = target.add_stream_from_template(source.streams.video[0])
            for packet in source.demux(video=0):
                if packet.dts is not None:
                    packet.stream = stream
                    target.mux(packet)
        data = path.read_bytes()
    return data[: int(0.7 * len(data))]


def test_a_cut_video_gives_what_is_left_and_states_the_gap() -> None:
    index = indexed(cut_video())
    assert 20 < len(numbers(index)) < 100
    assert "ends before" in index.gaps[-1].reason
    with pytest.raises(UnreadableUpload, match="cut off"):
        indexed(video(100)[:2000])  # the index is at the end


def test_segments_begin_at_key_frames_and_cover_all_frames() -> None:
    index = indexed(video(300, group=50, codec="libx264"))
    assert [(s.first, s.end) for s in index.segments] == [(0, 100), (100, 200), (200, 300)]
    assert [n for s in index.segments for n in numbers(index, s.first, s.end)] == list(range(300))
    with pytest.raises(UnsupportedUpload, match="no key frame"):
        indexed(video(300, group=1000, codec="libx264"), limits=VideoLimits(key_frame_s=5.0))


@pytest.mark.parametrize(
    "limits", [VideoLimits(pixels=1000), VideoLimits(frames=10), VideoLimits(duration_s=1.0), VideoLimits(streams=0)]
)
def test_limits(limits: VideoLimits) -> None:
    with pytest.raises(UploadTooLarge):
        indexed(video(), limits=limits)


def levels(index: VideoIndex) -> list[tuple[int, int]]:
    """Number and level (`picture`) of each frame, segment by segment."""
    return [
        (frame.number, round(int(frame.bgr()[60, 120, 1]) / 8))
        for segment in index.segments
        for frame in read_frames(index, segment, ReadReport())
    ]


CONTAINERS = [
    ("mp4", VideoKind.MP4),
    ("avi", VideoKind.AVI),
    ("mpegts", VideoKind.MPEG_TS),
    ("matroska", VideoKind.MATROSKA),
]


@pytest.mark.parametrize("codec", ["mpeg4", "libx264"])
@pytest.mark.parametrize(("form", "kind"), CONTAINERS)
def test_frames_are_numbered_in_the_order_in_which_they_are_shown(codec: str, form: str, kind: VideoKind) -> None:
    """B-frames are decoded after a later frame; AVI states no time at which a frame is shown."""
    index = indexed(video(300, codec=codec, form=form, group=50, between=2), kind)
    assert len(index.segments) == 3
    for number, level in levels(index):
        assert abs(number % 30 - level) <= 1, (number, level)
    assert [number for number, _level in levels(index)] == list(range(300))


def trimmed(data: bytes, frames: int) -> bytes:
    """The video without its first frames, as ``ffmpeg -ss -c copy`` cuts it: an edit list leaves them out."""
    out = io.BytesIO()
    options = {"use_editlist": "1", "avoid_negative_ts": "disabled"}
    with av.open(io.BytesIO(data)) as source, av.open(out, "w", format="mp4", options=options) as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None and packet.pts is not None:
                shift = round(Fraction(frames, 10) / packet.time_base)
                packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, stream
                target.mux(packet)
    return out.getvalue()


@pytest.mark.parametrize("between", [0, 2])
def test_frames_that_the_edit_list_leaves_out_are_not_shown(between: int) -> None:
    index = indexed(trimmed(video(40, codec="libx264", group=20, between=between), 3))
    assert index.time_s == pytest.approx(np.arange(37) / 10, abs=1e-3)
    shown = levels(index)
    assert index.warnings == ("the edit list of the video leaves out 3 of its 40 frames",)
    assert [number for number, _level in shown] == list(range(37))
    for number, level in shown:
        assert abs((number + 3) % 30 - level) <= 1, (number, level)
    assert index.gaps == ()


@pytest.mark.parametrize(("form", "kind"), CONTAINERS)
@pytest.mark.parametrize("seed", range(6))
def test_every_frame_of_a_damaged_video_is_shown_or_counted(form: str, kind: VideoKind, seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = video(150, codec="libx264", form=form, group=40, between=2)
    data = bytearray(whole)
    with av.open(io.BytesIO(whole)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    for k in rng.choice(np.arange(1, len(packets)), 20, replace=False):
        at, size = packets[int(k)]
        start, end = (at + 188 - min(size // 2, 100), at + 188) if form == "mpegts" else (at + 4, at + size)
        data[start:end] = rng.bytes(end - start)
    index = indexed(bytes(data), kind)
    failed = 0
    for segment in index.segments:
        report = ReadReport()
        shown = list(read_frames(index, segment, report, beyond=10))
        own = [frame.number for frame in shown if frame.number < segment.end]
        assert len(own) + report.damaged + report.other_size == segment.end - segment.first
        assert own == sorted(set(own))
        failed += report.damaged
    assert 0 < failed < len(index.stamps)


def test_reading_starts_no_thread_and_leaves_no_frames_in_memory() -> None:
    """A converter with threads of its own for each frame, and frames in reference cycles, filled decoder processes."""
    index = indexed(video(40))
    process, threads = psutil.Process(), set()
    gc.collect()
    gc.disable()
    try:
        before = process.num_threads()
        for frame in read_frames(index, VideoSegment(0, 40), ReadReport()):
            frame.bgr()
            threads.add(process.num_threads())
        kept = sum(isinstance(thing, av.VideoFrame) for thing in gc.get_objects())
    finally:
        gc.enable()
    assert threads == {before}
    assert kept <= 2  # the last one, and the small copy whose display matrix was read


# --- files that lead elsewhere ----------------------------------------------------------------------------------------


def test_a_playlist_reaches_no_neighbour(tmp_path: Path) -> None:
    secret = tmp_path / "other.avi"
    secret.write_bytes(video(codec="mjpeg", form="avi"))
    concat = f"ffconcat version 1.0\nfile {secret.name}\n".encode()
    playlist = f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfile://{secret}\n#EXT-X-ENDLIST\n".encode()
    for name, content in (("upload.mp4", concat), ("upload.m3u8", playlist)):
        path = tmp_path / name
        path.write_bytes(content)
        assert detect_video(content[:16]) is None
        # PyAV itself follows the first one by its content, the demuxers that we fix do not
        for kind in VideoKind:
            with pytest.raises(WaymarkError):
                index_video(VideoFile(SpooledFile.at(path), kind), rate_hz=10.0)
    with av.open(str(tmp_path / "upload.mp4"), options={"safe": "0"}) as leak:
        assert leak.streams.video


def test_a_movie_that_refers_to_another_file_shows_nothing_of_it(tmp_path: Path) -> None:
    """The data reference `url ` with its flag of self-containment cleared, naming a neighbour."""
    data = video(codec="mjpeg", form="mov")
    secret = tmp_path / "secret.mov"
    secret.write_bytes(data)
    at = data.index(b"url ") if b"url " in data else data.index(b"alis")
    entry = data[:at] + b"url " + b"\0\0\0\0" + data[at + 8 :]
    path = tmp_path / "upload.mov"
    path.write_bytes(entry)
    index = index_video(VideoFile(SpooledFile.at(path), VideoKind.MP4))
    assert len(index.stamps) == 20  # its own samples: no reference is followed
    # and a pure reference movie holds no samples of its own
    path.write_bytes(entry[: entry.index(b"mdat") + 4] + b"\0" * 64)
    with pytest.raises(WaymarkError):
        index_video(VideoFile(SpooledFile.at(path), VideoKind.MP4))


# --- orientation ------------------------------------------------------------------------------------------------------


def turned(data: bytes, matrix: tuple[float, ...]) -> bytes:
    """The video with another display matrix in its track header (ISO/IEC 14496-12, section 8.3.2)."""
    at = data.index(b"tkhd") + 4 + 4 + 4 * 5 + 8 + 8
    fixed = [round(v * (1 << 30 if k % 3 == 2 else 1 << 16)) for k, v in enumerate(matrix)]
    return data[:at] + struct.pack(">9i", *fixed) + data[at + 36 :]


@pytest.mark.parametrize(
    ("matrix", "rotation"),
    [((0, 1, 0, -1, 0, 0, 0, 0, 1), 90), ((-1, 0, 0, 0, -1, 0, 0, 0, 1), 180), ((0, -1, 0, 1, 0, 0, 0, 0, 1), 270)],
)
def test_rotation_is_applied_once(matrix: tuple[float, ...], rotation: int) -> None:
    frame = next(read_frames(indexed(turned(video(), matrix)), VideoSegment(0, 1), ReadReport()))
    assert frame.rotation_deg == rotation
    full = frame.bgr()
    assert full.shape[:2] == ((WIDTH, HEIGHT) if rotation != 180 else (HEIGHT, WIDTH))
    # the red half was on the left
    red = {90: full[:20, 60], 180: full[60, -20:], 270: full[-20:, 60]}[rotation]
    assert red[..., 2].mean() > 150
    half = frame.half_bgr()
    assert half.shape[:2] == (full.shape[0] // 2, full.shape[1] // 2)


@pytest.mark.parametrize("matrix", [(-1, 0, 0, 0, 1, 0, 0, 0, 1), (0.7, 0.7, 0, -0.7, 0.7, 0, 0, 0, 1)])
def test_mirrored_and_tilted_videos_are_refused(matrix: tuple[float, ...]) -> None:
    with pytest.raises(UnsupportedUpload):
        next(read_frames(indexed(turned(video(), matrix)), VideoSegment(0, 1), ReadReport()))


# --- archives and damage ----------------------------------------------------------------------------------------------


def test_a_stored_video_is_read_where_it_lies() -> None:
    def packed(method: int) -> SpooledFile:
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", method) as archive:
            archive.writestr("drive/front.mp4", video())
            archive.writestr("poses.csv", "time,lon,lat\n")
        return SpooledFile.of(out.getvalue())

    stored = packed(zipfile.ZIP_STORED)
    assert holds_video(stored)
    opened = open_packed_video(stored, ArchiveLimits())
    assert [name for name, _data in opened.beside] == ["poses.csv"]
    assert numbers(index_video(opened.video)) == list(range(20))
    with pytest.raises(UnsupportedUpload, match="compressed"):
        open_packed_video(packed(zipfile.ZIP_DEFLATED), ArchiveLimits())


@pytest.mark.parametrize("seed", range(40))
def test_damaged_videos_raise_only_our_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    codec, form, kind = [("mpeg4", "mp4", VideoKind.MP4), ("mjpeg", "avi", VideoKind.AVI)][seed % 2]
    data = bytearray(video(10, codec=codec, form=form))
    for _ in range(int(rng.integers(1, 60))):
        at = int(rng.integers(16, len(data)))
        data[at] = int(rng.integers(256))
    try:
        index = indexed(bytes(data[: int(rng.integers(100, len(data) + 1))]), kind)
        for frame in read_frames(index, VideoSegment(0, len(index.stamps)), ReadReport()):
            frame.half_bgr()
    except WaymarkError:
        pass
