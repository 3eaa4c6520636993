"""Explanation of the 24 bytes of a message, field by field."""

from __future__ import annotations

from dataclasses import dataclass

from app.errors import InvalidParameter
from app.markers.cerpm import BODY_BYTES, DEGREE_STEP, HEIGHT_M, HEIGHT_STEP_M, MESSAGE_BYTES, NO_HEIGHT, VERSION
from app.markers.cerpm_keys import message_tag


@dataclass(frozen=True, slots=True)
class ExplainedBytes:
    """Some bytes of a message and their meaning.

    Attributes
    ----------
    offset : int
        Of the first of them.
    hex : str
        Two digits a byte.
    field : str
    value : str
        For people, with its unit.
    """

    offset: int
    hex: str
    field: str
    value: str


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
