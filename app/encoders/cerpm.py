"""Encoding of CERPMs: the message that a marker sends, and the table that markers are programmed from."""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import ROUND_HALF_EVEN, Decimal

from app.errors import InvalidParameter
from app.formats.text import TableWriter
from app.markers.cerpm import (
    BODY_BYTES,
    DEGREE_STEP,
    HEIGHT_M,
    HEIGHT_STEP_M,
    KEY_BYTES,
    MESSAGE_BYTES,
    NO_HEIGHT,
    VERSION,
    CerpmMessage,
    LaneSide,
    SpeedUnit,
    message_tag,
)
from app.radio.settings import RadioSettings

# === CERPM message to the 24 bytes that its marker sends.


_BODY = struct.Struct(">BIiiHBI")


def encode_message(message: CerpmMessage, key: bytes) -> bytes:
    """Payload of a message.

    Parameters
    ----------
    key : bytes
        The marker's own, 16 bytes (`derive_marker_key`).

    Returns
    -------
    bytes
        24 of them, in the layout of `app.markers.cerpm`.

    Raises
    ------
    InvalidParameter
        The key has another length.
    """
    body = encode_body(message)
    return body + message_tag(key, body)


def encode_body(message: CerpmMessage) -> bytes:
    """Bytes 0 to 19 of a message: all except the tag.

    Notes
    -----
    Degrees and height are rounded to their steps in decimal arithmetic, ties to even. +180 and -180 degrees of
    longitude are not normalized: both are the antimeridian, and both fit.
    """
    limit = message.speed_limit
    is_mph = limit is not None and limit.unit is SpeedUnit.MPH
    height = NO_HEIGHT if message.height_m is None else _steps(message.height_m, HEIGHT_STEP_M, HEIGHT_M[0])
    return _BODY.pack(
        VERSION << 4 | message.side << 2 | is_mph << 1,
        int(message.number),
        _steps(message.lon_deg, DEGREE_STEP),
        _steps(message.lat_deg, DEGREE_STEP),
        height,
        0 if limit is None else int(limit.value),
        int(message.sequence),
    )


def _steps(value: float, step: float, zero: float = 0.0) -> int:
    """Whole steps from zero to a value, ties to even, in decimal arithmetic."""
    value_, step_, zero_ = (Decimal(repr(float(number))) for number in (value, step, zero))
    return int(((value_ - zero_) / step_).to_integral_value(ROUND_HALF_EVEN))


# === Explanation of the 24 bytes of a message, field by field.


@dataclass(frozen=True, slots=True)
class ExplainedBytes:
    """Some bytes of a message and their meaning."""

    offset: int  # of the first of them
    hex: str  # two digits a byte
    field: str
    value: str  # for people, with its unit


def explain_payload(payload: bytes, key: bytes | None = None) -> tuple[ExplainedBytes, ...]:
    """Meaning of each byte of a message.

    Parameters
    ----------
    payload : bytes
        24 of them.
    key : bytes, optional
        The marker's own; with it the tag is checked.

    Returns
    -------
    tuple of ExplainedBytes
        In order, without gaps. Invalid values are described as such and not refused.

    Raises
    ------
    InvalidParameter
        Another length.
    """
    if len(payload) != MESSAGE_BYTES:
        raise InvalidParameter(f"the payload has {len(payload)} bytes", field="payload", limit=f"{MESSAGE_BYTES} bytes")
    rows = (
        (0, 1, "head", _head(payload[0])),
        (1, 4, "number", _number(int.from_bytes(payload[1:5]))),
        (5, 4, "longitude", _degrees(payload[5:9], 180)),
        (9, 4, "latitude", _degrees(payload[9:13], 90)),
        (13, 2, "height", _height(int.from_bytes(payload[13:15]))),
        (15, 1, "speed limit", _speed(payload[15], payload[0])),
        (16, 4, "sequence", f"transmission {int.from_bytes(payload[16:20])}"),
        (20, 4, "tag", _tag(payload, key)),
    )
    return tuple(
        ExplainedBytes(offset, payload[offset : offset + length].hex(" "), field, value)
        for offset, length, field, value in rows
    )


def hex_dump(payload: bytes, key: bytes | None = None) -> str:
    """The explanation as lines of text: offset, bytes, field, value."""
    return "".join(
        f"{row.offset:02d}  {row.hex:<11}  {row.field:<11}  {row.value}\n" for row in explain_payload(payload, key)
    )


def _head(head: int) -> str:
    version = f"version {head >> 4}" + ("" if head >> 4 == VERSION else ", unknown")
    side = ("side unknown", "left boundary", "right boundary", "side 3, not in use")[head >> 2 & 3]
    unit = "mph" if head & 2 else "km/h"
    return f"{version}; {side}; speed in {unit}" + ("; reserved bit set" if head & 1 else "")


def _number(number: int) -> str:
    return f"marker {number}" + ("" if number else ", not in use")


def _degrees(steps: bytes, bound: int) -> str:
    degrees = int.from_bytes(steps, signed=True) * DEGREE_STEP
    return f"{degrees:.7f} degrees" + ("" if abs(degrees) <= bound + DEGREE_STEP / 2 else ", off the globe")


