"""Formats of packet logs: how each is detected and read."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from app.formats.format import Confidence, Format, Sample, Use
from app.formats.packets.csv_log import read_csv
from app.formats.packets.declaration import PacketFormat, PacketSource
from app.formats.packets.json_log import looks_like_json_dump, read_json
from app.formats.packets.raw import (
    is_raw_payload,
    looks_like_hex_lines,
    read_hex_lines,
    read_raw_payloads,
    version_share,
)
from app.formats.packets.rows import ALIASES, NEEDED
from app.sensors.receiver import ReceivedPacket

PacketReader = Callable[[PacketSource], Iterable[ReceivedPacket]]

_LIKELY_SHARE = 0.9  # [1] of payloads with our version; of random bytes one in 16 has it; chosen by hand
_OTHER = {
    b"PK": "a ZIP archive: unpack it",
    b"\x1f\x8b": "compressed by gzip: unpack it",
    b"PAR1": "a Parquet file: export it as CSV",
    b"SQLite": "a SQLite database: export the packets as CSV",
    b"%PDF": "a PDF",
    b"\x89PNG": "a picture",
    b"\xff\xd8\xff": "a picture",
    b"\xd4\xc3\xb2\xa1": "a packet capture: export the payloads as CSV",
    b"<?xml": "XML",
    b"<": "XML or HTML",
}


def find_other_format(data: bytes) -> str | None:
    """What a file is that is known not to be a packet log; None if it is not known."""
    start = data[:64].lstrip()
    return next((what for signature, what in _OTHER.items() if start.startswith(signature)), None)


def _detect_json(sample: Sample) -> Confidence:
    if not sample.is_text:
        return Confidence.NONE
    if sample.start.startswith(("{", "[")):
        return Confidence.CERTAIN
    return Confidence.LIKELY if looks_like_json_dump(sample.text) else Confidence.NONE


def _detect_csv(sample: Sample) -> Confidence:
    if not sample.is_text:
        return Confidence.NONE
    places = sample.log.places(ALIASES, sample.declared)
    found = "payload" in places or all(quantity in places for quantity in NEEDED)
    return Confidence.LIKELY if found else Confidence.NONE


def _detect_hex_lines(sample: Sample) -> Confidence:
    found = sample.is_text and not sample.declared and looks_like_hex_lines(sample.text)
    return Confidence.LIKELY if found else Confidence.NONE


def _detect_raw(sample: Sample) -> Confidence:
    if sample.is_text or find_other_format(sample.data) is not None or not is_raw_payload(sample.data):
        return Confidence.NONE
    return Confidence.LIKELY if version_share(sample.data) >= _LIKELY_SHARE else Confidence.POSSIBLE


PACKET_FORMATS: tuple[Format[PacketReader], ...] = (
    Format(
        PacketFormat.JSON,
        Use.PACKETS,
        "JSON or JSON lines with the same names, or uplinks of ChirpStack v4 or The Things Stack v3",
        _detect_json,
        read_json,
    ),
    Format(
        PacketFormat.CSV,
        Use.PACKETS,
        "CSV with a header line (id, latitude, longitude, altitude, rssi, snr, timestamp, or a payload column)",
        _detect_csv,
        read_csv,
    ),
    Format(
        PacketFormat.HEX,
        Use.PACKETS,
        "payloads as lines of hex",
        _detect_hex_lines,
        lambda source: read_hex_lines(source.sample.text, source.declaration.clock, source.report),
    ),
    Format(
        PacketFormat.RAW,
        Use.PACKETS,
        "payloads as 24 raw bytes each",
        _detect_raw,
        lambda source: read_raw_payloads(source.sample.data, source.report),
    ),
)
"""A table with a column of payloads in hex is a table: CSV stands before lines of hex."""
