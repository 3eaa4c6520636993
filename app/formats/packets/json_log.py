"""Packet logs as JSON: objects with named values, or uplink events of LoRaWAN network servers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any

from app.formats.columns import match_columns
from app.formats.packets.csv_log import payload_text
from app.formats.packets.declaration import PacketSource
from app.formats.packets.json_entries import read_records
from app.formats.packets.rows import ALIASES, NEEDED, BrokenEntry, packet_from_values
from app.formats.packets.uplinks import find_kind, open_envelope, packet_from_uplink
from app.formats.text import numbered_lines
from app.sensors.receiver import ReceivedPacket

_MAX_SHAPES = 100  # sets of names whose columns are remembered; chosen by hand
_Shapes = dict[tuple[str, ...], dict[str, int]]


def read_json(source: PacketSource) -> Iterator[ReceivedPacket]:
    """Packets of the entries; an entry that cannot be read is left out.

    Raises
    ------
    UploadTooLarge
        One document has more characters than the limit.
    """
    sample, report = source.sample, source.report
    shapes: _Shapes = {}
    for entry, record in read_records(sample.name, sample.text, source.limits.document_bytes):
        report.entries += 1
        try:
            if isinstance(record, BrokenEntry):
                raise record
            yield _packet_from_record(entry, record, source, shapes)
        except BrokenEntry as broken:
            report.leave_out(entry, broken.kind, broken.reason)


def _packet_from_record(entry: int, record: Mapping[str, Any], source: PacketSource, shapes: _Shapes) -> ReceivedPacket:
    declaration = source.declaration
    event, outer_time = open_envelope(record)
    kind = find_kind(event)
    if kind is not None:
        source.report.format = str(kind)
        return packet_from_uplink(entry, kind, event, declaration.clock)
    names = tuple(event)[:256]
    places = match_columns(names, ALIASES, declaration.columns) if names not in shapes else shapes[names]
    if len(shapes) < _MAX_SHAPES:
        shapes[names] = places
    if "payload" not in places and not all(quantity in places for quantity in NEEDED):
        raise BrokenEntry(
            "unknown", "neither an uplink nor an object with a payload, or with id, latitude and longitude"
        )
    values = {quantity: event[names[place]] for quantity, place in places.items()}
    values.setdefault("time", outer_time)
    written = payload_text(names[places["payload"]] if "payload" in places else "", declaration)
    return packet_from_values(entry, values, declaration.clock, written)


def looks_like_json_dump(text: str) -> bool:
    """Whether lines hold a word or two and then a JSON object: what mosquitto_sub -v and event streams write."""
    lines = [line for _number, line in islice(numbered_lines(text[: 1 << 16]), 20)]
    found = sum(1 for line in lines if re.match(r"[^{},;\"]{1,512}[\s:]\{\s*\"", line[:1024]))
    return 2 * found > len(lines) or (found > 0 and lines[0].startswith(("data:", "event:", "id:", ":")))
