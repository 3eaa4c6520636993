"""Queries on CERPMs: their numbers, their agency's secret, and which transmissions were heard."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.registry.marker_rows import MARKERS, MarkerRow
from app.registry.rows import fetch_all, fetch_in, find_one, select_rows
from app.registry.tables import agency_secrets, cerpm_spans, markers

_CHUNK = 500


class SpanRow(NamedTuple):
    """Transmissions of a CERPM that one upload had; times are seconds since 1970-01-01 UTC, None without a clock."""

    row: int
    number: int
    first_sequence: int
    last_sequence: int
    first_heard_s: float | None
    last_heard_s: float | None


def find_secret(connection: sa.Connection, agency_id: str) -> bytes | None:
    """The agency's wrapped key, if it has one."""
    query = sa.select(agency_secrets.c.wrapped).where(agency_secrets.c.agency_id == agency_id)
    return connection.execute(query).scalar_one_or_none()


def add_secret(connection: sa.Connection, agency_id: str, wrapped: bytes, now: datetime) -> None:
    """Keep the agency's wrapped key."""
    connection.execute(sa.insert(agency_secrets).values(agency_id=agency_id, wrapped=wrapped, created_at=now))


def find_number(connection: sa.Connection, agency_id: str, number: int) -> MarkerRow | None:
    """The agency's marker that carries, or once carried, this number."""
    query = MARKERS.where(
        markers.c.agency_id == agency_id, markers.c.family == "cerpm", markers.c.digits == str(number)
    )
    return find_one(connection, query, MarkerRow)


def last_number(connection: sa.Connection, agency_id: str) -> int:
    """The highest number of the agency; 0 without any."""
    number = sa.cast(markers.c.digits, sa.BigInteger)
    query = sa.select(sa.func.max(number)).where(markers.c.agency_id == agency_id, markers.c.family == "cerpm")
    return int(connection.execute(query).scalar_one() or 0)


def list_by_number(connection: sa.Connection, agency_id: str, numbers: Iterable[int]) -> dict[int, MarkerRow]:
    """The agency's markers with these numbers, retired ones too."""
    query = MARKERS.where(markers.c.agency_id == agency_id, markers.c.family == "cerpm")
    found = fetch_in(connection, query, MarkerRow, markers.c.digits, map(str, numbers))
    return {int(row.digits): row for row in found}


def list_spans(
    connection: sa.Connection, agency_id: str, numbers: Iterable[int], before_decode: str | None = None
) -> dict[int, list[SpanRow]]:
    """What was heard of each of these markers before, or before a decode, in the order it was uploaded."""
    query = select_rows(SpanRow, cerpm_spans).where(cerpm_spans.c.agency_id == agency_id).order_by(cerpm_spans.c.row)
    if before_decode is not None:
        query = query.where(cerpm_spans.c.decode_id < before_decode)
    found: dict[int, list[SpanRow]] = {}
    for row in fetch_in(connection, query, SpanRow, cerpm_spans.c.number, numbers):
        found.setdefault(row.number, []).append(row)
    return found


def newest_row(spans: Mapping[int, Sequence[SpanRow]]) -> int:
    """Key of the span that was stored last; 0 without any."""
    return max((span.row for of_marker in spans.values() for span in of_marker), default=0)


def list_span_ends(connection: sa.Connection, agency_id: str, numbers: Iterable[int]) -> dict[int, SpanRow]:
    """From the first to the last transmission that was ever heard of each of these markers, by number.

    Only of markers that were heard; `row` is that of the span that was stored last.
    """
    wanted, mine = list(numbers), cerpm_spans.c
    first, last = sa.func.min(mine.first_sequence), sa.func.max(mine.last_sequence)
    found: dict[int, SpanRow] = {}
    for start in range(0, len(wanted), _CHUNK):
        chosen = (mine.agency_id == agency_id, mine.number.in_(wanted[start : start + _CHUNK]))
        ends = sa.select(mine.number, first.label("first"), last.label("last")).where(*chosen).group_by(mine.number)
        end = ends.subquery()
        query = (
            sa.select(
                sa.func.max(mine.row),
                mine.number,
                end.c.first,
                end.c.last,
                _time_of(mine.first_sequence == end.c.first, mine.first_heard_s),
                _time_of(mine.last_sequence == end.c.last, mine.last_heard_s),
            )
            .join(end, end.c.number == mine.number)
            .where(*chosen)
            .group_by(mine.number, end.c.first, end.c.last)
        )
        found.update({row.number: row for row in fetch_all(connection, query, SpanRow)})
    return found


def _time_of(end: sa.ColumnElement[bool], heard_s: sa.ColumnElement[float]) -> sa.ColumnElement[float | None]:
    """When an end was heard first; null where one log that has it had no times."""
    untimed = sa.func.count(sa.case((sa.and_(end, heard_s.is_(None)), 1)))
    return sa.case((untimed > 0, None), else_=sa.func.min(sa.case((end, heard_s))))


def add_spans(connection: sa.Connection, agency_id: str, decode_id: str, spans: Sequence[Mapping[str, Any]]) -> None:
    """Keep what a decode heard: number, first_sequence, last_sequence, first_heard_s, last_heard_s of each."""
    if spans:
        rows = [{"agency_id": agency_id, "decode_id": decode_id, **span} for span in spans]
        connection.execute(sa.insert(cerpm_spans), rows)
