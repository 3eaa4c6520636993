"""Messages of MCAP files, ROS 2 bags in SQLite and ROS 1 bags, by one interface.

The libraries are an extra of Waymark: `bags`.
"""

from __future__ import annotations

import importlib.util
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, Any, BinaryIO

from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import SpooledFile

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

FIELD = "file"
MAX_CHUNK_BYTES = 256 * 1024**2
"""[byte] of a chunk once it is expanded. Recorders write 0.8 to 8 MB."""
MAX_EXPANSION = 20
"""[1] by which the chunks of a bag expand together, beyond `MAX_CHUNK_BYTES`. Recordings expand 1 to 5 times, and each
expanded byte is read two or three times."""
CDR, ROS1 = "cdr", "ros1"
"""Encodings of messages: of ROS 2, and of ROS 1, which MCAP files that were converted from ROS 1 bags keep."""
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""Of messages that `ros2 bag record --compression-mode message` compressed one by one; CDR begins with a zero."""
_CHUNK_HEAD, _RECORD_HEAD_BYTES = struct.Struct("<BQQQQ"), 9
_SIZES = "compressed_size", "uncompressed_size"
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_ROS1_MAGIC = b"#ROSBAG V2.0\n"
_SQLITE_MAGIC = b"SQLite format 3\0"
SIGNATURES = (_MCAP_MAGIC, _ROS1_MAGIC, _SQLITE_MAGIC)
ACCEPTED = "MCAP, a ROS 2 bag in SQLite (.db3), or a ROS 1 bag of version 2.0"
_GEOPACKAGE = slice(68, 72), b"GPKG"
"""Application id in the header of an SQLite file. Source: OGC 12-128r19, requirement 2."""


class BagKind(StrEnum):
    """Kinds of bags that are read."""

    MCAP = "mcap"
    ROS1 = "ros1"
    SQLITE = "ros2-sqlite"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic with the type of its messages, e.g. ``sensor_msgs/msg/CompressedImage``."""

    name: str
    type_name: str
    encoding: str


@dataclass(frozen=True, slots=True)
class BagMessage:
    """A message: topic, time of recording [ns since 1970], and its bytes."""

    topic: Topic
    time_ns: int
    data: bytes

    @property
    def stamp_ns(self) -> int:
        """Stamp of the header, which types with a header begin with; 0 if it is cut off. [ns since 1970]"""
        place, form = (4, "<II") if self.topic.encoding == ROS1 else (4, "<iI" if self.data[1:2] == b"\x01" else ">iI")
        if len(self.data) < place + 8:
            return 0
        seconds, nanoseconds = struct.unpack_from(form, self.data, place)
        return int(seconds) * 10**9 + int(nanoseconds)


def detect_bag(head: bytes) -> BagKind | None:
    """The kind of a bag by its first bytes; None if it is none.

    Raises
    ------
    UnsupportedUpload
        A GeoPackage.
    """
    if head.startswith(_MCAP_MAGIC):
        return BagKind.MCAP
    if head.startswith(_ROS1_MAGIC):
        return BagKind.ROS1
    if head.startswith(_SQLITE_MAGIC):
        place, name = _GEOPACKAGE
        if head[place] == name:
            raise UnsupportedUpload(
                "a GeoPackage is a survey and not a recording",
                field=FIELD,
                limit=ACCEPTED,
                cure="POST it to /v1/imports",
            )
        return BagKind.SQLITE
    return None


def types_of(package: str, name: str) -> tuple[str, str]:
    """Name of a type of messages in ROS 2 and in ROS 1, e.g. ``sensor_msgs/msg/Image``."""
    return f"{package}/msg/{name}", f"{package}/{name}"


def describe_topics(topics: list[Topic]) -> str:
    """Topics with their types, the first ten."""
    shown = ", ".join(f"{topic.name[:80]} ({topic.type_name[:80] or 'unknown'})" for topic in topics[:10])
    return f"{shown or 'no topic'}{' and more' if len(topics) > 10 else ''}"


