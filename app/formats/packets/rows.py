"""Packets from rows with named values, as CSV and JSON have them, and from raw bytes of receivers."""

from __future__ import annotations

import base64
import binascii
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from itertools import islice

from pydantic import Field, field_validator

from app.errors import InvalidParameter
from app.formats.format import Sample
from app.formats.logs import ACCEPTED_TIMES, HEMISPHERES, LogClock, LogReport, in_hemisphere
from app.formats.text import MAX_LINE, clean_text, numbered_lines, read_number, repeated_names
from app.geodesy import check_lon_lat
from app.inputs import Declaration, Name
from app.markers.cerpm import (
    HEIGHT_M,
    MAX_NUMBER,
    MAX_SPEED_LIMIT,
    MESSAGE_BYTES,
    VERSION,
    LaneSide,
    SpeedLimit,
    SpeedUnit,
)
from app.sensors.pose_track import PlainClaim, ReceivedPacket

MAX_PAYLOAD = 255
"""Largest payload of one LoRa packet. [byte] Source: its length field has 8 bits (Semtech SX1276 datasheet)."""
ALIASES: dict[str, tuple[str, ...]] = {
    "payload": (
        "payload", "payload_hex", "payload_base64", "payload_b64", "frm_payload", "data", "data_hex", "raw", "hex",
        "bytes", "message",
    ),
    "number": (
        "id", "number", "marker", "marker_id", "marker_number", "cerpm", "cerpm_id", "node_id", "unique_id",
        "identification_number",
    ),
    "lon": ("longitude", "lon", "lng", "long", "lon_deg", "longitude_deg", "longitude_degrees"),
    "lat": ("latitude", "lat", "lat_deg", "latitude_deg", "latitude_degrees"),
    "height": ("altitude", "alt", "height", "height_m", "altitude_m", "alt_m", "elevation", "ellipsoidal_height"),
    "rssi": ("rssi", "rssi_dbm", "signal", "signal_dbm"),
    "snr": ("snr", "snr_db", "lsnr", "lorasnr"),
    "time": (
        "timestamp", "time", "heard_at", "heard_at_s", "received_at", "time_s", "t_s", "datetime", "date_time", "utc",
        "utc_time", "time_utc", "timestamp_ms", "time_ms", "unix_time", "zeit", "zeitstempel",
    ),
    "side": ("side", "lane_side", "lane"),
    "speed_kmh": ("speed_limit_kmh", "speed_limit_km_h", "speed_limit_kph"),
    "speed_mph": ("speed_limit_mph",),
    "speed": ("speed_limit", "speedlimit"),
    "speed_unit": ("speed_limit_unit", "speed_unit"),
    "device": ("dev_eui", "deveui", "device_id", "device", "device_name", "sender"),
    "event": ("event", "event_id", "uplink_id", "deduplication_id", "deduplicationid"),
    "crs": ("crs", "datum", "srs"),
    **HEMISPHERES,
}  # fmt: skip
"""Names of the columns of a quantity, the likeliest first."""
NEEDED = ("number", "lon", "lat")
_WGS84 = frozenset(("", "wgs84", "wgs 84", "wgs-84", "wgs_84", "epsg:4326", "epsg:4979", "ogc:crs84", "4326", "w84"))
_SIDES = {
    "left": LaneSide.LEFT, "l": LaneSide.LEFT, "1": LaneSide.LEFT,
    "right": LaneSide.RIGHT, "r": LaneSide.RIGHT, "2": LaneSide.RIGHT,
    "": LaneSide.UNKNOWN, "unknown": LaneSide.UNKNOWN, "u": LaneSide.UNKNOWN, "0": LaneSide.UNKNOWN,
    "none": LaneSide.UNKNOWN, "nan": LaneSide.UNKNOWN,
}  # fmt: skip
_HEX = re.compile(r"[0-9a-fA-F]*\Z")
_UNSPACED = str.maketrans("", "", " :-\t")


class PayloadText(StrEnum):
    """Encoding of bytes as text."""

    AUTO = "auto"
    HEX = "hex"
    BASE64 = "base64"


