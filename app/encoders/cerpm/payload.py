"""CERPM message to the 24 bytes that its marker sends."""

from __future__ import annotations

import struct
from decimal import ROUND_HALF_EVEN, Decimal

from app.markers.cerpm import (
    DEGREE_STEP,
    HEIGHT_M,
    HEIGHT_STEP_M,
    NO_HEIGHT,
    VERSION,
    CerpmMessage,
    SpeedUnit,
)
from app.markers.cerpm_keys import message_tag

_BODY = struct.Struct(">BIiiHBI")


def encode_message(message: CerpmMessage, key: bytes) -> bytes:
    """Payload of a message.

    Parameters
    ----------
    message : CerpmMessage
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
