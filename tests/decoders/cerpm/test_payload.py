"""Bytes of a CERPM, read."""

from __future__ import annotations

import pytest

from app.decoders.cerpm.verify import UndecodablePayload, decode_message, has_valid_tag
from app.errors import InvalidParameter
from app.markers.cerpm import CerpmMessage, LaneSide, SpeedLimit, SpeedUnit
from tests.decoders.cerpm.payloads import LAT_DEG, LON_DEG, body, key_of, signed


def test_every_field_is_where_the_table_says() -> None:
    message, tag = decode_message(body(0x01020304, sequence=0xFFFFFFFE) + b"abcd")
    assert message == CerpmMessage(
        0x01020304, LON_DEG, LAT_DEG, 250.3, LaneSide.LEFT, SpeedLimit(50, SpeedUnit.KM_H), 0xFFFFFFFE
    )
    assert tag == b"abcd"


def test_what_is_not_known_is_none() -> None:
    message, _tag = decode_message(body(head=0x1A, height=65535, speed=0) + bytes(4))
    assert (message.height_m, message.side, message.speed_limit) == (None, LaneSide.RIGHT, None)
    message, _tag = decode_message(body(head=0x12, speed=35) + bytes(4))
    assert message.speed_limit == SpeedLimit(35, SpeedUnit.MPH)


@pytest.mark.parametrize(
    ("payload", "kind", "field", "says"),
    [
        (b"", UndecodablePayload, "payload", "0 bytes"),
        (body() + bytes(3), UndecodablePayload, "payload", "23 bytes"),
        (body() + bytes(17), UndecodablePayload, "payload", "37 bytes"),
        (body(head=0x24) + bytes(4), UndecodablePayload, "payload", "version 2"),
        (body(head=0x04) + bytes(4), UndecodablePayload, "payload", "version 0"),
        (body(head=0x15) + bytes(4), InvalidParameter, "payload.head", "reserved"),
        (body(head=0x1C) + bytes(4), InvalidParameter, "payload.side", "3"),
        (body(0) + bytes(4), InvalidParameter, "payload.number", "0"),
        (body(lon_deg=180.0000001) + bytes(4), InvalidParameter, "payload.lon_deg", "180"),
        (body(lat_deg=-90.0000001) + bytes(4), InvalidParameter, "payload.lat_deg", "-90"),
        (body(lon_deg=-214.7483648) + bytes(4), InvalidParameter, "payload.lon_deg", "-214"),
    ],
)
def test_a_refusal_names_what_is_wrong(payload: bytes, kind: type[Exception], field: str, says: str) -> None:
    with pytest.raises(kind, match=says) as caught:
        decode_message(payload)
    error = caught.value
    assert isinstance(error, InvalidParameter)
    assert error.field == field
    assert error.limit
    assert error.cure


def test_ends_of_the_globe_are_on_it() -> None:
    message, _tag = decode_message(body(lon_deg=-180.0, lat_deg=90.0, height=0) + bytes(4))
    assert (message.lon_deg, message.lat_deg, message.height_m) == (-180.0, 90.0, -1000.0)


def test_a_tag_holds_for_its_key_and_every_bit() -> None:
    payload = signed(body())
    assert has_valid_tag(payload, key_of(7))
    assert not has_valid_tag(payload, key_of(8))
    for bit in range(192):
        turned = bytearray(payload)
        turned[bit // 8] ^= 1 << bit % 8
        assert not has_valid_tag(bytes(turned), key_of(7))


def test_the_tag_is_that_of_the_standard() -> None:
    # NIST SP 800-38B, appendix D.1: AES-128, a message of 160 bits; the code stands for the first four bytes
    key = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")
    content = bytes.fromhex("6bc1bee22e409f96e93d7e117393172aae2d8a57")
    assert has_valid_tag(content + bytes.fromhex("7d85449e"), key)
    assert not has_valid_tag(content + bytes.fromhex("7d85449f"), key)


def test_keys_and_payloads_of_another_length_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="15 bytes"):
        has_valid_tag(signed(body()), bytes(15))
    with pytest.raises(InvalidParameter, match="20 bytes"):
        has_valid_tag(body(), bytes(16))
