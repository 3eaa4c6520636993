"""Damage reports: sent by anybody from a public page, and decided on by the agency."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Literal

import sqlalchemy as sa
import structlog

from app.errors import Conflict, NotFound, QuotaExceeded, TooManyRequests, Unavailable, WaymarkError
from app.formats.format import SpooledFile
from app.formats.images import FIELD, ImageLimits, is_picture, unknown_picture
from app.registry import public_pages as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.engines import across_agencies, acting_for
from app.registry.markers import get_marker
from app.registry.public_pages import ReportRow, StoredReport
from app.registry.webhooks import add_event
from app.services.access.access import Caller, Scope
from app.services.access.audit import log_change
from app.services.blobs import delete_unused, staged
from app.services.health.maintenance import open_reported_item
from app.services.ports import Blobs, Clock, DecoderProcesses
from app.services.public_pages.pages import (
    DamageReport,
    DamageReportPage,
    PublicMarker,
    ReportContact,
    ReportKind,
    contact_document,
    damage_report_document,
)
from app.services.public_pages.tasks import write_report_photo
from app.services.uploads.quotas import Quotas

MAX_NEW_OF_MARKER, MAX_NEW_OF_AGENCY = 20, 2000
"""Reports that may wait for a decision. More of one marker add no information."""
RECEIVED, DECIDED = "report.received", "report.decided"
"""Kinds of events."""
_BUSY_WAIT_S = 10.0
_HOLDER = "public-pages"
"""Under which the quotas count photos."""
_SIGNATURE_BYTES = 16
_LOG = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class SentReport:
    """A damage report as it was sent and checked."""

    form_nonce: str  # of the token of the form
    kind: ReportKind
    text: str | None
    photo: SpooledFile | None
    email: str | None
    language: str  # of the page


class DamageReports:
    """Use cases on damage reports.

    Parameters
    ----------
    images : ImageLimits
        Of photos.
    contact_days : int
        After how many days contacts are deleted.
    """

    def __init__(
        self, database: Database, clock: Clock, blobs: Blobs, processes: DecoderProcesses, quotas: Quotas,
        *, images: ImageLimits, contact_days: int,
    ) -> None:  # fmt: skip
        self._database, self._clock, self._blobs, self._processes = database, clock, blobs, processes
        self._quotas, self._images, self._contact_time = quotas, images, timedelta(days=contact_days)

    # --- from anybody -----------------------------------------------------------------------------------------------

    def submit(self, marker: PublicMarker, sent: SentReport) -> str:
        """Store a report, and return its id; a form that was sent before gets the id of its report.

        Raises
        ------
        NotFound
            The agency takes no reports.
        TooManyRequests
            Too many reports of the marker or the agency wait for a decision.
        UnreadableUpload, UploadTooLarge, UnsupportedUpload
            The photo cannot be used.
        Unavailable
            The decoder processes are busy, or the agency's quota is used up.
        """
        if not marker.takes_reports:
            raise NotFound("there is no public page here")
        with acting_for(marker.agency_id):
            with self._database.read() as connection:
                earlier = _check_new(connection, marker, sent)
            if earlier is not None:
                return earlier
            photo = self._written_photo(sent.photo) if sent.photo is not None else None
            return self._store(marker, sent, photo)

    def _written_photo(self, photo: SpooledFile) -> bytes:
        head = photo.head(_SIGNATURE_BYTES)
        if not is_picture(head):
            error = unknown_picture(head)
            error.field = "photo"
            raise error
        try:
            return self._processes.run(write_report_photo, photo, self._images, wait_s=_BUSY_WAIT_S)
        except WaymarkError as error:
            if error.field == FIELD:
                error.field = "photo"  # the form's name of the file
            raise

    def _store(self, marker: PublicMarker, sent: SentReport, photo: bytes | None) -> str:
        now, agency_id = self._clock(), marker.agency_id
        with staged(self._blobs) as blobs:
            key = None if photo is None else blobs.put("reports", photo)
            report = StoredReport(
                id=new_id(now), agency_id=agency_id, marker_id=marker.id, form_nonce=sent.form_nonce, kind=sent.kind,
                text=sent.text, language=sent.language, photo_key=key, photo_bytes=len(photo) if photo else None,
                status="new", note=None, item_id=None, decided_by=None, decided_at=None, created_at=now,
            )  # fmt: skip
            with self._database.write() as connection:
                earlier = _check_new(connection, marker, sent)
                if earlier is not None:
                    return earlier
                if photo is not None:
                    self._count(connection, agency_id, len(photo))
                store.add_report(connection, report, sent.email)
                add_event(connection, agency_id, RECEIVED, subject_id=report.id, at=now, detail=_event_detail(report))
            blobs.keep()
        return report.id

    def _count(self, connection: sa.Connection, agency_id: str, size: int) -> None:
        try:
            self._quotas.count(connection, Caller(agency_id, _HOLDER, _HOLDER, Scope.VEHICLE), size)
        except QuotaExceeded as error:  # its figures are none of the sender's business
            _LOG.warning("a photo of a damage report is beyond the quota", agency_id=agency_id, limit=error.limit)
            raise Unavailable("photos cannot be stored at present", cure="send the report without a photo") from error

    # --- of the agency ----------------------------------------------------------------------------------------------

    def page(
        self, caller: Caller, *, status: str | None, marker_id: str | None, before: str | None, limit: int
    ) -> tuple[DamageReportPage, str | None]:
        """A page of reports, newest first, and the id to continue before if there are more."""
        with self._database.read() as connection:
            rows = store.list_reports(
                connection, caller.agency_id, status=status, marker_id=marker_id, before=before, limit=limit + 1
            )
        page = DamageReportPage(items=[damage_report_document(row) for row in rows[:limit]])
        return page, rows[limit - 1].report.id if len(rows) > limit else None

    def get(self, caller: Caller, report_id: str) -> DamageReport:
        """One report."""
        with self._database.read() as connection:
            return damage_report_document(store.get_report(connection, caller.agency_id, report_id))

    def photo(self, caller: Caller, report_id: str) -> bytes:
        """The photo of a report, a JPEG.

        Raises
        ------
        NotFound
            There is no such report, or it has no photo.
        """
        with self._database.read() as connection:
            row = store.get_report(connection, caller.agency_id, report_id)
        return self._blobs.get(_photo_key(row))

    def delete_photo(self, caller: Caller, report_id: str) -> None:
        """Delete the photo of a report: it may show people.

        Raises
        ------
        NotFound
            There is no such report, or it has no photo.
        """
        now = self._clock()
        with self._database.write() as connection:
            row = store.get_report(connection, caller.agency_id, report_id)
            key = _photo_key(row)
            store.change_report(connection, caller.agency_id, report_id, photo_key=None, photo_bytes=None)
            log_change(connection, caller, "damage-report.photo-deleted", now=now, subject=report_id)
        delete_unused(self._blobs, [key])

    def contact(self, caller: Caller, report_id: str) -> ReportContact:
        """How the sender of a report can be reached."""
        with self._database.read() as connection:
            return contact_document(store.get_contact(connection, caller.agency_id, report_id))

    def delete_contact(self, caller: Caller, report_id: str) -> None:
        """Delete the contact of a report; the report stays."""
        now = self._clock()
        with self._database.write() as connection:
            store.get_contact(connection, caller.agency_id, report_id)
            store.delete_contact(connection, caller.agency_id, report_id)
            log_change(connection, caller, "damage-report.contact-deleted", now=now, subject=report_id)

    def approve(self, caller: Caller, report_id: str, note: str | None) -> DamageReport:
        """Approve a report into the work list: a new item of the marker, or one more report of the item that is open.

        Raises
        ------
        Conflict
            The report was decided before.
        """
        now = self._clock()
        with self._database.write() as connection:
            report = _undecided(connection, caller, report_id)
            marker = get_marker(connection, caller.agency_id, report.marker_id)
            item = open_reported_item(
                connection, caller.agency_id, marker, report.id, report.kind, report.created_at, now
            )
            return self._decide(connection, caller, report, "approved", note, item.id, now)

    def reject(self, caller: Caller, report_id: str, reason: str) -> DamageReport:
        """Reject a report with a reason.

        Raises
        ------
        Conflict
            The report was decided before.
        """
        with self._database.write() as connection:
            report = _undecided(connection, caller, report_id)
            return self._decide(connection, caller, report, "rejected", reason, None, self._clock())

    def _decide(
        self,
        connection: sa.Connection,
        caller: Caller,
        report: StoredReport,
        status: Literal["approved", "rejected"],
        note: str | None,
        item_id: str | None,
        now: datetime,
    ) -> DamageReport:
        agency_id = caller.agency_id
        store.change_report(
            connection, agency_id, report.id,
            status=status, note=note, item_id=item_id, decided_by=caller.label, decided_at=now,
        )  # fmt: skip
        log_change(
            connection, caller, f"damage-report.{status}", now=now, subject=report.id,
            marker_id=report.marker_id, kind=report.kind, note=note, item_id=item_id,
        )  # fmt: skip
        row = store.get_report(connection, agency_id, report.id)
        add_event(
            connection, agency_id, DECIDED, subject_id=report.id, at=now,
            detail={**_event_detail(row.report), "item_id": item_id},
        )  # fmt: skip
        return damage_report_document(row)

    # --- of the server ----------------------------------------------------------------------------------------------

    def delete_old_contacts(self) -> int:
        """Delete the contacts of all agencies whose time is over; returns their number."""
        before = self._clock() - self._contact_time
        with across_agencies(), self._database.write() as connection:
            return store.delete_old_contacts(connection, before)

    def try_to_delete_old_contacts(self) -> None:
        """As `delete_old_contacts`; a database that does not answer is asked the next day."""
        with suppress(Unavailable, sa.exc.SQLAlchemyError):
            self.delete_old_contacts()


def _check_new(connection: sa.Connection, marker: PublicMarker, sent: SentReport) -> str | None:
    """Refuse a report that is one too many; returns the id of the report that the form was sent with before."""
    earlier = store.find_sent(connection, marker.agency_id, marker.id, sent.form_nonce)
    if earlier is not None:
        return earlier
    for of, limit in ((marker.id, MAX_NEW_OF_MARKER), (None, MAX_NEW_OF_AGENCY)):
        if store.count_new(connection, marker.agency_id, of) >= limit:
            raise TooManyRequests(
                "many reports wait for a decision already", limit=f"{limit} reports", cure="try again tomorrow",
                retry_after_s=3600,
            )  # fmt: skip
    return None


def _undecided(connection: sa.Connection, caller: Caller, report_id: str) -> StoredReport:
    report = store.get_report(connection, caller.agency_id, report_id).report
    if report.status != "new":
        raise Conflict(
            f"the report was {report.status} before", field="report_id", limit="new reports",
            cure=f"read it: GET /v1/damage-reports/{report_id}",
        )  # fmt: skip
    return report


def _photo_key(row: ReportRow) -> str:
    key = row.report.photo_key
    if key is None:
        raise NotFound(
            f"the damage report {row.report.id} has no photo",
            field="report_id",
            cure="has_photo of the report is true if there is one",
        )
    return key


def _event_detail(report: StoredReport) -> dict[str, object]:
    return {"marker_id": report.marker_id, "kind": report.kind, "status": report.status}
