"""Damaged and hostile files of all formats, small enough to send all of them through the routes in seconds."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import httpx

from tests.formats.pictures import huge_png, jpeg, lying_png, png

_SOUND = Path("docs/images/drive.zip")
_DEEP = b'{"a":' * 50_000
_LAUGHS = b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">' + b"".join(
    b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (97 + k) * 10) for k in range(9)
) + b"]><LandXML>&j;</LandXML>"  # fmt: skip


class HostileFile(NamedTuple):
    """A file, the route of its kind, and the name and context that it is sent with."""

    what: str
    route: str
    data: bytes
    name: str = "upload"
    context: str = "{}"


def hostile_files(address: str, other: Path) -> Iterator[HostileFile]:
    """All of them; those that name other files name this one, and this address."""
    yield from _frames()
    yield from _videos(address, other)
    for what, data in _of_any_reader():
        yield HostileFile(f"trace: {what}", "decodes", data, "drive.csv", '{"trace": {}}')
        yield HostileFile(f"packets: {what}", "decodes", data, "packets.json", '{"packets": {}}')
        yield HostileFile(f"survey: {what}", "imports", data)
        yield HostileFile(f"alignment: {what}", "alignments", data)
    yield HostileFile("alignment: entities", "alignments", _LAUGHS)
    yield HostileFile("survey: entities", "imports", _LAUGHS)
    yield HostileFile("trace: Parquet that is none", "decodes", b"PAR1" + bytes(400) + b"PAR1", "a", '{"trace": {}}')


def _frames() -> Iterator[HostileFile]:
    for what, data in (
        ("cut JPEG", jpeg()[:-300]), ("lying PNG", lying_png()), ("huge PNG", huge_png()), ("cut PNG", png()[:-30]),
        ("cut archive", _zip({"0.png": png()})[:-40]), ("archive bomb", _zip({"0.png": bytes(32 << 20)})),
        ("archive of a bomb", _zip({"0.zip": _zip({"0.png": bytes(32 << 20)})})),
    ):  # fmt: skip
        yield HostileFile(f"frame: {what}", "decodes", data)


def _videos(address: str, other: Path) -> Iterator[HostileFile]:
    """Lists that FFmpeg would follow, in the name of a video and inside an archive, and videos that end early."""
    lists = {
        "ffconcat of a file": f"ffconcat version 1.0\nfile {other}\n",
        "ffconcat of an address": f"ffconcat version 1.0\nfile {address}/a.mp4\n",
        "m3u8": f"#EXTM3U\n#EXTINF:10,\nfile://{other}\n#EXTINF:10,\n{address}/b.ts\n#EXT-X-ENDLIST\n",
        "SDP": f"v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 {address.removeprefix('http://').partition(':')[0]}\nt=0 0\n"
        f"m=video {address.rpartition(':')[2]} RTP/AVP 96\na=rtpmap:96 H264/90000\n",
        "MPD": f'<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011"><BaseURL>{address}/</BaseURL></MPD>',
    }
    for what, text in lists.items():
        yield HostileFile(f"video: {what}", "decodes", text.encode(), "upload.mp4")
        yield HostileFile(f"archived video: {what}", "decodes", _zip({"front.mp4": text.encode()}), "drive.zip")
    starts = {
        "MP4": b"\x00\x00\x00\x20ftypisom\x00\x00\x02\x00isomiso2avc1mp41", "AVI": b"RIFF\xff\xff\x00\x00AVI LIST",
        "ROS 1 bag": b"#ROSBAG V2.0\n", "MCAP": b"\x89MCAP0\r\n",
    }  # fmt: skip
    for what, start in starts.items():
        yield HostileFile(f"video: cut {what}", "decodes", start + b"\xff" * 2000, "upload.mp4")


def _of_any_reader() -> Iterator[tuple[str, bytes]]:
    sound = _SOUND.read_bytes()
    yield "cut archive", sound[: len(sound) // 2]
    yield "bomb", _zip({"a.csv": bytes(32 << 20)})
    yield "deep JSON", _DEEP
    yield "not numbers", b"longitude,latitude,timestamp\nnan,1e999,nan\n" * 50
    yield "no text", b"\x00\xed\xa0\x80\xff" * 500


def send(client: httpx.Client, file: HostileFile) -> httpx.Response:
    """Through the route of its kind."""
    if file.route == "decodes":
        parts: dict[str, Any] = {"file": (file.name, file.data), "context": (None, file.context, "application/json")}
    else:
        declaration = {"name": file.what} if file.route == "alignments" else {"dry_run": True}
        parts = {
            "file": (file.name, file.data), "declaration": (None, json.dumps(declaration), "application/json")
        }  # fmt: skip
    return client.post(f"/v1/{file.route}", files=parts)


def _zip(members: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()
