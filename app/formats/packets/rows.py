"""Packets from rows with named values, as CSV and JSON have them."""

from __future__ import annotations

import base64
import binascii
import math
import re
from collections.abc import Mapping
from enum import StrEnum

from app.errors import InvalidParameter
from app.formats.delimited import read_number
from app.formats.log_report import LogReport
from app.formats.log_times import LogClock
from app.formats.text import clean_text
from app.geodesy import check_lon_lat
from app.markers.cerpm import HEIGHT_M, MAX_NUMBER, MAX_SPEED_LIMIT, MESSAGE_BYTES, LaneSide, SpeedLimit, SpeedUnit
from app.sensors.receiver import PlainClaim, ReceivedPacket

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
        "utc_time", "time_utc", "timestamp_ms", "time_ms", "unix_time",
    ),
    "side": ("side", "lane_side", "lane"),
    "speed_km_h": ("speed_limit_km_h", "speed_limit_kmh", "speed_limit_kph"),
    "speed_mph": ("speed_limit_mph",),
    "speed": ("speed_limit", "speedlimit"),
    "speed_unit": ("speed_limit_unit", "speed_unit"),
    "device": ("dev_eui", "deveui", "device_id", "device", "device_name", "sender"),
    "event": ("event", "event_id", "uplink_id", "deduplication_id", "deduplicationid"),
    "crs": ("crs", "datum", "srs"),
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
        ("speed_km_h", SpeedUnit.KM_H),
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
    if untimed:
        report.warn(
            f"{untimed} of {packets} packets have no time between 2000 and 2100: replays among them cannot be "
            "detected, and the position of the vehicle is not known; declare the clock's scale or offset if there "
            "are times"
        )