class Bag:
    """An open bag.

    Attributes
    ----------
    topics : list of Topic
    """

    def __init__(self, kind: BagKind, reader: Any) -> None:
        self._kind, self._reader = kind, reader
        # each publisher of a topic has a connection, or a channel, of its own
        self.topics: list[Topic] = list({topic.name: topic for topic in self._list_topics()}.values())

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[BagMessage]:
        """Messages of some topics in the order of time, from a time on and before another one."""
        with _defects():
            if self._kind is BagKind.MCAP:
                known = {topic.name: topic for topic in self.topics}
                options = {"topics": list(topics), "starting_at": start_ns, "ending_before": end_ns}
                for _schema, channel, message in self._reader.iter_messages(**options):
                    yield _message(known[channel.topic], int(message.log_time), message.data)
                return
            if self._kind is BagKind.SQLITE:
                known = {topic.name: topic for topic in self.topics}
                for name, time_ns, data in self._reader.messages(topics, start_ns, end_ns):
                    yield _message(known[name], time_ns, data)
                return
            connections = [c for c in self._reader.connections if c.topic in topics]
            if connections:
                for connection, time_ns, data in self._reader.messages(connections, start_ns, end_ns):
                    topic = Topic(connection.topic, connection.msgtype, ROS1)
                    yield _message(topic, int(time_ns), data)

    def decode(self, message: BagMessage) -> Any:
        """The message as an object with the fields of its type.

        Raises
        ------
        UnsupportedUpload
            Its encoding is not that of ROS.
        UnreadableUpload
            It is damaged.
        """
        topic = message.topic
        if topic.encoding not in (CDR, ROS1):
            raise UnsupportedUpload(
                f"messages of {topic.name[:80]} have the encoding {topic.encoding[:40]!r}", field=FIELD,
                limit=f"{CDR} (ROS 2) or {ROS1}", cure="convert the recording to a ROS 2 bag",
            )  # fmt: skip
        with _defects():
            types = _types_of(topic.encoding)
            package, _, name = topic.type_name.partition("/")
            type_name = f"{package}/msg/{name.removeprefix('msg/')}"
            if topic.encoding == ROS1:
                return types.deserialize_ros1(message.data, type_name)
            return types.deserialize_cdr(message.data, type_name)

    def _list_topics(self) -> Iterator[Topic]:
        with _defects():
            if self._kind is BagKind.ROS1:
                for connection in self._reader.connections:
                    yield Topic(connection.topic, connection.msgtype, ROS1)
                return
            if self._kind is BagKind.SQLITE:
                yield from (Topic(*topic) for topic in self._reader.topics)
                return
            summary = self._reader.get_summary()
            if summary is None or not _lists_channels(summary):
                raise _damaged()
            for channel in summary.channels.values():
                schema = summary.schemas.get(channel.schema_id)
                yield Topic(channel.topic, schema.name if schema else "", channel.message_encoding)


