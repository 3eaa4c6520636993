"""Damaged copies of files, as a strategy of hypothesis: it shrinks what fails to the smallest damage."""

from __future__ import annotations

import re
from collections.abc import Sequence

from hypothesis import strategies as st

HOSTILE = (
    b"nan", b"inf", b"-1", b"0", b"1e308", b"-1e9", b"1e-300", b"", b"x", b"1,5", b"0x10", b"9" * 20, b"\x00",
    b"\xff\xfe", b"\xef\xbb\xbf", b"\xed\xa0\x80", b'"', b"'", b"[" * 200, b'{"a":' * 200, b"<a>" * 200, b"&x;",
    b"%s%n", b"=1+1", b"null", b"true", b"[]", b"{}", b"1970-01-01T00:00:00Z", b"9999-12-31T24:00:00+99:99",
    b"EPSG:4326", b"EPSG:99999",
)  # fmt: skip
"""What replaces a number, a word or a byte."""
_WORD = re.compile(rb"[A-Za-z0-9_.+:-]+")
_MAX_EDITS = 6


@st.composite
def damaged(draw: st.DrawFn, seeds: Sequence[bytes]) -> bytes:
    """One of some files with up to six damages."""
    data = draw(st.sampled_from(seeds))
    for _ in range(draw(st.integers(0, _MAX_EDITS))):
        data = draw(st.sampled_from((_replace_word, _cut, _repeat, _other_bytes, _splice)))(draw, data, seeds)
    return data


def _place(draw: st.DrawFn, data: bytes) -> int:
    return draw(st.integers(0, max(len(data) - 1, 0)))


def _replace_word(draw: st.DrawFn, data: bytes, _seeds: Sequence[bytes]) -> bytes:
    found = _WORD.search(data, _place(draw, data))
    if found is None:
        return data
    return data[: found.start()] + draw(st.sampled_from(HOSTILE)) + data[found.end() :]


def _cut(draw: st.DrawFn, data: bytes, _seeds: Sequence[bytes]) -> bytes:
    start = _place(draw, data)
    return data[:start] + data[start + draw(st.integers(1, 200)) :]


def _repeat(draw: st.DrawFn, data: bytes, _seeds: Sequence[bytes]) -> bytes:
    start = _place(draw, data)
    piece = data[start : start + draw(st.integers(1, 200))]
    return data[:start] + piece * draw(st.integers(2, 20)) + data[start:]


def _other_bytes(draw: st.DrawFn, data: bytes, _seeds: Sequence[bytes]) -> bytes:
    start = _place(draw, data)
    new = draw(st.binary(min_size=1, max_size=8))
    return data[:start] + new + data[start + len(new) :]


def _splice(draw: st.DrawFn, data: bytes, seeds: Sequence[bytes]) -> bytes:
    other = draw(st.sampled_from(seeds))
    return data[: _place(draw, data)] + other[_place(draw, other) :]
