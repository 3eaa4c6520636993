"""Public pages, what agencies release, and damage reports as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Literal, NotRequired

from typing_extensions import TypedDict

from app.registry.damage_reports import ContactRow, ReportRow
from app.registry.public_pages import PublicPageRow
from app.services.documents import document_of

PublicField = Literal["code", "agency", "status", "revision", "road", "measure"]
ReportKind = Literal["damaged", "dirty", "missing", "loose", "other"]
ReportStatus = Literal["new", "accepted", "rejected"]


class ReportForm(TypedDict):
    """How a damage report is sent: multipart/form-data to `href`, with the token, after `min_age_s` at the earliest."""

    href: str
    token: str
    kinds: list[ReportKind]
    min_age_s: int
    max_age_s: int


class PublicMarkerDocument(TypedDict):
    """What the agency of a marker releases; members that it does not release are missing."""

    code: NotRequired[str]
    agency: NotRequired[str]
    status: NotRequired[str]
    revision: NotRequired[int]
    road: NotRequired[str]
    measure_m: NotRequired[float]
    report: ReportForm | None


class ReceivedReport(TypedDict):
    """A damage report was received."""

    status: Literal["received"]


class PublicPageDocument(TypedDict):
    """What an agency releases of its markers on their public pages, and whether the pages take damage reports.

    Without fields there are no pages. Version 0 is the default: nothing was changed.
    """

    fields: list[PublicField]
    damage_reports: bool
    version: int
    updated_at: datetime | None


class DamageReport(TypedDict):
    """A damage report from a public page, and what a person decided.

    `item_id` is the item of the work list that it was accepted into.
    """

    id: str
    marker_id: str
    kind: ReportKind
    text: str | None
    language: str
    has_photo: bool
    has_contact: bool
    status: ReportStatus
    note: str | None
    item_id: str | None
    decided_by: str | None
    decided_at: datetime | None
    created_at: datetime


class DamageReportPage(TypedDict):
    """A page of damage reports, newest first."""

    items: list[DamageReport]


class ReportContact(TypedDict):
    """How the sender of a damage report can be reached."""

    report_id: str
    email: str
    created_at: datetime


def public_page_document(row: PublicPageRow) -> PublicPageDocument:
    """What an agency releases, as clients see it."""
    return document_of(PublicPageDocument, row)


def damage_report_document(row: ReportRow) -> DamageReport:
    """A damage report as clients see it."""
    report = row.report
    return document_of(
        DamageReport, report, status=report.state, has_photo=report.photo_key is not None, has_contact=row.has_contact
    )


def contact_document(row: ContactRow) -> ReportContact:
    """A contact as clients see it."""
    return document_of(ReportContact, row)
