"""Packet logs as delimited text with a header."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from app.errors import InvalidParameter
from app.formats.columns import repeated_names
from app.formats.log_times import has_zone
from app.formats.packets.declaration import PacketDeclaration, PacketSource
from app.formats.packets.rows import ALIASES, BrokenEntry, PayloadText, packet_from_values
from app.formats.text import clean_text
from app.sensors.receiver import ReceivedPacket


def read_csv(source: PacketSource) -> Iterator[ReceivedPacket]:
    """Packets of the rows; a row that cannot be read is left out.

    Raises
    ------
    InvalidParameter
        A declared column is missing.
    """
    declaration, report, log = source.declaration, source.report, source.sample.log
    missing = {q: n for q, n in declaration.columns.items() if n not in log.columns}
    if missing:
        raise missing_columns(source, missing)
    for repeated in repeated_names(log.columns):
        report.warn(f"{source.sample.name} has several columns named {repeated!r}; the first is read")
    places = log.places(ALIASES, declaration.columns)
    written = payload_text(log.columns[places["payload"]] if "payload" in places else "", declaration)
    zoned = True
    for entry, cells in enumerate(log.rows()):
        report.entries += 1
        try:
            if cells is None:
                raise BrokenEntry("malformed", log.bad_row())
            values = {quantity: cells[place] for quantity, place in places.items()}
            zoned = zoned and _names_zone(values.get("time", ""))
            yield packet_from_values(entry, values, declaration.clock, written, decimal=log.dialect.decimal)
        except BrokenEntry as broken:
            report.leave_out(entry, broken.kind, broken.reason)
    if not zoned and not declaration.clock.utc_offset_s:
        report.warn("times without a zone were taken as UTC; declare the zone's offset if they are local")


def _names_zone(text: str) -> bool:
    return ":" not in text or has_zone(text)


def payload_text(column: str, declaration: PacketDeclaration) -> PayloadText:
    """How payloads are written: as declared, or else by the name of their column."""
    if declaration.payload_text is not PayloadText.AUTO:
        return declaration.payload_text
    lower = column.lower()
    if "hex" in lower:
        return PayloadText.HEX
    return PayloadText.BASE64 if re.search(r"b(ase)?_?64", lower) else PayloadText.AUTO


def missing_columns(source: PacketSource, wanted: Mapping[str, str]) -> InvalidParameter:
    """The error for declared columns that a log does not have."""
    quantity, column = next(iter(wanted.items()))
    shown = ", ".join(repr(clean_text(c, 40)) for c in source.sample.log.columns[:24])
    return InvalidParameter(
        f"{source.sample.name} has no column {column!r} for {quantity}; its columns are {shown}",
        field=f"columns.{quantity}",
        limit=f"one of {shown}",
        cure="declare the names as the first line has them",
    )
