"""An uploaded packet log -> packets as they were heard. What a file is shows in its content, never in its name."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import islice
from typing import Any

from app.decoders.cerpm.log_report import LogReport
from app.decoders.cerpm.log_text import (
    clean_text,
    decode_text,
    find_table,
    is_text,
    match_columns,
    numbered_lines,
    repeated_names,
)
from app.decoders.cerpm.log_times import LogClock, has_zone
from app.decoders.cerpm.packet_log_json import read_records
from app.decoders.cerpm.packet_log_raw import (
    is_raw_payload,
    looks_like_hex_lines,
    read_hex_lines,
    read_raw_payloads,
)
from app.decoders.cerpm.packet_log_rows import (
    ALIASES,
    NEEDED,
    BrokenEntry,
    PayloadText,
    packet_from_values,
    warn_untimed,
)
from app.decoders.cerpm.packets import HeardPacket
from app.decoders.cerpm.uplinks import find_kind, open_envelope, packet_from_uplink
from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge

FIELD = "file"
EXPECTED = (
    "CSV with a header line (id, latitude, longitude, altitude, rssi, snr, timestamp, or a payload column), the same "
    "as JSON lines, payloads as 24 raw bytes each or as lines of hex, or uplinks of ChirpStack v4 or The Things Stack "
    "v3 as JSON"
)
_CURE = "export the log in one of these formats; a CSV needs the names of its columns in its first line"
_KNOWN_SHAPES = 100
_MAGIC = {
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


class PacketFormat(StrEnum):
    """What a log is."""

    CSV = "csv"
    JSON = "json"
    CHIRPSTACK = "chirpstack-v4"
    THINGS_STACK = "things-stack-v3"
    RAW = "raw-payloads"
    HEX = "hex-lines"


@dataclass(frozen=True, slots=True)
class PacketDeclaration:
    """What the uploader says of a log; all of it may be left out.

    Attributes
    ----------
    clock : LogClock
    columns : mapping of str to str
        Names of columns in place of the usual ones, by quantity: payload, number, lon, lat, height, rssi, snr, time,
        side, speed_km_h, speed_mph, device, event, crs.
    payload_text : PayloadText
        How the payload column is written; `auto` takes what gives 24 bytes.

    Raises
    ------
    InvalidParameter
        A quantity is not one of these.
    """

    clock: LogClock = field(default_factory=LogClock)
    columns: Mapping[str, str] = field(default_factory=dict)
    payload_text: PayloadText = PayloadText.AUTO

    def __post_init__(self) -> None:
        unknown = sorted(set(self.columns) - set(ALIASES))
        if unknown:
            raise InvalidParameter(
                f"there is no quantity {unknown[0]!r} in a packet log", field="columns", limit=", ".join(ALIASES)
            )


@dataclass(frozen=True, slots=True)
class PacketLimits:
    """What reading a log may cost.

    Attributes
    ----------
    file_bytes : int
        Largest file. [byte]
    document_bytes : int
        Largest single JSON document; JSON lines may be longer together. [byte]
    packets : int
    """

    file_bytes: int = 64 * 1024**2
    document_bytes: int = 16 * 1024**2
    packets: int = 500_000


@dataclass(frozen=True, slots=True)
class PacketLog:
    """Packets of a log, and about reading it."""

    packets: list[HeardPacket]
    report: LogReport


def read_packets(
    name: str, data: bytes, declaration: PacketDeclaration | None = None, limits: PacketLimits | None = None
) -> PacketLog:
    """Read a packet log of any known format.

    Parameters
    ----------
    name : str
        Of the file, for messages only.
    data : bytes
    declaration : PacketDeclaration, optional
    limits : PacketLimits, optional

    Returns
    -------
    PacketLog
        In the order of the file. An entry that cannot be read is left out and counted.

    Raises
    ------
    UploadTooLarge
        More bytes or packets than the limits.
    UnsupportedUpload
        No known format; says what is expected.
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
    report = LogReport()
    found = _read_any(name, data, declaration, limits, report)
    packets = list(islice(found, limits.packets + 1))
    if len(packets) > limits.packets:
        raise UploadTooLarge(
            f"{name} holds too many packets", field=FIELD, limit=f"{limits.packets}", cure="cut the log into several"
        )
    _check_outcome(name, packets, report)
    return PacketLog(packets, report)


def _read_any(
    name: str, data: bytes, declaration: PacketDeclaration, limits: PacketLimits, report: LogReport
) -> Iterable[HeardPacket]:
    if not is_text(data):
        if _known_otherwise(data) is None and is_raw_payload(data):
            report.format = PacketFormat.RAW
            return read_raw_payloads(data, report)
        raise _unsupported(name, data)
    text, note = decode_text(name, data)
    if note:
        report.warn(note)
    start = text.lstrip("\ufeff \t\r\n")[:1]
    if start in ("{", "[") or _is_json_dump(text):
        report.format = PacketFormat.JSON
        return _read_json(name, text, declaration, limits, report)
    _number, header = next(numbered_lines(text), (0, ""))
    table = find_table(header[: 1 << 16])
    places = match_columns(table.columns, ALIASES, declaration.columns)
    if "payload" in places or all(quantity in places for quantity in NEEDED):
        report.format = PacketFormat.CSV
        return _read_csv(name, text, declaration, report)
    if declaration.columns:
        raise _missing_columns(name, table.columns, declaration.columns)
    if looks_like_hex_lines(text):
        report.format = PacketFormat.HEX
        return read_hex_lines(text, declaration.clock, report)
    raise _unsupported(name, data, table.columns)


# --- CSV ----------------------------------------------------------------------------------------------------------


