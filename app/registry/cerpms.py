"""Queries on CERPMs: their numbers, their agency's secret, and which transmissions were heard."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.registry.markers import PUBLIC, Row
from app.registry.tables import agency_secrets, cerpm_spans, markers

_CHUNK = 500


def find_secret(connection: sa.Connection, agency_id: str) -> bytes | None:
    """The agency's wrapped key, if it has one."""
    query = sa.select(agency_secrets.c.wrapped).where(agency_secrets.c.agency_id == agency_id)
    return connection.execute(query).scalar_one_or_none()


def add_secret(connection: sa.Connection, agency_id: str, wrapped: bytes, now: datetime) -> None:
    """Keep the agency's wrapped key."""
    connection.execute(sa.insert(agency_secrets).values(agency_id=agency_id, wrapped=wrapped, created_at=now))


def find_number(connection: sa.Connection, agency_id: str, number: int) -> Row | None:
    """The agency's marker that carries, or once carried, this number."""
    query = sa.select(*PUBLIC).where(
        markers.c.agency_id == agency_id, markers.c.family == "cerpm", markers.c.digits == str(number)
    )
    return connection.execute(query).mappings().one_or_none()


def last_number(connection: sa.Connection, agency_id: str) -> int:
    """The highest number of the agency; 0 without any."""
    number = sa.cast(markers.c.digits, sa.BigInteger)
    query = sa.select(sa.func.max(number)).where(markers.c.agency_id == agency_id, markers.c.family == "cerpm")
    return int(connection.execute(query).scalar_one() or 0)


def list_by_number(connection: sa.Connection, agency_id: str, numbers: Iterable[int]) -> dict[int, Row]:
    """The agency's markers with these numbers, retired ones too."""
    wanted = [str(number) for number in numbers]
    query = sa.select(*PUBLIC).where(markers.c.agency_id == agency_id, markers.c.family == "cerpm")
    found: dict[int, Row] = {}
    for start in range(0, len(wanted), _CHUNK):
        chunk = query.where(markers.c.digits.in_(wanted[start : start + _CHUNK]))
        found.update({int(row["digits"]): row for row in connection.execute(chunk).mappings()})
    return found


def list_spans(connection: sa.Connection, agency_id: str, numbers: Iterable[int]) -> dict[int, list[Row]]:
    """What was heard of each of these markers before, in the order it was uploaded."""
    wanted = list(numbers)
    query = sa.select(cerpm_spans).where(cerpm_spans.c.agency_id == agency_id).order_by(cerpm_spans.c.row)
    found: dict[int, list[Row]] = {}
    for start in range(0, len(wanted), _CHUNK):
        chunk = query.where(cerpm_spans.c.number.in_(wanted[start : start + _CHUNK]))
        for row in connection.execute(chunk).mappings():
            found.setdefault(row["number"], []).append(row)
    return found


def list_span_ends(connection: sa.Connection, agency_id: str, numbers: Iterable[int]) -> dict[int, Row]:
    """First and last transmission of each of these markers that was ever heard, and when, by number.

    Rows have number, first_sequence, first_heard_s, last_sequence, last_heard_s; of markers that were heard.
    """
    wanted, mine = list(numbers), cerpm_spans.c
    first, last = sa.func.min(mine.first_sequence), sa.func.max(mine.last_sequence)
    found: dict[int, Row] = {}
    for start in range(0, len(wanted), _CHUNK):
        chosen = (mine.agency_id == agency_id, mine.number.in_(wanted[start : start + _CHUNK]))
        ends = sa.select(mine.number, first.label("first"), last.label("last")).where(*chosen).group_by(mine.number)
        end = ends.subquery()
        query = (
            sa.select(
                mine.number,
                end.c.first.label("first_sequence"),
                end.c.last.label("last_sequence"),
                _time_of(mine.first_sequence == end.c.first, mine.first_heard_s).label("first_heard_s"),
                _time_of(mine.last_sequence == end.c.last, mine.last_heard_s).label("last_heard_s"),
            )
            .join(end, end.c.number == mine.number)
            .where(*chosen)
            .group_by(mine.number, end.c.first, end.c.last)
        )
        found.update({row["number"]: row for row in connection.execute(query).mappings()})
    return found


def _time_of(end: sa.ColumnElement[bool], heard_s: sa.ColumnElement[float]) -> sa.ColumnElement[float | None]:
    """When an end was heard first; null where one log that has it had no times."""
    untimed = sa.func.count(sa.case((sa.and_(end, heard_s.is_(None)), 1)))
    return sa.case((untimed > 0, None), else_=sa.func.min(sa.case((end, heard_s))))


def last_span_row(connection: sa.Connection, agency_id: str) -> int:
    """The row of the agency's newest span; a reader sees by it whether others were added since."""
    query = sa.select(sa.func.max(cerpm_spans.c.row)).where(cerpm_spans.c.agency_id == agency_id)
    return int(connection.execute(query).scalar_one() or 0)


def add_spans(connection: sa.Connection, agency_id: str, decode_id: str, spans: Sequence[Mapping[str, Any]]) -> None:
    """Keep what a decode heard: number, first_sequence, last_sequence, first_heard_s, last_heard_s of each."""
    if spans:
        rows = [{"agency_id": agency_id, "decode_id": decode_id, **span} for span in spans]
        connection.execute(sa.insert(cerpm_spans), rows)