@cache
def _types_of(encoding: str) -> Typestore:
    """Types of messages; once in a process, because the code that reads each type is compiled when it is first used."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if encoding == ROS1 else Stores.ROS2_HUMBLE)


def _lists_channels(summary: Any) -> bool:
    """Whether a summary repeats the channels and schemas of its file, which it may leave out."""
    if not summary.channels:
        return summary.statistics is not None and not summary.statistics.channel_count
    return all(not c.schema_id or c.schema_id in summary.schemas for c in summary.channels.values())


def _message(topic: Topic, time_ns: int, data: Any) -> BagMessage:
    if not 0 <= time_ns < 1 << 63:
        raise UnreadableUpload(
            f"a message of {topic.name[:80]} has the time {time_ns} ns", field=FIELD,
            limit="0 to 2^63 - 1 ns since 1970", cure="record with the clock set",
        )  # fmt: skip
    content = bytes(data)
    return BagMessage(topic, time_ns, _expanded(content) if content.startswith(_ZSTD_MAGIC) else content)


def _expanded(data: bytes) -> bytes:
    import zstandard

    size = zstandard.get_frame_parameters(data).content_size
    if size > MAX_CHUNK_BYTES and size != zstandard.CONTENTSIZE_UNKNOWN:
        raise UploadTooLarge(
            f"a message of the bag expands to {size} bytes", field=FIELD, limit=f"{MAX_CHUNK_BYTES} bytes",
            cure="record smaller pictures",
        )  # fmt: skip
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=MAX_CHUNK_BYTES)


def _check_chunks(chunks: list[Any], stream: BinaryIO) -> None:
    """Refuse an index of chunks that expand to too much, each or together, that names one twice, or is false.

    Reads the head of each chunk only: opcode, length, two times and the expanded size (MCAP specification, `Chunk`).
    """
    largest = max((chunk.uncompressed_size for chunk in chunks), default=0)
    if largest > MAX_CHUNK_BYTES:
        raise UploadTooLarge(
            f"a chunk of the bag expands to {largest} bytes", field=FIELD, limit=f"{MAX_CHUNK_BYTES} bytes",
            cure="record with smaller chunks",
        )  # fmt: skip
    end = 0
    for chunk in sorted(chunks, key=lambda chunk: chunk.chunk_start_offset):
        stream.seek(chunk.chunk_start_offset)
        _opcode, length, _first, _last, expanded = _CHUNK_HEAD.unpack(stream.read(_CHUNK_HEAD.size))
        if chunk.chunk_start_offset < end or expanded != chunk.uncompressed_size:
            raise UnreadableUpload(
                "the bag's index names a chunk twice, or with another size than it has", field=FIELD,
                limit="each chunk once", cure="write the index again with mcap recover",
            )  # fmt: skip
        end = chunk.chunk_start_offset + _RECORD_HEAD_BYTES + length
    packed, expanded = (sum(getattr(chunk, size) for chunk in chunks) for size in _SIZES)
    if expanded > MAX_CHUNK_BYTES + MAX_EXPANSION * packed:
        raise UploadTooLarge(
            f"the bag's chunks expand from {packed} to {expanded} bytes",
            field=FIELD,
            limit=f"{MAX_EXPANSION} times their size, and {MAX_CHUNK_BYTES} bytes",
            cure="record compressed pictures and no constant data",
        )


@contextmanager
def open_bag(file: SpooledFile, kind: BagKind) -> Iterator[Bag]:
    """Open a bag.

    Raises
    ------
    UnsupportedUpload
        The libraries are not installed.
    UnreadableUpload, UploadTooLarge
        The bag is damaged, cut off, or has a chunk beyond its limit.
    """
    check_installed()
    if kind is BagKind.MCAP:
        from mcap.reader import SeekingReader

        with file.open() as stream:
            with _defects():
                reader: Any = SeekingReader(stream, record_size_limit=MAX_CHUNK_BYTES)
                summary = reader.get_summary()
                if summary is not None:
                    _check_chunks(summary.chunk_indexes, stream)
            yield Bag(kind, reader)
        return
    if kind is BagKind.SQLITE:
        from app.formats.bags.sqlite_bag import SqliteBag

        with _defects():
            opened = SqliteBag(file, MAX_CHUNK_BYTES)
        try:
            yield Bag(kind, opened)
        finally:
            opened.close()
        return
    from rosbags.rosbag1 import Reader

    path: Any = _OpenedByReader(file)
    reader = Reader(path)
    with _defects():
        reader.open()
    try:
        yield Bag(kind, reader)
    finally:
        reader.close()


def check_installed() -> None:
    """Refuse bags where the libraries are missing."""
    if any(importlib.util.find_spec(name) is None for name in ("mcap", "rosbags")):
        raise UnsupportedUpload(
            "this server does not read bags", field=FIELD, limit="the extra `bags` of Waymark",
            cure="ask its operator to install waymark-roads[bags], or send the camera's video or a ZIP of frames",
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _OpenedByReader:
    """What the reader of ROS 1 bags takes for a path."""

    file: SpooledFile

    def exists(self) -> bool:
        """Always."""
        return True

    def open(self, _mode: str) -> BinaryIO:
        """A stream over the content."""
        return self.file.open()


@contextmanager
def _defects() -> Iterator[None]:
    """Report what the libraries raise on damaged bags."""
    try:
        yield
    except (MemoryError, UnreadableUpload, UnsupportedUpload, UploadTooLarge):
        raise
    except Exception as error:  # the libraries raise errors of many kinds on damaged input
        raise _damaged() from error


def _damaged() -> UnreadableUpload:
    return UnreadableUpload(
        "the bag is damaged, cut off, or has no index", field=FIELD, limit=ACCEPTED,
        cure="repair it (mcap recover, ros2 bag reindex, rosbag reindex) and send it whole",
    )  # fmt: skip
