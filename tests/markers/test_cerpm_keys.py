"""Keys and tags against the vectors of the standards."""

from __future__ import annotations

import math

import pytest
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import ECB

from app.errors import InvalidParameter
from app.markers.cerpm import (
    MAX_INVALID_TAGS_PER_DAY,
    MAX_INVALID_TAGS_PER_LOG,
    MESSAGE_BYTES,
    aes_cmac,
    derive_marker_key,
    forgery_probability,
    message_tag,
)
from app.radio.settings import time_on_air_s

RFC4493_KEY = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")
RFC4493_MESSAGE = bytes.fromhex(
    "6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e51"
    "30c81c46a35ce411e5fbc1191a0a52eff69f2445df4f9b17ad2b417be66c3710"
)
RFC4493_TAGS = {
    0: "bb1d6929e95937287fa37d129b756746",
    16: "070a16b46b4d4144f79bdd9dd04a287c",
    40: "dfa66747de9ae63030ca32611497c827",
    64: "51f0bebf7e3b9d92fc49741779363cfe",
}
"""RFC 4493, section 4, examples 1 to 4, by length."""


def long_hand_cmac(key: bytes, data: bytes) -> bytes:
    """AES-CMAC from the block cipher alone, by the steps of RFC 4493, sections 2.3 and 2.4."""
    encryptor = Cipher(AES(key), ECB()).encryptor()
    mask = (1 << 128) - 1

    def double(value: int) -> int:
        return (value << 1 & mask) ^ (0x87 if value >> 127 else 0)

    subkey = double(int.from_bytes(encryptor.update(bytes(16))))
    if not data or len(data) % 16:
        subkey = double(subkey)
        data += b"\x80" + bytes(-(len(data) + 1) % 16)
    state = 0
    for start in range(0, len(data), 16):
        block = int.from_bytes(data[start : start + 16])
        last = start + 16 == len(data)
        state = int.from_bytes(encryptor.update((state ^ block ^ (subkey if last else 0)).to_bytes(16)))
    return state.to_bytes(16)


@pytest.mark.parametrize(("length", "tag"), RFC4493_TAGS.items())
def test_cmac_gives_the_vectors_of_rfc_4493(length: int, tag: str) -> None:
    assert aes_cmac(RFC4493_KEY, RFC4493_MESSAGE[:length]).hex() == tag
    assert long_hand_cmac(RFC4493_KEY, RFC4493_MESSAGE[:length]).hex() == tag


def test_a_message_tag_is_the_head_of_the_cmac() -> None:
    body = RFC4493_MESSAGE[:20]
    assert message_tag(RFC4493_KEY, body) == long_hand_cmac(RFC4493_KEY, body)[:4]


@pytest.mark.parametrize("agency_key", [RFC4493_KEY, bytes(range(32))])
@pytest.mark.parametrize("number", [1, 255, 256, 2**32 - 1])
def test_a_marker_key_is_the_sp_800_108_block_as_it_is_documented(agency_key: bytes, number: int) -> None:
    block = b"\0\0\0\1" + b"waymark cerpm v1" + b"\0" + number.to_bytes(4) + b"\0\0\0\x80"
    assert derive_marker_key(agency_key, number) == long_hand_cmac(agency_key, block)


def test_keys_of_markers_and_agencies_differ() -> None:
    keys = {derive_marker_key(agency, n) for agency in (bytes(16), bytes(32), b"\1" * 16) for n in range(1, 200)}
    assert len(keys) == 3 * 199
    assert {len(key) for key in keys} == {16}


@pytest.mark.parametrize("length", [0, 15, 17, 24, 31, 33])
def test_agency_keys_of_other_lengths_are_refused(length: int) -> None:
    with pytest.raises(InvalidParameter) as caught:
        derive_marker_key(bytes(length), 1)
    assert caught.value.field == "agency_key"


@pytest.mark.parametrize("number", [-1, 0, 2**32])
def test_numbers_that_do_not_fit_have_no_key(number: int) -> None:
    with pytest.raises(InvalidParameter) as caught:
        derive_marker_key(bytes(16), number)
    assert caught.value.field == "number"


@pytest.mark.parametrize(
    ("key", "body", "field"), [(15, 20, "key"), (16, 24, "body"), (16, 0, "body"), (20, 16, "key")]
)
def test_tags_are_made_with_a_key_over_a_body_only(key: int, body: int, field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        message_tag(bytes(key), bytes(body))
    assert caught.value.field == field


# --- guesses ------------------------------------------------------------------------------------------------------


def test_the_forgery_budget_of_the_docs() -> None:
    """docs/cerpm-message.md and decision 0015 state these figures; 1 - exp(-n / 2^32) by hand."""
    year = 365
    assert forgery_probability(2**32) == pytest.approx(1 - math.exp(-1), rel=1e-9)
    assert forgery_probability(year * MAX_INVALID_TAGS_PER_DAY) == pytest.approx(8.495e-4, rel=1e-3)
    assert forgery_probability(year * 4 * MAX_INVALID_TAGS_PER_LOG) == pytest.approx(3.399e-4, rel=1e-3)
    assert forgery_probability(year * 4 * MAX_INVALID_TAGS_PER_LOG, 8) == pytest.approx(7.915e-14, rel=1e-3)
    assert forgery_probability(0) == 0.0


def test_a_longer_tag_does_not_fit_the_time_on_air() -> None:
    """47 CFR 15.247(a)(1)(i): 400 ms on one channel. The symbols of SF10 take 24 bytes, and no 25th."""
    at_sf10_s = [time_on_air_s(size, 10, 125_000) for size in (24, 25, 28)]
    assert at_sf10_s == pytest.approx([0.370688, 0.411648, 0.411648])
    assert MESSAGE_BYTES == 24
    assert int(60 / time_on_air_s(MESSAGE_BYTES, 7, 125_000)) == 972 <= MAX_INVALID_TAGS_PER_LOG
