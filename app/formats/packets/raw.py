"""Payloads without other values: bytes one after the other, or lines of hexadecimal digits."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import islice

from app.formats.log_report import LogReport
from app.formats.log_times import LogClock
from app.formats.packets.rows import MAX_PAYLOAD, BrokenEntry, PayloadText, read_payload
from app.formats.text import MAX_LINE, numbered_lines
from app.markers.cerpm import MESSAGE_BYTES, VERSION
from app.sensors.receiver import ReceivedPacket

_LONG_HEX = re.compile(r"(?:0[xX])?([0-9a-fA-F]{20,})\Z")
_BYTE = re.compile(r"[0-9a-fA-F]{2}\Z")
_DATE = re.compile(r"\d{4}-\d\d-\d\d\Z")
_CLOCK_TIME = re.compile(r"\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:?\d\d)?\Z", re.ASCII)
_SEPARATORS = re.compile(r"[,;\s|]+")
_MIN_BYTES = 8  # separate bytes in a row that are a payload, no date or address; chosen by hand


def is_raw_payload(data: bytes) -> bool:
    """Whether bytes that are no text can be payloads: whole ones, or one of this version in any length."""
    if len(data) % MESSAGE_BYTES == 0:
        return True
    count = max(len(data) // MESSAGE_BYTES, 1)
    matching = _count_version(data[: count * MESSAGE_BYTES])
    return 2 * matching > count and (len(data) <= MAX_PAYLOAD or matching > 1)


def version_share(data: bytes) -> float:
    """Share of payloads whose first byte is that of this version, 0 to 1."""
    count = -(-len(data) // MESSAGE_BYTES)
    return _count_version(data) / count if count else 0.0


def _count_version(data: bytes) -> int:
    """Number of payloads whose first byte is that of this version."""
    return sum(1 for first in data[::MESSAGE_BYTES] if first >> 4 == VERSION)


def read_raw_payloads(data: bytes, report: LogReport) -> Iterable[ReceivedPacket]:
    """Packets of 24 bytes each; a single one may have another length, to be refused by name later."""
    if len(data) < 2 * MESSAGE_BYTES:
        report.entries = 1
        yield ReceivedPacket(0, float("nan"), data)
        return
    whole = len(data) // MESSAGE_BYTES
    report.entries = whole
    for i in range(whole):
        yield ReceivedPacket(i, float("nan"), data[i * MESSAGE_BYTES : (i + 1) * MESSAGE_BYTES])
    left = len(data) % MESSAGE_BYTES
    if left:
        report.entries += 1
        report.leave_out(whole, "cut-short", f"the last {left} bytes are no whole payload of {MESSAGE_BYTES}")


def looks_like_hex_lines(text: str) -> bool:
    """Whether the first lines hold long hexadecimal numbers."""
    lines = [line for _number, line in islice(numbered_lines(text[: 1 << 16]), 20) if not line.startswith("#")]
    held = [line for line in lines if _hex_of(_tokens(line))]
    return bool(held) and 2 * len(held) >= len(lines)


def read_hex_lines(text: str, clock: LogClock, report: LogReport) -> Iterable[ReceivedPacket]:
    """A packet a line: its bytes in hexadecimal, and beside them a time and an RSSI if there are any."""
    for _number, line in numbered_lines(text):
        if line.startswith("#"):
            continue
        entry = report.entries
        report.entries += 1
        try:
            if len(line) > MAX_LINE:
                raise BrokenEntry("long-line", f"the line has more than {MAX_LINE} characters")
            yield _read_line(entry, line, clock)
        except BrokenEntry as broken:
            report.leave_out(entry, broken.kind, broken.reason)


def _read_line(entry: int, line: str, clock: LogClock) -> ReceivedPacket:
    tokens = _tokens(line)
    found = _hex_of(tokens)
    payload = read_payload(found[0], PayloadText.HEX) if found else None
    if found is None or payload is None:
        raise BrokenEntry("payload", "there are no bytes in hexadecimal in this line")
    received_at_s, rssi_dbm = float("nan"), float("nan")
    others = tokens[: found[1]] + tokens[found[2] :]
    for i, token in enumerate(others):
        if _DATE.match(token) and i + 1 < len(others) and _CLOCK_TIME.match(others[i + 1]):
            received_at_s = clock.read(f"{token}T{others[i + 1]}")
        elif re.fullmatch(r"-\d{1,3}(\.\d+)?(dBm)?", token, re.ASCII):
            rssi_dbm = float(token.removesuffix("dBm"))
        elif received_at_s != received_at_s and not _CLOCK_TIME.match(token):
            received_at_s = clock.read(token)
    return ReceivedPacket(entry, received_at_s, payload, rssi_dbm=rssi_dbm)


def _tokens(line: str) -> list[str]:
    return [token.strip("'\"[]") for token in _SEPARATORS.split(line[:4096]) if token]


def _hex_of(tokens: list[str]) -> tuple[str, int, int] | None:
    """The bytes among the words of a line, and where they begin and end."""
    for i, token in enumerate(tokens):
        if found := _LONG_HEX.match(token):
            return found[1], i, i + 1
    start = 0
    for i in range(len(tokens) + 1):
        if i < len(tokens) and _BYTE.match(tokens[i]):
            continue
        if i - start >= _MIN_BYTES:
            return "".join(tokens[start:i]), start, i
        start = i + 1
    return None