def _height(steps: int) -> str:
    if steps == NO_HEIGHT:
        return "not known"
    return f"{steps * HEIGHT_STEP_M + HEIGHT_M[0]:.1f} m above the ellipsoid"


def _speed(speed: int, head: int) -> str:
    return f"{speed} {'mph' if head & 2 else 'km/h'}" if speed else "none posted"


def _tag(payload: bytes, key: bytes | None) -> str:
    if key is None:
        return "first four bytes of AES-CMAC over bytes 0 to 19"
    genuine = message_tag(key, payload[:BODY_BYTES]) == payload[BODY_BYTES:]
    return "the marker's own" if genuine else "not of this key: forged, damaged, or another marker's key"


# === Programs of CERPMs, and a table for programming many.


SEQUENCE_AT = 16  # [bytes] first of the four bytes of the sequence; source: docs/cerpm-message.md
MAX_PROGRAMS = 100_000  # bounds the size of a table
COLUMNS = (
    "number", "lon_deg", "lat_deg", "height_m", "side", "speed_limit", "speed_unit", "body_hex", "sequence_start",
    "interval_s", "jitter_share", "frequency_hz", "channels", "hopping", "spreading_factor", "bandwidth_hz",
    "coding_rate", "preamble_symbols", "explicit_header", "crc", "power_dbm", "lorawan",
    "polite", "slotted", "place", "slot_guard_s",
)  # fmt: skip
KEY_COLUMN = "key_hex"


@dataclass(frozen=True, slots=True)
class MarkerProgram:
    """Program of one marker.

    Raises
    ------
    InvalidParameter
        The key has another length.
    """

    message: CerpmMessage  # the first one: its sequence is above all that the marker ever sent
    key: bytes = field(repr=False)  # the marker's own, 16 bytes; not shown by `repr`
    radio: RadioSettings

    def __post_init__(self) -> None:
        if len(self.key) != KEY_BYTES:
            raise InvalidParameter(f"a marker's key has {len(self.key)} bytes", field="key", limit=f"{KEY_BYTES} bytes")

    @property
    def body(self) -> bytes:
        """Bytes 0 to 19 of the first message; the marker counts bytes 16 to 19 up and adds the tag itself."""
        return encode_body(self.message)


def write_programs_csv(programs: Sequence[MarkerProgram], *, with_keys: bool = False) -> str:
    """Table for programming many markers: a header, then one row a marker.

    Parameters
    ----------
    programs : sequence of MarkerProgram
        Of one agency: numbers differ. At most 100,000.
    with_keys : bool
        Add the column ``key_hex``. Whoever has such a table can send for its markers: give it only to the
        programming station.

    Returns
    -------
    str
        CSV with CRLF. Positions as they are sent, to 1e-7 degrees and 0.1 m.

    Raises
    ------
    InvalidParameter
        Two programs have one number, or there are too many.
    """
    if len(programs) > MAX_PROGRAMS:
        raise InvalidParameter(
            f"{len(programs)} markers in one table", field="programs", limit=f"at most {MAX_PROGRAMS}", cure="split it"
        )
    seen: set[int] = set()
    for program in programs:
        if program.message.number in seen:
            raise InvalidParameter(
                f"two markers have the number {program.message.number}",
                field="programs",
                limit="one marker a number",
                cure="a number belongs to one marker for ever; give the other a new one",
            )
        seen.add(program.message.number)
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row([*COLUMNS, KEY_COLUMN] if with_keys else COLUMNS)
    for program in programs:
        row = _row(program)
        writer.write_row([*row, program.key.hex()] if with_keys else row)
    return stream.getvalue()


def _row(program: MarkerProgram) -> list[object]:
    message, radio, body = program.message, program.radio, program.body
    limit = message.speed_limit
    return [
        message.number,
        f"{int.from_bytes(body[5:9], signed=True) / 1e7:.7f}",
        f"{int.from_bytes(body[9:13], signed=True) / 1e7:.7f}",
        "" if message.height_m is None else f"{(int.from_bytes(body[13:15]) - 10_000) / 10:.1f}",
        LaneSide(message.side).name.lower(),
        "" if limit is None else int(limit.value),
        "" if limit is None else SpeedUnit(limit.unit).value,
        body.hex(),
        message.sequence,
        f"{radio.interval_s:g}",
        f"{radio.jitter_share:g}",
        radio.frequency_hz,
        radio.channels,
        str(radio.hopping).lower(),
        radio.spreading_factor,
        radio.bandwidth_hz,
        f"4/{radio.coding_rate}",
        radio.preamble_symbols,
        str(radio.explicit_header).lower(),
        str(radio.crc).lower(),
        f"{radio.power_dbm:g}",
        str(radio.lorawan).lower(),
        str(radio.polite).lower(),
        str(radio.slotted).lower(),
        radio.place if radio.slotted else "",
        f"{radio.slot_guard_s:g}" if radio.slotted else "",
    ]