def _read_csv(name: str, text: str, declaration: PacketDeclaration, report: LogReport) -> Iterator[HeardPacket]:
    lines = numbered_lines(text)
    _number, header = next(lines)
    table = find_table(header[: 1 << 16])
    missing = {q: n for q, n in declaration.columns.items() if n not in table.columns}
    if missing:
        raise _missing_columns(name, table.columns, missing)
    for repeated in repeated_names(table.columns):
        report.warn(f"{name} has several columns named {repeated!r}; the first is read")
    places = match_columns(table.columns, ALIASES, declaration.columns)
    written = _payload_text(table.columns[places["payload"]] if "payload" in places else "", declaration)
    zoned = True
    for entry, (_number, line) in enumerate(lines):
        report.entries += 1
        try:
            cells = table.cells(line) if len(line) <= 1 << 18 else None
            if cells is None:
                raise BrokenEntry("malformed", f"the row does not have {len(table.columns)} cells that can be read")
            values = {quantity: cells[place] for quantity, place in places.items()}
            zoned = zoned and _names_zone(values.get("time", ""))
            yield packet_from_values(entry, values, declaration.clock, written, decimal_comma=table.decimal_comma)
        except BrokenEntry as broken:
            report.leave_out(entry, broken.kind, broken.reason)
    if not zoned and not declaration.clock.utc_offset_s:
        report.warn("times without a zone were taken as UTC; declare the zone's offset if they are local")


def _names_zone(text: str) -> bool:
    return ":" not in text or has_zone(text)


def _payload_text(column: str, declaration: PacketDeclaration) -> PayloadText:
    if declaration.payload_text is not PayloadText.AUTO:
        return declaration.payload_text
    lower = column.lower()
    if "hex" in lower:
        return PayloadText.HEX
    return PayloadText.BASE64 if re.search(r"b(ase)?_?64", lower) else PayloadText.AUTO


# --- JSON ---------------------------------------------------------------------------------------------------------


def _read_json(
    name: str, text: str, declaration: PacketDeclaration, limits: PacketLimits, report: LogReport
) -> Iterator[HeardPacket]:
    known: dict[tuple[str, ...], dict[str, int]] = {}
    for entry, record in read_records(name, text, limits.document_bytes):
        report.entries += 1
        try:
            if isinstance(record, BrokenEntry):
                raise record
            yield _packet_from_record(entry, record, declaration, report, known)
        except BrokenEntry as broken:
            report.leave_out(entry, broken.kind, broken.reason)


def _packet_from_record(
    entry: int,
    record: Mapping[str, Any],
    declaration: PacketDeclaration,
    report: LogReport,
    known: dict[tuple[str, ...], dict[str, int]],
) -> HeardPacket:
    event, outer_time = open_envelope(record)
    kind = find_kind(event)
    if kind is not None:
        report.format = str(kind)
        return packet_from_uplink(entry, kind, event, declaration.clock)
    names = tuple(event)[:256]
    places = match_columns(names, ALIASES, declaration.columns) if names not in known else known[names]
    if len(known) < _KNOWN_SHAPES:
        known[names] = places
    if "payload" not in places and not all(quantity in places for quantity in NEEDED):
        raise BrokenEntry(
            "unknown", "neither an uplink nor an object with a payload, or with id, latitude and longitude"
        )
    values = {quantity: event[names[place]] for quantity, place in places.items()}
    values.setdefault("time", outer_time)
    written = _payload_text(names[places["payload"]] if "payload" in places else "", declaration)
    return packet_from_values(entry, values, declaration.clock, written)


def _is_json_dump(text: str) -> bool:
    """Whether lines hold a word or two and then a JSON object: what mosquitto_sub -v and event streams write."""
    lines = [line for _number, line in islice(numbered_lines(text[: 1 << 16]), 20)]
    held = sum(1 for line in lines if re.match(r"[^{},;\"]{1,512}[\s:]\{\s*\"", line[:1024]))
    return 2 * held > len(lines) or (held > 0 and lines[0].startswith(("data:", "event:", "id:", ":")))


# --- outcomes -----------------------------------------------------------------------------------------------------


def _check_outcome(name: str, packets: list[HeardPacket], report: LogReport) -> None:
    if not packets and report.left_out:
        first = report.left_out[0]
        raise UnreadableUpload(
            f"none of the {report.entries} entries of {name} can be read; entry {first.entry}: {first.reason}",
            field=FIELD,
            limit=EXPECTED,
            cure=_CURE,
        )
    untimed = sum(1 for packet in packets if math.isnan(packet.heard_at_s))
    warn_untimed(report, len(packets), untimed)


def _known_otherwise(data: bytes) -> str | None:
    start = data[:64].lstrip()
    return next((what for magic, what in _MAGIC.items() if start.startswith(magic)), None)


def _unsupported(name: str, data: bytes, columns: tuple[str, ...] = ()) -> UnsupportedUpload:
    other = _known_otherwise(data)
    shown = ", ".join(repr(clean_text(column, 40)) for column in columns[:12] if clean_text(column, 40))
    what = f" ({other})" if other else f"; its first line is {shown}" if shown else ""
    return UnsupportedUpload(
        f"{name} is no packet log that is known here{what}", field=FIELD, limit=EXPECTED, cure=_CURE
    )


def _missing_columns(name: str, found: tuple[str, ...], wanted: Mapping[str, str]) -> InvalidParameter:
    quantity, column = next(iter(wanted.items()))
    shown = ", ".join(repr(clean_text(c, 40)) for c in found[:24])
    return InvalidParameter(
        f"{name} has no column {column!r} for {quantity}; its columns are {shown}",
        field=f"columns.{quantity}",
        limit=f"one of {shown}",
        cure="declare the names as the first line has them",
    )
