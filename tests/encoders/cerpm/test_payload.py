"""The 24 bytes, field by field."""

from __future__ import annotations

import numpy as np
import pytest

from app.encoders.cerpm import encode_body, encode_message
from app.errors import InvalidParameter
from app.markers.cerpm import CerpmMessage, LaneSide, SpeedLimit, SpeedUnit, message_tag

KEY = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")


def test_every_field_is_where_the_layout_says() -> None:
    message = CerpmMessage(
        number=0x01020304,
        lon_deg=-85.6175434,
        lat_deg=42.2846297,
        height_m=231.7,
        side=LaneSide.RIGHT,
        speed_limit=SpeedLimit(25, SpeedUnit.MPH),
        sequence=0x0A0B0C0D,
    )
    payload = encode_message(message, KEY)
    assert len(payload) == 24
    assert payload[0] == 0b0001_10_1_0
    assert payload[1:5] == bytes([1, 2, 3, 4])
    assert int.from_bytes(payload[5:9], signed=True) == -856175434
    assert int.from_bytes(payload[9:13], signed=True) == 422846297
    assert int.from_bytes(payload[13:15]) == 12317
    assert payload[15] == 25
    assert payload[16:20] == bytes([10, 11, 12, 13])
    assert payload[20:] == message_tag(KEY, payload[:20])


def test_what_is_not_known_is_said() -> None:
    body = encode_body(CerpmMessage(number=1, lon_deg=0.0, lat_deg=0.0))
    assert body == bytes([0x10, 0, 0, 0, 1, *[0] * 8, 0xFF, 0xFF, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("lon_deg", "steps"),
    [
        (1.00000005, 10000000),
        (1.00000015, 10000002),
        (-1.00000005, -10000000),
        (-1.00000015, -10000002),
        (0.00000025, 2),
        (0.000000250001, 3),
        (180.0, 1800000000),
        (-180.0, -1800000000),
        (179.99999996, 1800000000),
        (-0.00000004, 0),
    ],
)
def test_longitudes_are_rounded_half_to_even(lon_deg: float, steps: int) -> None:
    body = encode_body(CerpmMessage(number=1, lon_deg=lon_deg, lat_deg=0.0))
    assert int.from_bytes(body[5:9], signed=True) == steps


@pytest.mark.parametrize("lat_deg", [90.0, -90.0])
def test_poles_fit(lat_deg: float) -> None:
    body = encode_body(CerpmMessage(number=1, lon_deg=0.0, lat_deg=lat_deg))
    assert int.from_bytes(body[9:13], signed=True) == lat_deg * 10**7


@pytest.mark.parametrize(("height_m", "steps"), [(-1000.0, 0), (5553.4, 65534), (0.05, 10000), (0.15, 10002)])
def test_heights_are_decimetres_above_minus_1000_m(height_m: float, steps: int) -> None:
    body = encode_body(CerpmMessage(number=1, lon_deg=0.0, lat_deg=0.0, height_m=height_m))
    assert int.from_bytes(body[13:15]) == steps


def test_numbers_of_numpy_are_encoded_alike() -> None:
    plain = CerpmMessage(number=7, lon_deg=8.5, lat_deg=47.25, height_m=400.0, sequence=3)
    other = CerpmMessage(
        number=np.uint32(7), lon_deg=np.float64(8.5), lat_deg=np.float64(47.25), height_m=np.float64(400), sequence=3
    )
    assert encode_body(other) == encode_body(plain)


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"number": 0}, "number"),
        ({"number": 2**32}, "number"),
        ({"number": 1.5}, "number"),
        ({"sequence": -1}, "sequence"),
        ({"sequence": 2**32}, "sequence"),
        ({"sequence": 0.5}, "sequence"),
        ({"lon_deg": 180.1}, "position.lon_deg"),
        ({"lat_deg": float("nan")}, "position.lat_deg"),
        ({"height_m": 5553.5}, "position.height_m"),
        ({"height_m": float("inf")}, "position.height_m"),
    ],
)
def test_what_does_not_fit_is_refused(values: dict[str, float], field: str) -> None:
    settings: dict[str, object] = {"number": 1, "lon_deg": 0.0, "lat_deg": 0.0} | values
    with pytest.raises(InvalidParameter) as caught:
        CerpmMessage(**settings)  # type: ignore[arg-type]
    assert caught.value.field == field


def test_a_key_of_another_length_signs_nothing() -> None:
    with pytest.raises(InvalidParameter) as caught:
        encode_message(CerpmMessage(number=1, lon_deg=0.0, lat_deg=0.0), KEY[:8])
    assert caught.value.field == "key"
