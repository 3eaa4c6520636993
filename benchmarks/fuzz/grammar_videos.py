"""Valid videos with known times of their frames: containers around streams that are encoded once."""

from __future__ import annotations

import io
import tempfile
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from app.formats.format import SpooledFile
from app.formats.video import index_video, read_frames
from app.formats.video_file import ReadReport, VideoFile, VideoKind, detect_video
from benchmarks.fuzz.grammar import Check, Grammar, Rng
from benchmarks.fuzz.grammar_tables import chance, pick

_FRAMES = 30
_SIZE_PX = (96, 64)
_KINDS = {"mp4": VideoKind.MP4, "mov": VideoKind.MP4, "matroska": VideoKind.MATROSKA, "mpegts": VideoKind.MPEG_TS}


def _grey_of(number: int) -> int:
    return 20 + 7 * number


@dataclass(frozen=True, slots=True)
class _Stream:
    """Packets in the order of decoding, and the number of the frame in each."""

    template: bytes  # a Matroska file, whose stream the others copy
    header: bytes  # that transport streams repeat before each frame at which decoding can begin
    packets: list[tuple[bytes, int, bool]]  # content, number of the frame, whether decoding can begin here


@cache
def _encoded(codec: str, between: int, group: int) -> _Stream:
    """Frames whose level is their number, with so many B-frames in a row, in groups of pictures of a length."""
    import av

    out = io.BytesIO()
    with av.open(out, "w", format="matroska") as target:
        stream: Any = target.add_stream(codec, rate=10)
        stream.codec_context.max_b_frames, stream.codec_context.gop_size = between, group
        stream.width, stream.height = _SIZE_PX
        stream.bit_rate = 8_000_000  # so that levels stay
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if codec == "libx264":
            x264 = f"log-level=none:scenecut=0:keyint={group}:bframes={between}:b-adapt=0:open-gop=1"
            stream.options = {"preset": "ultrafast", "x264-params": x264}
        for number in range(_FRAMES):
            frame = av.VideoFrame.from_ndarray(np.full(_SIZE_PX[::-1], _grey_of(number), np.uint8), format="gray")
            frame.pts, frame.time_base = number, Fraction(1, 10)
            target.mux(stream.encode(frame))
        target.mux(stream.encode(None))
    with av.open(io.BytesIO(out.getvalue()), "r") as source:
        header = bytes(source.streams.video[0].codec_context.extradata or b"")
        packets = [
            (bytes(packet), round(float(packet.pts * packet.time_base) * 10), bool(packet.is_keyframe))
            for packet in source.demux(video=0)
            if packet.size and packet.pts is not None and packet.time_base is not None
        ]
    return _Stream(out.getvalue(), header if codec == "mpeg4" else b"", packets)


