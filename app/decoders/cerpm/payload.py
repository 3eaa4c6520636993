"""The 24 bytes of a CERPM to its message, and the check of its tag."""

from __future__ import annotations

import hmac
import struct

from app.errors import InvalidParameter
from app.markers.cerpm import (
    BODY_BYTES,
    KEY_BYTES,
    MAX_NUMBER,
    MESSAGE_BYTES,
    NO_HEIGHT,
    VERSION,
    CerpmMessage,
    LaneSide,
    SpeedLimit,
    SpeedUnit,
)
from app.markers.cerpm_keys import message_tag

_BODY = struct.Struct(">BIiiHBI")  # source: the table of `app.markers.cerpm`
_LON_STEPS, _LAT_STEPS = 1_800_000_000, 900_000_000  # source: 180 and 90 degrees in 1e-7 (docs/cerpm-message.md)
_FIELD = "payload"
_CURE_DAMAGED = "ignore this packet; if all packets of a marker are like this, program it again"


class UndecodablePayload(InvalidParameter):
    """Bytes that are not a message of this version at all: another length, or another version."""


def decode_message(payload: bytes) -> tuple[CerpmMessage, bytes]:
    """Message and tag of a payload. The tag is not checked yet.

    Parameters
    ----------
    payload : bytes
        24 of them, in the layout of `app.markers.cerpm`.

    Returns
    -------
    CerpmMessage
    bytes
        The tag, 4 bytes.

    Raises
    ------
    UndecodablePayload
        Another length or an unknown version.
    InvalidParameter
        An invalid value: the reserved bit, a side, the number 0, or a position off the globe.
    """
    _check_form(payload)
    head, number, lon_steps, lat_steps, height_steps, speed, sequence = _BODY.unpack_from(payload)
    side = head >> 2 & 3
    if head & 1:
        raise _damaged("the reserved bit of byte 0 is set", "payload.head", "bit 0 is zero")
    if side > LaneSide.RIGHT:
        raise _damaged("the side of the lane is 3", "payload.side", "0 unknown, 1 left, 2 right")
    if not 1 <= number <= MAX_NUMBER:
        raise _damaged("the number of the marker is 0", "payload.number", f"1 to {MAX_NUMBER}")
    if abs(lon_steps) > _LON_STEPS:
        raise _damaged(f"the longitude is {lon_steps / 1e7} degrees", "payload.lon_deg", "-180 to 180 deg")
    if abs(lat_steps) > _LAT_STEPS:
        raise _damaged(f"the latitude is {lat_steps / 1e7} degrees", "payload.lat_deg", "-90 to 90 deg")
    message = CerpmMessage(
        number=number,
        lon_deg=lon_steps / 1e7,
        lat_deg=lat_steps / 1e7,
        height_m=None if height_steps == NO_HEIGHT else (height_steps - 10_000) / 10,
        side=LaneSide(side),
        speed_limit=SpeedLimit(speed, SpeedUnit.MPH if head & 2 else SpeedUnit.KM_H) if speed else None,
        sequence=sequence,
    )
    return message, payload[BODY_BYTES:]


def has_valid_tag(payload: bytes, key: bytes) -> bool:
    """Whether a payload carries the tag of this key.

    Parameters
    ----------
    payload : bytes
        24 of them.
    key : bytes
        The marker's own, 16 bytes.

    Raises
    ------
    InvalidParameter
        The payload or the key has another length.

    Notes
    -----
    Four bytes of AES-CMAC (RFC 4493): a guess is right once in 2^32.
    """
    if len(key) != KEY_BYTES:
        raise InvalidParameter(f"a marker's key has {len(key)} bytes", field="key", limit=f"{KEY_BYTES} bytes")
    if len(payload) != MESSAGE_BYTES:
        raise _wrong_length(payload)
    return hmac.compare_digest(message_tag(key, payload[:BODY_BYTES]), payload[BODY_BYTES:])


def _check_form(payload: bytes) -> None:
    if len(payload) != MESSAGE_BYTES:
        raise _wrong_length(payload)
    if payload[0] >> 4 != VERSION:
        raise UndecodablePayload(
            f"the payload is of version {payload[0] >> 4} (first byte 0x{payload[0]:02x})",
            field=_FIELD,
            limit=f"version {VERSION}: a first byte from 0x{VERSION << 4:02x} to 0x{(VERSION << 4) | 15:02x}",
            cure="send packets of CERPMs only; a newer version of the message needs a newer decoder",
        )


def _wrong_length(payload: bytes) -> UndecodablePayload:
    return UndecodablePayload(
        f"the payload has {len(payload)} bytes",
        field=_FIELD,
        limit=f"{MESSAGE_BYTES} bytes",
        cure="send the application payload alone, without LoRaWAN's frame, and not cut",
    )


def _damaged(message: str, field: str, limit: str) -> InvalidParameter:
    return InvalidParameter(message, field=field, limit=limit, cure=_CURE_DAMAGED)
