"""Packets of an uploaded packet log. Its content decides which format it has, never its name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import islice

from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import Confidence, Format, Sample, Use, detect_format, list_accepted
from app.formats.logs import LogReport
from app.formats.packets.json import looks_like_json_dump, read_json
from app.formats.packets.rows import (
    ALIASES,
    FIELD,
    NEEDED,
    PacketDeclaration,
    PacketFormat,
    PacketLimits,
    PacketSource,
    is_raw_payload,
    looks_like_hex_lines,
    missing_columns,
    read_csv,
    read_hex_lines,
    read_raw_payloads,
    version_share,
    warn_untimed,
)
from app.formats.text import clean_text
from app.sensors.pose_track import ReceivedPacket

# === Formats of packet logs: how each is detected and read.


PacketReader = Callable[[PacketSource], Iterable[ReceivedPacket]]

_LIKELY_SHARE = 0.9  # [1] of payloads with our version; of random bytes one in 16 has it
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
    if sample.start.lstrip("\x1e").startswith(("{", "[")):  # RFC 7464 puts a record separator before each text
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
        "JSON or JSON lines with the same names, or uplinks of ChirpStack v4, The Things Stack v3, The Things Network "
        "v2, Loriot, Helium, AWS IoT Core, Actility ThingPark or Semtech's gateways (rxpk)",
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
        lambda source: read_hex_lines(source.sample.text, source.declaration.times, source.report),
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


# === Packets of an uploaded packet log. Its content decides which format it has, never its name.


EXPECTED = list_accepted(PACKET_FORMATS)
_CURE = "export the log in one of these formats; a CSV needs the names of its columns in its first line"


@dataclass(frozen=True, slots=True)
class PacketLog:
    """Packets of a log, and the report about reading it."""

    packets: list[ReceivedPacket]
    report: LogReport


def read_packets(
    name: str, data: bytes, declaration: PacketDeclaration | None = None, limits: PacketLimits | None = None
) -> PacketLog:
    """Read a packet log of any known format.

    Parameters
    ----------
    name : str
        Of the file, for messages only.

    Returns
    -------
    PacketLog
        In the order of the file. An entry that cannot be read is left out and counted.

    Raises
    ------
    UploadTooLarge
        More bytes or packets than the limits.
    UnsupportedUpload
        The format is unknown; the message lists the accepted ones.
    UnreadableUpload
        Empty, of an encoding that cannot be read, or no single entry can be read.
    InvalidParameter
        A declared column is not there.
    """
    declaration, limits = declaration or PacketDeclaration(), limits or PacketLimits()
    name = clean_text(name) or "the file"
    if not data.strip(b" \t\r\n"):
        raise UnreadableUpload(f"{name} is empty", field=FIELD, limit="at least one packet", cure="send the log whole")
    if len(data) > limits.file_bytes:
        raise UploadTooLarge(
            f"{name} has {len(data)} bytes",
            field=FIELD,
            limit=f"{limits.file_bytes} bytes",
            cure="cut the log into several",
        )
    source = PacketSource(Sample(name, data, declaration.columns or {}), declaration, limits, LogReport())
    packets = list(islice(_read_any(source), limits.packets + 1))
    if len(packets) > limits.packets:
        raise UploadTooLarge(
            f"{name} holds too many packets", field=FIELD, limit=f"{limits.packets}", cure="cut the log into several"
        )
    _check_outcome(name, packets, source.report)
    return PacketLog(packets, source.report)


def _read_any(source: PacketSource) -> Iterable[ReceivedPacket]:
    sample = source.sample
    if sample.is_text and sample.decoded[1] is not None:
        source.report.warn(sample.decoded[1])
    found = detect_format(sample, PACKET_FORMATS)
    if found is not None:
        source.report.format = found.name
        return found.read(source)
    if sample.is_text and sample.declared:
        raise missing_columns(source, sample.declared)
    raise _unsupported(sample)


def _check_outcome(name: str, packets: list[ReceivedPacket], report: LogReport) -> None:
    if not packets and report.left_out:
        first = report.left_out[0]
        raise UnreadableUpload(
            f"none of the {report.entries} entries of {name} can be read; entry {first.entry}: {first.reason}",
            field=FIELD,
            limit=EXPECTED,
            cure=_CURE,
        )
    untimed = sum(1 for packet in packets if math.isnan(packet.received_at_s))
    warn_untimed(report, len(packets), untimed)


def _unsupported(sample: Sample) -> UnsupportedUpload:
    other = find_other_format(sample.data)
    columns = sample.log.columns[:12] if sample.is_text else ()
    shown = ", ".join(repr(clean_text(column, 40)) for column in columns if clean_text(column, 40))
    what = f" ({other})" if other else f"; its first line is {shown}" if shown else ""
    return UnsupportedUpload(
        f"{sample.name} has no format that packet logs are read in{what}", field=FIELD, limit=EXPECTED, cure=_CURE
    )
