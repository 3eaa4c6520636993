"""Queries on public pages and damage reports: what an agency releases, and what is known of a page's marker."""

from __future__ import annotations

from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.errors import NotFound
from app.markers.reading import Status
from app.registry.agencies import agencies
from app.registry.column_types import ID, UtcTime, agency_column, columns_of, find_one, metadata, one_of, select_rows
from app.registry.marker_rows import markers

REPORT_KINDS = ("damaged", "dirty", "missing", "loose", "other")

REPORT_STATUSES = ("new", "approved", "rejected")

# what an agency releases; without a row, `app.registry.public_pages.DEFAULT`
public_pages = sa.Table(
    "public_pages",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("fields", sa.JSON, nullable=False),
    sa.Column("damage_reports", sa.Boolean, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
)

damage_reports = sa.Table(
    "damage_reports",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), nullable=False),
    sa.Column("form_nonce", sa.String(32), nullable=False),  # of the form: one that is sent twice is one report
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("text", sa.String(2000)),
    sa.Column("language", sa.String(8), nullable=False),
    sa.Column("photo_key", sa.String(200)),
    sa.Column("photo_bytes", sa.BigInteger),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("note", sa.String(500)),
    sa.Column("item_id", ID, sa.ForeignKey("maintenance_items.id")),  # that the report was added to
    sa.Column("decided_by", sa.String(200)),
    sa.Column("decided_at", UtcTime),
    sa.Column("created_at", UtcTime, nullable=False),
    one_of("kind", REPORT_KINDS),
    one_of("status", REPORT_STATUSES),
    sa.UniqueConstraint("marker_id", "form_nonce"),
    sa.Index("ix_damage_reports_agency_id_id", "agency_id", "id"),
    sa.Index("ix_damage_reports_agency_id_status_id", "agency_id", "status", "id"),
    sa.Index("ix_damage_reports_marker_id_status", "marker_id", "status"),
)

# apart from the reports, so that it can be deleted without them
damage_report_contacts = sa.Table(
    "damage_report_contacts",
    metadata,
    sa.Column("report_id", ID, sa.ForeignKey("damage_reports.id"), primary_key=True),
    agency_column(),
    sa.Column("email", sa.String(254), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Index("ix_damage_report_contacts_created_at", "created_at"),
)

FIELDS = ("code", "agency", "status", "revision", "road", "measure")
"""What an agency can release of a marker."""
_P = public_pages.c


class PublicPageRow(NamedTuple):
    """What an agency releases."""

    fields: list[str]  # some of `FIELDS`; none: its markers have no public pages
    damage_reports: bool  # whether the pages have a form for damage reports
    version: int  # 0: the agency has changed nothing
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


# === Queries on damage reports, and on the contacts of those who sent them.


_R, _C = damage_reports.c, damage_report_contacts.c
NO_CONTACT_CURE = "has_contact of the report is true if there is one"


class StoredReport(NamedTuple):
    """A damage report as it is stored."""

    id: str
    agency_id: str
    marker_id: str
    form_nonce: str  # of the form that it was sent with
    # `kind`, `text`, `language`: what the sender chose and wrote, and the language of the page
    kind: str
    text: str | None
    language: str
    # `photo_key`, `photo_bytes`: blob of the photo
    photo_key: str | None
    photo_bytes: int | None
    # `status`, `note`: new, approved or rejected; and why
    status: str
    note: str | None
    item_id: str | None  # item of the work list that it was added to
    decided_by: str | None
    decided_at: datetime | None
    created_at: datetime


class ReportRow(NamedTuple):
    """A damage report, and whether the sender left a contact."""

    report: StoredReport
    has_contact: bool


_HAS_CONTACT = sa.exists().where(_C.report_id == _R.id)
_REPORTS = sa.select(*columns_of(StoredReport, damage_reports), _HAS_CONTACT.label("has_contact"))


def _row(found: Any) -> ReportRow:
    return ReportRow(StoredReport(*found[:-1]), bool(found[-1]))


def add_report(connection: sa.Connection, report: StoredReport, email: str | None) -> None:
    """Store a new report, and the contact."""
    connection.execute(sa.insert(damage_reports), report._asdict())
    if email is not None:
        values = {"report_id": report.id, "agency_id": report.agency_id, "email": email}
        connection.execute(sa.insert(damage_report_contacts).values(**values, created_at=report.created_at))


def find_sent(connection: sa.Connection, agency_id: str, marker_id: str, form_nonce: str) -> str | None:
    """Id of the report that a form was sent with before."""
    query = sa.select(_R.id).where(_R.agency_id == agency_id, _R.marker_id == marker_id, _R.form_nonce == form_nonce)
    return connection.execute(query).scalar_one_or_none()


def count_new(connection: sa.Connection, agency_id: str, marker_id: str | None = None) -> int:
    """Number of reports that nobody has decided on, of an agency or of one of its markers."""
    query = sa.select(sa.func.count()).select_from(damage_reports)
    query = query.where(_R.agency_id == agency_id, _R.status == "new")
    if marker_id is not None:
        query = query.where(_R.marker_id == marker_id)
    return int(connection.execute(query).scalar_one())


def get_report(connection: sa.Connection, agency_id: str, report_id: str) -> ReportRow:
    """One report.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another agency.
    """
    found = connection.execute(_REPORTS.where(_R.id == report_id, _R.agency_id == agency_id)).one_or_none()
    if found is None:
        raise NotFound(
            f"there is no damage report {report_id}", field="report_id", cure="GET /v1/damage-reports lists yours"
        )
    return _row(found)


def list_reports(
    connection: sa.Connection, agency_id: str, *, status: str | None = None, marker_id: str | None = None,
    before: str | None = None, limit: int = 100,
) -> list[ReportRow]:  # fmt: skip
    """Reports, newest first."""
    query = _REPORTS.where(_R.agency_id == agency_id)
    for column, value in ((_R.status, status), (_R.marker_id, marker_id)):
        if value is not None:
            query = query.where(column == value)
    if before is not None:
        query = query.where(_R.id < before)
    return [_row(found) for found in connection.execute(query.order_by(_R.id.desc()).limit(limit))]


def change_report(connection: sa.Connection, agency_id: str, report_id: str, **values: object) -> None:
    """Set columns of a report."""
    own = sa.update(damage_reports).where(_R.id == report_id, _R.agency_id == agency_id)
    connection.execute(own.values(**values))


class ContactRow(NamedTuple):
    """How the sender of a report can be reached."""

    report_id: str
    email: str
    created_at: datetime


_CONTACTS = sa.select(*columns_of(ContactRow, damage_report_contacts))


def get_contact(connection: sa.Connection, agency_id: str, report_id: str) -> ContactRow:
    """The contact of a report.

    Raises
    ------
    NotFound
        There is none, or it belongs to another agency.
    """
    row = find_one(connection, _CONTACTS.where(_C.report_id == report_id, _C.agency_id == agency_id), ContactRow)
    if row is None:
        raise NotFound(f"there is no contact of a report {report_id}", field="report_id", cure=NO_CONTACT_CURE)
    return row


def delete_contact(connection: sa.Connection, agency_id: str, report_id: str) -> bool:
    """Delete the contact of a report; False if there is none."""
    own = sa.delete(damage_report_contacts).where(_C.report_id == report_id, _C.agency_id == agency_id)
    return connection.execute(own).rowcount == 1


def delete_old_contacts(connection: sa.Connection, before: datetime) -> int:
    """Delete the contacts of all agencies that are from before a time; returns their number."""
    return connection.execute(sa.delete(damage_report_contacts).where(_C.created_at < before)).rowcount