def _video(rng: Rng) -> tuple[bytes, Check]:
    """A container with times of its own; MP4 also with edit lists, in fragments, and with the index first."""
    codec = str(pick(rng, "libx264", "libx264", "mpeg4", "mjpeg"))
    between, group = (0 if codec == "mjpeg" else int(pick(rng, 0, 1, 2))), int(pick(rng, 5, 12))
    form = str(pick(rng, "mp4", "mp4", "mov", "matroska", "mpegts"))
    if form == "mpegts" and codec == "mjpeg":
        form = "matroska"  # ISO/IEC 13818-1 has no stream type for it
    stream = _encoded(codec, between, group)
    # intervals in units of the container's clock; Matroska counts milliseconds, transport streams 90 kHz
    scale = {"matroska": 1000, "mpegts": 90_000}.get(form, int(pick(rng, 600, 1000, 12_800, 30_000, 90_000)))
    usual = round(scale * float(pick(rng, 1 / 30, 0.04, 0.1)))
    steps = np.full(_FRAMES, usual)
    if chance(rng):  # a variable rate
        steps = rng.integers(max(usual // 2, 2), 2 * usual, _FRAMES)
    if chance(rng, 0.3):  # a pause
        steps[int(rng.integers(1, _FRAMES))] += 3 * scale
    shown_at = np.cumsum(steps)
    shown_at -= shown_at[0]
    # frames before a cut are needed to decode those after it, and not shown
    cut = int(rng.integers(1, 15)) if form in ("mp4", "mov") and chance(rng, 0.4) else 0
    start = -int(shown_at[cut]) if cut else int(pick(rng, 0, 0, scale // 2, 7 * scale))
    if form == "mpegts":
        # ISO/IEC 13818-1 counts 33 bits: a recording that begins shortly before the end begins again at 0
        start = int(pick(rng, 0, 126_000, 2**33 - int(shown_at[-1]) // 2))
    reordered = between > 0 and codec != "mjpeg"
    delay = 2 if between > 1 else 1 if reordered else 0
    sent_at = [int(shown_at[k - delay]) if k >= delay else (k - delay) * 2 for k in range(_FRAMES)]
    options = {"avoid_negative_ts": "disabled"}
    if form in ("mp4", "mov"):
        fragments = chance(rng, 0.25) and not cut
        options |= {"use_editlist": "1", "video_track_timescale": str(scale)}
        flags = "frag_keyframe+empty_moov+delay_moov" if fragments else str(pick(rng, "", "faststart"))
        options |= {"movflags": flags} if flags else {}
    packets = [
        (
            stream.header + content if is_key and form == "mpegts" else content,
            int(shown_at[number]) + start,
            sent_at[k] + start,
            is_key,
        )
        for k, (content, number, is_key) in enumerate(stream.packets)
    ]
    written = _muxed(stream.template, packets, form, scale, usual, options)
    times_s = (shown_at[cut:] - shown_at[cut]) / scale
    what = f"{codec} in {form}, {between} B-frames, groups of {group}, cut {cut}, start {start}, 1/{scale} s, {options}"

    def check() -> str:
        kind = detect_video(written[:65536])
        if kind is not _KINDS[form]:
            return f"recognised as {kind} ({what})"
        index = index_video(VideoFile(SpooledFile.of(written), kind))
        count = len(index.time_s)
        kept = np.arange(len(times_s))
        lost = len(times_s) - count
        if between and form in ("mp4", "mov") and 0 < lost <= 2:
            # libavformat leaves out the last frames of a file where an edit ends with a key frame: a warning states it
            kept = kept[~np.isin(kept + cut, [number for _content, number, _is_key in stream.packets[-lost:]])]
        if count != len(kept):
            return f"{count} of {len(times_s)} frames ({what}; {index.warnings})"
        hidden = f"leaves out {_FRAMES - count} of its {_FRAMES} frames"
        if any("leaves out" in warning for warning in index.warnings) is not (count < _FRAMES) or (
            count < _FRAMES and hidden not in " ".join(index.warnings)
        ):
            return f"warnings {index.warnings} about {_FRAMES - count} frames ({what})"
        if np.abs(index.time_s - times_s[kept]).max() > 1e-6:
            return f"times off by {np.abs(index.time_s - times_s[kept]).max():.6f} s ({what})"
        levels = [
            (frame.number, float(np.median(frame.grey())))
            for segment in index.segments
            for frame in read_frames(index, segment, ReadReport())
        ]
        if [number for number, _ in levels] != list(range(count)):
            return f"frames {[number for number, _ in levels]} of {len(times_s)} ({what})"
        wrong = [(number, level) for number, level in levels if abs(level - _grey_of(int(kept[number]) + cut)) > 3.4]
        return f"frames with the level of another: {wrong[:4]} ({what})" if wrong else ""

    return written, check


def _muxed(
    template: bytes,
    packets: list[tuple[bytes, int, int, bool]],
    form: str,
    scale: int,
    lasting: int,
    options: dict[str, str],
) -> bytes:
    """A container of packets: content, times of presentation and decoding, and whether decoding can begin there.

    `lasting` is how long the last one is shown. [1/scale s]
    """
    import av

    with tempfile.TemporaryDirectory() as folder:  # the index comes first only in files that can be read again
        path = Path(folder) / "video"
        with av.open(io.BytesIO(template)) as source, av.open(str(path), "w", format=form, options=options) as target:
            track: Any = target.add_stream_from_template(source.streams.video[0])
            track.time_base = Fraction(1, scale)
            for content, shown_at, sent_at, is_key in packets:
                packet = av.Packet(content)
                packet.time_base = Fraction(1, scale)
                packet.duration = lasting
                packet.pts, packet.dts, packet.is_keyframe, packet.stream = shown_at, sent_at, is_key, track
                target.mux(packet)
        return path.read_bytes()


VIDEO_GRAMMARS: dict[str, Grammar] = {"video": _video}
