"""The page on the message: its example and its vectors, both ways, and by a program that is not ours."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from app.decoders.cerpm.verify import decode_message, has_valid_tag
from app.encoders.cerpm import encode_message, hex_dump
from app.markers.cerpm import CerpmMessage, LaneSide, SpeedLimit, SpeedUnit, derive_marker_key
from app.radio.settings import DATA_RATES, F_PORT, Region

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "cerpm-message.md").read_text()
AGENCY_KEYS = dict(
    zip("AB", re.findall(r"`((?:[0-9a-f]{32}){1,2})`[,.] ?", PAGE.split("## Test vectors")[1]), strict=False)
)


@dataclass(frozen=True)
class Vector:
    agency_key: bytes
    message: CerpmMessage
    key: bytes
    payload: bytes


def read_vectors() -> list[Vector]:
    vectors = []
    for row in re.findall(r"^\| ([AB]) \| (.+) \|$", PAGE, re.M):
        number, lon, lat, height, side, speed, sequence, key, payload = (cell.strip(" `") for cell in row[1].split("|"))
        value, _, unit = speed.partition(" ")
        message = CerpmMessage(
            number=int(number),
            lon_deg=float(lon),
            lat_deg=float(lat),
            height_m=float(height) if height else None,
            side=LaneSide[side.upper()],
            speed_limit=SpeedLimit(int(value), SpeedUnit(unit)) if speed else None,
            sequence=int(sequence),
        )
        vectors.append(Vector(bytes.fromhex(AGENCY_KEYS[row[0]]), message, bytes.fromhex(key), bytes.fromhex(payload)))
    return vectors


VECTORS = read_vectors()


def test_the_page_has_vectors() -> None:
    assert len(VECTORS) == 4
    assert {len(vector.agency_key) for vector in VECTORS} == {16, 32}


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: str(vector.message.number))
def test_vectors_hold_both_ways(vector: Vector) -> None:
    assert derive_marker_key(vector.agency_key, vector.message.number) == vector.key
    assert encode_message(vector.message, vector.key) == vector.payload
    assert has_valid_tag(vector.payload, vector.key)
    decoded, _tag = decode_message(vector.payload)
    assert encode_message(decoded, vector.key) == vector.payload
    assert (decoded.number, decoded.side, decoded.speed_limit, decoded.sequence) == (
        vector.message.number,
        vector.message.side,
        vector.message.speed_limit,
        vector.message.sequence,
    )
    assert decoded.lon_deg == pytest.approx(vector.message.lon_deg, abs=0.5e-7 + 1e-12)
    assert decoded.lat_deg == pytest.approx(vector.message.lat_deg, abs=0.5e-7 + 1e-12)
    if vector.message.height_m is None:
        assert decoded.height_m is None
    else:
        assert decoded.height_m == pytest.approx(vector.message.height_m, abs=0.05 + 1e-9)


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: str(vector.message.number))
def test_openssl_makes_the_same_keys_and_tags(vector: Vector, require_tool: Callable[..., str]) -> None:
    openssl = require_tool("openssl")

    def mac(key: bytes, data: bytes) -> str:
        options = ["-macopt", f"cipher:AES-{8 * len(key)}-CBC", "-macopt", f"hexkey:{key.hex()}"]
        done = subprocess.run([openssl, "mac", *options, "CMAC"], input=data, capture_output=True, check=True)
        return done.stdout.decode().strip().lower()

    block = bytes.fromhex("00000001") + b"waymark cerpm v1\0" + vector.message.number.to_bytes(4) + b"\0\0\0\x80"
    assert mac(vector.agency_key, block) == vector.key.hex()
    assert mac(vector.key, vector.payload[:20])[:8] == vector.payload[20:].hex()
    assert mac(VECTORS[0].key, VECTORS[0].payload[:20]).upper() in PAGE


def test_the_example_is_the_first_vector_explained() -> None:
    example = PAGE.split("```")[1].lstrip("\n")
    assert example == hex_dump(VECTORS[0].payload, VECTORS[0].key)


def test_the_page_names_the_port_and_the_room_of_lorawan() -> None:
    assert f"FPort {F_PORT}" in PAGE
    rows = re.findall(r"^\| (US915|EU868) \| (.+?) \| (.+?) \| (\w+) \|$", PAGE, re.M)
    assert len(rows) == 4
    for region, rates, room, verdict in rows:
        numbers = [int(number) for number in re.findall(r"DR(\d)", rates)]
        if " to DR" in rates:
            numbers = list(range(numbers[0], numbers[1] + 1))
        rooms = [DATA_RATES[Region(region)][number].payload_bytes for number in numbers]
        stated = [int(number) for number in re.findall(r"\d+", room)]
        assert stated == ([min(rooms), max(rooms)] if "to" in room else rooms)
        assert verdict == ("fit" if min(rooms) >= 24 else "refused")