class BrokenEntry(Exception):
    """An entry that cannot be read as a packet; the reader counts it, it never leaves the reader."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind
        self.reason = reason


def packet_from_values(
    entry: int, values: Mapping[str, object], clock: LogClock, written: PayloadText, *, decimal: str = "."
) -> ReceivedPacket:
    """One packet.

    Parameters
    ----------
    values : mapping of str to object
        By the names of `ALIASES`; quantities may be missing.

    Raises
    ------
    BrokenEntry
        Neither a payload nor a number with a position, or one that cannot be read.
    """
    rssi_dbm = _number("rssi", values.get("rssi"), -200.0, 30.0, decimal)
    snr_db = _number("snr", values.get("snr"), -60.0, 60.0, decimal)
    received_at_s = clock.read(_plain_time(values.get("time"), decimal))
    payload = read_payload(values.get("payload"), written)
    return ReceivedPacket(
        entry=entry,
        received_at_s=received_at_s,
        payload=payload,
        claim=None if payload is not None else _read_claim(values, decimal),
        rssi_dbm=rssi_dbm,
        snr_db=snr_db,
        device=clean_text(values.get("device")),
        event=clean_text(values.get("event")),
    )


def read_payload(value: object, written: PayloadText = PayloadText.AUTO) -> bytes | None:
    """Bytes from hexadecimal or base64 text, or from a list of numbers; None where there are none.

    Raises
    ------
    BrokenEntry
        Text that is neither, or more than a packet can carry.
    """
    if value is None or value in ("", []):
        return None
    if isinstance(value, list):
        if len(value) > MAX_PAYLOAD or not all(type(v) is int and 0 <= v <= 255 for v in value):
            raise BrokenEntry("payload", "the payload is a list, but not of bytes from 0 to 255")
        return bytes(value)
    if not isinstance(value, str) or len(value) > 4 * MAX_PAYLOAD:
        raise BrokenEntry("payload", f"the payload is no text of at most {MAX_PAYLOAD} bytes in hex or base64")
    text = value.strip()
    if not text:
        return None
    from_hex = None if written is PayloadText.BASE64 else _from_hex(text)
    if from_hex is not None and (len(from_hex) == MESSAGE_BYTES or written is PayloadText.HEX):
        return from_hex
    from_base64 = None if written is PayloadText.HEX else _from_base64(text)
    if from_base64 is not None and (len(from_base64) == MESSAGE_BYTES or from_hex is None):
        return from_base64
    if from_hex is None:
        wanted = "hex or base64" if written is PayloadText.AUTO else str(written)
        raise BrokenEntry("payload", f"the payload is not {wanted}")
    return from_hex


def _from_hex(text: str) -> bytes | None:
    digits = text.removeprefix("0x").removeprefix("0X")
    if not _HEX.match(digits):
        digits = digits.translate(_UNSPACED)
    if len(digits) % 2 or len(digits) > 2 * MAX_PAYLOAD or not _HEX.match(digits):
        return None
    return bytes.fromhex(digits)


def _from_base64(text: str) -> bytes | None:
    plain = text.replace("-", "+").replace("_", "/")
    try:
        content = base64.b64decode(plain + "=" * (-len(plain) % 4), validate=True)
    except (binascii.Error, ValueError):
        return None
    return content if len(content) <= MAX_PAYLOAD else None


def _plain_time(value: object, decimal: str) -> object:
    if decimal == "," and isinstance(value, str) and value.count(",") == 1:
        return value.replace(",", ".")
    return value


def _number(name: str, value: object, low: float, high: float, decimal: str) -> float:
    try:
        number = read_number(value, decimal)
    except (ValueError, OverflowError):
        raise BrokenEntry(name, f"{name} is not a number") from None
    if not math.isnan(number) and not low <= number <= high:
        raise BrokenEntry(name, f"{name} is {number:g}, outside {low:g} to {high:g}")
    return number


def _read_claim(values: Mapping[str, object], decimal: str) -> PlainClaim:
    crs = str(values.get("crs") or "").strip().lower()
    if crs not in _WGS84:
        raise BrokenEntry(
            "datum", f"the position is in {crs[:40]!r}: positions of packets are WGS 84, transform them first"
        )
    lon_deg = _number("longitude", values.get("lon"), -1e6, 1e6, decimal)
    lat_deg = _number("latitude", values.get("lat"), -1e6, 1e6, decimal)
    if math.isnan(lon_deg) or math.isnan(lat_deg):
        raise BrokenEntry("empty", "there is neither a payload nor a position")
    try:
        if "lat_hemisphere" in values:
            lat_deg = in_hemisphere(lat_deg, values["lat_hemisphere"], "lat_hemisphere")
        if "lon_hemisphere" in values:
            lon_deg = in_hemisphere(lon_deg, values["lon_hemisphere"], "lon_hemisphere")
    except ValueError as error:
        raise BrokenEntry("position", str(error)) from None
    try:
        check_lon_lat(lon_deg, lat_deg)
    except InvalidParameter as error:
        raise BrokenEntry("position", error.message) from None
    height_m = _number("height", values.get("height"), -1e9, 1e9, decimal)
    fits = HEIGHT_M[0] <= height_m <= HEIGHT_M[1]
    return PlainClaim(
        _marker_number(values.get("number")),
        lon_deg,
        lat_deg,
        height_m if fits else None,
        _side(values.get("side")),
        _speed_limit(values, decimal),
    )


def _marker_number(value: object) -> int:
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    text = str(value).strip() if isinstance(value, str | int) and not isinstance(value, bool) else ""
    if re.fullmatch(r"\d{1,10}(\.0*)?", text, re.ASCII):
        number = int(text.split(".")[0])
        if 1 <= number <= MAX_NUMBER:
            return number
    raise BrokenEntry("number", f"{text[:40]!r} is not the number of a marker: 1 to {MAX_NUMBER}")


def _side(value: object) -> LaneSide:
    text = str(value).strip().lower() if isinstance(value, str | int) else ""
    return _SIDES.get(text, LaneSide.UNKNOWN)


def _speed_limit(values: Mapping[str, object], decimal: str) -> SpeedLimit | None:
    named = str(values.get("speed_unit") or "").strip().lower()
    for name, unit in (
        ("speed_kmh", SpeedUnit.KM_H),
        ("speed_mph", SpeedUnit.MPH),
        ("speed", SpeedUnit.MPH if named == "mph" else SpeedUnit.KM_H if named in ("km/h", "kmh", "kph") else None),
    ):
        if unit is None:  # a figure without a unit is not a speed limit
            continue
        value = _number("speed limit", values.get(name), -1e9, 1e9, decimal)
        if not math.isnan(value) and value == int(value) and 1 <= value <= MAX_SPEED_LIMIT:
            return SpeedLimit(int(value), unit)
    return None


def warn_untimed(report: LogReport, packets: int, untimed: int) -> None:
    """Warn about packets without a time."""
    if not untimed:
        return
    cure = "declare the clock's scale or offset if there are times"
    if report.unread_time is not None:
        cure = (
            f"the first one that cannot be read is {report.unread_time!r}; times are {ACCEPTED_TIMES}, "
            "or declare the clock's scale, offset or day_first"
        )
    report.warn(
        f"{untimed} of {packets} packets have no time between 2000 and 2100: replays among them cannot be "
        f"detected, and the position of the vehicle is not known; {cure}"
    )


# === What is declared of a packet log, and the limits of reading one.


FIELD = "file"


class PacketFormat(StrEnum):
    """Formats of packet logs."""

    CSV = "csv"
    JSON = "json"
    RAW = "raw-payloads"
    HEX = "hex-lines"


class PacketDeclaration(Declaration):
    """What is declared of a packet log; everything is optional."""

    clock: LogClock | None = None
    columns: dict[Name, Name] | None = Field(
        None, max_length=16, description="Names of columns: payload, number, lon, lat, rssi, snr, time ..."
    )
    payload_text: PayloadText = PayloadText.AUTO

    @field_validator("columns")
    @classmethod
    def _quantities(cls, columns: dict[str, str] | None) -> dict[str, str] | None:
        if unknown := sorted(set(columns or ()) - set(ALIASES)):
            raise InvalidParameter(f"there is no quantity {unknown[0]!r} in a packet log", limit=", ".join(ALIASES))
        return columns

    @cached_property
    def times(self) -> LogClock:
        """How its times are read."""
        return self.clock or LogClock()


@dataclass(frozen=True, slots=True)
class PacketLimits:
    """Limits of reading a log."""

    file_bytes: int = 64 * 1024**2  # [byte] largest file
    document_bytes: int = 16 * 1024**2  # [byte] largest single JSON document; JSON lines may be longer together
    packets: int = 500_000


@dataclass(frozen=True, slots=True)
class PacketSource:
    """A packet log while it is read."""

    sample: Sample  # all of the file
    declaration: PacketDeclaration
    limits: PacketLimits
    report: LogReport  # filled while packets are read


# === Packet logs as delimited text with a header.


def read_csv(source: PacketSource) -> Iterator[ReceivedPacket]:
    """Packets of the rows; a row that cannot be read is left out.

    Raises
    ------
    InvalidParameter
        A declared column is missing.
    """
    declaration, report, log = source.declaration, source.report, source.sample.log
    missing = {q: n for q, n in (declaration.columns or {}).items() if n not in log.columns}
    if missing:
        raise missing_columns(source, missing)
    for repeated in repeated_names(log.columns):
        report.warn(f"{source.sample.name} has several columns named {repeated!r}; the first is read")
    places = log.places(ALIASES, declaration.columns or {})
    written = payload_text(log.columns[places["payload"]] if "payload" in places else "", declaration)
    clock = declaration.times
    if "time" not in places:
        report.warn(
            f"{source.sample.name} has no column that is named as a time; its columns are {_shown(log.columns)}: "
            "declare columns.time if one of them holds times"
        )
    else:
        texts = (cells[places["time"]] for cells in log.rows() if cells is not None)
        clock = clock.of_column(texts, "clock.day_first")
    for entry, cells in enumerate(log.rows()):
        report.entries += 1
        try:
            if cells is None:
                raise BrokenEntry("malformed", log.bad_row())
            values = {quantity: cells[place] for quantity, place in places.items()}
            packet = packet_from_values(entry, values, clock, written, decimal=log.dialect.decimal)
            report.note_unread_time(values.get("time"), packet.received_at_s)
            report.note_zone(values.get("time"), clock)
            yield packet
        except BrokenEntry as broken:
            report.leave_out(entry, broken.kind, broken.reason)


def payload_text(column: str, declaration: PacketDeclaration) -> PayloadText:
    """How payloads are written: as declared, or else by the name of their column."""
    if declaration.payload_text is not PayloadText.AUTO:
        return declaration.payload_text
    lower = column.lower()
    if "hex" in lower:
        return PayloadText.HEX
    return PayloadText.BASE64 if re.search(r"b(ase)?_?64", lower) else PayloadText.AUTO


def _shown(columns: Iterable[str]) -> str:
    return ", ".join(repr(clean_text(column, 40)) for column in islice(columns, 24))


def missing_columns(source: PacketSource, wanted: Mapping[str, str]) -> InvalidParameter:
    """The error for declared columns that a log does not have."""
    quantity, column = next(iter(wanted.items()))
    shown = _shown(source.sample.log.columns)
    return InvalidParameter(
        f"{source.sample.name} has no column {column!r} for {quantity}; its columns are {shown}",
        field=f"columns.{quantity}",
        limit=f"one of {shown}",
        cure="declare the names as the first line has them",
    )


# === Payloads without other values: bytes one after the other, or lines of hexadecimal digits.


_LONG_HEX = re.compile(r"(?:0[xX])?([0-9a-fA-F]{20,})\Z")
_BYTE = re.compile(r"[0-9a-fA-F]{2}\Z")
_DATE = re.compile(r"\d{4}-\d\d-\d\d\Z")
_CLOCK_TIME = re.compile(r"\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:?\d\d)?\Z", re.ASCII)
_SEPARATORS = re.compile(r"[,;\s|]+")
_MIN_BYTES = 8  # separate bytes in a row that are a payload, no date or address


def is_raw_payload(data: bytes) -> bool:
    """Whether bytes that are no text can be payloads: whole ones, or one of this version in any length."""
    if len(data) % MESSAGE_BYTES == 0:
        return True
    count = max(len(data) // MESSAGE_BYTES, 1)
    matching = _count_version(data[: count * MESSAGE_BYTES])
    return 2 * matching > count and (len(data) <= MAX_PAYLOAD or matching > 1)


def version_share(data: bytes) -> float:
    """Share of payloads whose first byte is that of this version, 0 to 1."""
    count = -(-len(data) // MESSAGE_BYTES)
    return _count_version(data) / count if count else 0.0


def _count_version(data: bytes) -> int:
    """Number of payloads whose first byte is that of this version."""
    return sum(1 for first in data[::MESSAGE_BYTES] if first >> 4 == VERSION)


def read_raw_payloads(data: bytes, report: LogReport) -> Iterable[ReceivedPacket]:
    """Packets of 24 bytes each; a single one may have another length, to be refused by name later."""
    if len(data) < 2 * MESSAGE_BYTES:
        report.entries = 1
        yield ReceivedPacket(0, float("nan"), data)
        return
    whole = len(data) // MESSAGE_BYTES
    report.entries = whole
    for i in range(whole):
        yield ReceivedPacket(i, float("nan"), data[i * MESSAGE_BYTES : (i + 1) * MESSAGE_BYTES])
    left = len(data) % MESSAGE_BYTES
    if left:
        report.entries += 1
        report.leave_out(whole, "cut-short", f"the last {left} bytes are no whole payload of {MESSAGE_BYTES}")


def looks_like_hex_lines(text: str) -> bool:
    """Whether the first lines hold long hexadecimal numbers."""
    lines = [line for _number, line in islice(numbered_lines(text[: 1 << 16]), 20) if not line.startswith("#")]
    held = [line for line in lines if _hex_of(_tokens(line))]
    return bool(held) and 2 * len(held) >= len(lines)


def read_hex_lines(text: str, clock: LogClock, report: LogReport) -> Iterable[ReceivedPacket]:
    """A packet a line: its bytes in hexadecimal, and beside them a time and an RSSI if there are any."""
    for _number, line in numbered_lines(text):
        if line.startswith("#"):
            continue
        entry = report.entries
        report.entries += 1
        try:
            if len(line) > MAX_LINE:
                raise BrokenEntry("long-line", f"the line has more than {MAX_LINE} characters")
            yield _read_line(entry, line, clock)
        except BrokenEntry as broken:
            report.leave_out(entry, broken.kind, broken.reason)


def _read_line(entry: int, line: str, clock: LogClock) -> ReceivedPacket:
    tokens = _tokens(line)
    found = _hex_of(tokens)
    payload = read_payload(found[0], PayloadText.HEX) if found else None
    if found is None or payload is None:
        raise BrokenEntry("payload", "there are no bytes in hexadecimal in this line")
    received_at_s, rssi_dbm = float("nan"), float("nan")
    others = tokens[: found[1]] + tokens[found[2] :]
    for i, token in enumerate(others):
        if _DATE.match(token) and i + 1 < len(others) and _CLOCK_TIME.match(others[i + 1]):
            received_at_s = clock.read(f"{token}T{others[i + 1]}")
        elif re.fullmatch(r"-\d{1,3}(\.\d+)?(dBm)?", token, re.ASCII):
            rssi_dbm = float(token.removesuffix("dBm"))
        elif received_at_s != received_at_s and not _CLOCK_TIME.match(token):
            received_at_s = clock.read(token)
    return ReceivedPacket(entry, received_at_s, payload, rssi_dbm=rssi_dbm)


def _tokens(line: str) -> list[str]:
    return [token.strip("'\"[]") for token in _SEPARATORS.split(line[:4096]) if token]


def _hex_of(tokens: list[str]) -> tuple[str, int, int] | None:
    """The bytes among the words of a line, and where they begin and end."""
    for i, token in enumerate(tokens):
        if found := _LONG_HEX.match(token):
            return found[1], i, i + 1
    start = 0
    for i in range(len(tokens) + 1):
        if i < len(tokens) and _BYTE.match(tokens[i]):
            continue
        if i - start >= _MIN_BYTES:
            return "".join(tokens[start:i]), start, i
        start = i + 1
    return None
