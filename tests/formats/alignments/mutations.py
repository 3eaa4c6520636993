"""Damaged copies of a road file: cut off, numbers replaced, attributes and elements removed, bytes changed."""

from __future__ import annotations

import random
import re
from collections.abc import Iterator

NUMBERS = ("nan", "inf", "-1", "0", "1e308", "-1e9", "1e9", "1e-300", "", "x", "1,5", "0x10", "99999999999999999999")
_NUMBER = re.compile(rb"(?<=[\"' >])-?[0-9][0-9.eE+-]*(?=[\"' <])")
_ATTRIBUTE = re.compile(rb"\s[A-Za-z_]+=(\"[^\"]*\"|'[^']*')")
_ELEMENT = re.compile(rb"<[A-Za-z]+[^<>]*/>")


def damaged(data: bytes, count: int, seed: int = 1) -> Iterator[bytes]:
    """Copies with one to three damages each."""
    rng = random.Random(seed)
    for _ in range(count):
        copy = data
        for _ in range(rng.randint(1, 3)):
            copy = rng.choice((_other_number, _other_number, _without_part, _cut, _other_byte))(copy, rng)
        yield copy


def _replaced(data: bytes, pattern: re.Pattern[bytes], rng: random.Random, new: bytes) -> bytes:
    found = list(pattern.finditer(data))
    if not found:
        return data
    match = rng.choice(found)
    return data[: match.start()] + new + data[match.end() :]


def _other_number(data: bytes, rng: random.Random) -> bytes:
    return _replaced(data, _NUMBER, rng, rng.choice(NUMBERS).encode())


def _without_part(data: bytes, rng: random.Random) -> bytes:
    return _replaced(data, rng.choice((_ATTRIBUTE, _ELEMENT)), rng, b"")


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))] if rng.random() < 0.2 and data else data


def _other_byte(data: bytes, rng: random.Random) -> bytes:
    if not data or rng.random() < 0.5:
        return data
    at = rng.randrange(len(data))
    return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
