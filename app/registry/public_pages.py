"""Queries on public pages: what an agency releases, and what is known of a marker whose page is asked for."""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import sqlalchemy as sa

from app.markers.status import Status
from app.registry.public_tables import public_pages
from app.registry.rows import find_one, select_rows
from app.registry.tables import agencies, markers

FIELDS = ("code", "agency", "status", "revision", "road", "measure")
"""What an agency can release of a marker."""
_P = public_pages.c


class PublicPageRow(NamedTuple):
    """What an agency releases.

    Attributes
    ----------
    fields : list of str
        Some of `FIELDS`; none: its markers have no public pages.
    damage_reports : bool
        Whether the pages have a form for damage reports.
    version : int
        0: the agency has changed nothing.
    """

    fields: list[str]
    damage_reports: bool
    version: int
    updated_at: datetime | None


DEFAULT = PublicPageRow(["code", "agency", "status", "revision"], True, 0, None)
"""Of an agency that has changed nothing."""


class PublicMarkerRow(NamedTuple):
    """A marker with its agency, and what that releases; the columns of the latter are None where it changed nothing."""

    id: str
    agency_id: str
    agency: str
    family: str
    digits: str | None
    status: Status
    version: int
    road: str | None
    measure_m: float | None
    fields: list[str] | None
    damage_reports: bool | None


_MARKER = (
    sa.select(
        markers.c.id,
        markers.c.agency_id,
        agencies.c.name.label("agency"),
        markers.c.family,
        markers.c.digits,
        markers.c.status,
        markers.c.version,
        markers.c.road,
        markers.c.measure_m,
        _P.fields,
        _P.damage_reports,
    )
    .join(agencies, agencies.c.id == markers.c.agency_id)
    .outerjoin(public_pages, _P.agency_id == markers.c.agency_id)
    .where(markers.c.id == sa.bindparam("marker_id"))
)


def find_public_marker(connection: sa.Connection, marker_id: str) -> PublicMarkerRow | None:
    """A marker of any agency; one statement, so that unknown and unpublished markers take the same time."""
    return find_one(connection, _MARKER, PublicMarkerRow, {"marker_id": marker_id})


def get_public_page(connection: sa.Connection, agency_id: str) -> PublicPageRow:
    """What an agency releases."""
    query = select_rows(PublicPageRow, public_pages).where(_P.agency_id == agency_id)
    return find_one(connection, query, PublicPageRow) or DEFAULT


def put_public_page(connection: sa.Connection, agency_id: str, row: PublicPageRow) -> None:
    """Change what an agency releases."""
    if row.version == 1:
        connection.execute(sa.insert(public_pages).values(agency_id=agency_id, **row._asdict()))
        return
    connection.execute(sa.update(public_pages).where(_P.agency_id == agency_id).values(**row._asdict()))
