"""Payloads as they are: bytes one after the other, or lines of hexadecimal digits."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import islice

from app.decoders.cerpm.log_report import LogReport
from app.decoders.cerpm.log_text import MAX_LINE, numbered_lines
from app.decoders.cerpm.log_times import LogClock
from app.decoders.cerpm.packet_log_rows import MAX_PAYLOAD, BrokenEntry, PayloadText, read_payload
from app.decoders.cerpm.packets import HeardPacket
from app.markers.cerpm import MESSAGE_BYTES, VERSION

_LONG_HEX = re.compile(r"(?:0[xX])?([0-9a-fA-F]{20,})\Z")
_BYTE = re.compile(r"[0-9a-fA-F]{2}\Z")
_DATE = re.compile(r"\d{4}-\d\d-\d\d\Z")
_CLOCK_TIME = re.compile(r"\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:?\d\d)?\Z", re.ASCII)
_SEPARATORS = re.compile(r"[,;\s|]+")
_LEAST_BYTES = 8


def is_raw_payload(data: bytes) -> bool:
    """Whether bytes that are no text can be payloads: whole ones, or one of this version in any length."""
    if len(data) % MESSAGE_BYTES == 0:
        return True
    heads = data[::MESSAGE_BYTES][: max(len(data) // MESSAGE_BYTES, 1)]
    ours = sum(1 for head in heads if head >> 4 == VERSION)
    return 2 * ours > len(heads) and (len(data) <= MAX_PAYLOAD or ours > 1)


def read_raw_payloads(data: bytes, report: LogReport) -> Iterable[HeardPacket]:
    """Packets of 24 bytes each; a single one may have another length, to be refused by name later."""
    if len(data) < 2 * MESSAGE_BYTES:
        report.entries = 1
        yield HeardPacket(0, float("nan"), data)
        return
    whole = len(data) // MESSAGE_BYTES
    report.entries = whole
    for i in range(whole):
        yield HeardPacket(i, float("nan"), data[i * MESSAGE_BYTES : (i + 1) * MESSAGE_BYTES])
    left = len(data) % MESSAGE_BYTES
    if left:
        report.entries += 1
        report.leave_out(whole, "cut-short", f"the last {left} bytes are no whole payload of {MESSAGE_BYTES}")


def looks_like_hex_lines(text: str) -> bool:
    """Whether the first lines hold long hexadecimal numbers."""
    lines = [line for _number, line in islice(numbered_lines(text[: 1 << 16]), 20) if not line.startswith("#")]
    held = [line for line in lines if _hex_of(_tokens(line))]
    return bool(held) and 2 * len(held) >= len(lines)


def read_hex_lines(text: str, clock: LogClock, report: LogReport) -> Iterable[HeardPacket]:
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


def _read_line(entry: int, line: str, clock: LogClock) -> HeardPacket:
    tokens = _tokens(line)
    found = _hex_of(tokens)
    payload = read_payload(found[0], PayloadText.HEX) if found else None
    if found is None or payload is None:
        raise BrokenEntry("payload", "there are no bytes in hexadecimal in this line")
    heard_at_s, rssi_dbm = float("nan"), float("nan")
    others = tokens[: found[1]] + tokens[found[2] :]
    for i, token in enumerate(others):
        if _DATE.match(token) and i + 1 < len(others) and _CLOCK_TIME.match(others[i + 1]):
            heard_at_s = clock.read(f"{token}T{others[i + 1]}")
        elif re.fullmatch(r"-\d{1,3}(\.\d+)?(dBm)?", token, re.ASCII):
            rssi_dbm = float(token.removesuffix("dBm"))
        elif heard_at_s != heard_at_s and not _CLOCK_TIME.match(token):
            heard_at_s = clock.read(token)
    return HeardPacket(entry, heard_at_s, payload, rssi_dbm=rssi_dbm)


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
        if i - start >= _LEAST_BYTES:
            return "".join(tokens[start:i]), start, i
        start = i + 1
    return None
