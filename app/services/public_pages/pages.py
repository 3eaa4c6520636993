"""What everybody may see of a marker, and what an agency releases."""

from __future__ import annotations

import base64
import binascii
import hmac
import re
import secrets
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Literal, NamedTuple, NotRequired

from typing_extensions import TypedDict

from app.errors import InvalidParameter, NotFound
from app.markers.reading import Status
from app.registry import public_pages as store
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.registry.public_pages import FIELDS, ContactRow, PublicMarkerRow, PublicPageRow, ReportRow
from app.registry.resources import check_version
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.documents import document_of
from app.services.ports import Clock

# === Tokens of forms that need no key: signed, for one marker, and valid for some hours.
#
# A token holds the time at which the form was made. A program that sends the form at once is refused, and so is one
# that keeps the token for long. Its nonce identifies the form: one that is sent twice is one report.


MIN_AGE_S = 3
"""Nobody fills the form in faster. [s]"""
MAX_AGE_S = 6 * 3600
"""Time in which a form has to be sent. [s] Photographed on the road, sent at home."""
_CLOCK_ERROR_S = 60
"""How far the clocks of servers may differ. [s]"""
_PURPOSE = b"waymark damage report form 1"
_TIME_BYTES, _NONCE_BYTES, _TAG_BYTES = 6, 12, 16


class TokenRefused(ValueError):
    """A form has no valid token."""


class TokenTooYoung(TokenRefused):
    """A form was sent sooner than a person can fill it in."""


class FormTokens:
    """Makes and checks tokens.

    Parameters
    ----------
    secret : callable
        The server's master key, from which the key of tokens is derived; asked for at the first use.
    """

    def __init__(self, secret: Callable[[], bytes], clock: Clock) -> None:
        self._secret, self._clock = secret, clock

    def issue(self, marker_id: str, at: datetime | None = None) -> str:
        """A new token for a marker's form, made at a time; now by default."""
        issued_s = int((at or self._clock()).timestamp())
        signed = issued_s.to_bytes(_TIME_BYTES, "big") + secrets.token_bytes(_NONCE_BYTES)
        return base64.urlsafe_b64encode(signed + self._tag(marker_id, signed)).decode()

    def check(self, marker_id: str, token: str) -> str:
        """The nonce of a token, in hexadecimal digits.

        Raises
        ------
        TokenTooYoung
            The form was made a moment ago.
        TokenRefused
            The token is not one of a form of this marker, or it has expired.
        """
        signed, tag = self._parts(token)
        if not hmac.compare_digest(tag, self._tag(marker_id, signed)):
            raise TokenRefused("the token is not one of this form")
        age_s = self._clock().timestamp() - int.from_bytes(signed[:_TIME_BYTES], "big")
        if not -_CLOCK_ERROR_S <= age_s <= MAX_AGE_S:
            raise TokenRefused(f"the form is older than {MAX_AGE_S} s")
        if age_s < MIN_AGE_S:
            raise TokenTooYoung(f"the form was sent within {MIN_AGE_S} s")
        return signed[_TIME_BYTES:].hex()

    def _parts(self, token: str) -> tuple[bytes, bytes]:
        try:
            content = base64.b64decode(token.encode("ascii"), altchars=b"-_", validate=True)
        except (binascii.Error, UnicodeEncodeError):
            content = b""
        if len(content) != _TIME_BYTES + _NONCE_BYTES + _TAG_BYTES:
            raise TokenRefused("the token is not one of a form")
        return content[:-_TAG_BYTES], content[-_TAG_BYTES:]

    def _tag(self, marker_id: str, signed: bytes) -> bytes:
        key = hmac.digest(self._secret(), _PURPOSE, "sha256")
        return hmac.digest(key, signed + marker_id.encode(), "sha256")[:_TAG_BYTES]


# === Public pages, what agencies release, and damage reports as clients see them.


PublicField = Literal["code", "agency", "status", "revision", "road", "measure"]
ReportKind = Literal["damaged", "dirty", "missing", "loose", "other"]
ReportStatus = Literal["new", "approved", "rejected"]


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

    `item_id` is the item of the work list that it was added to.
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
    return document_of(DamageReport, report, has_photo=report.photo_key is not None, has_contact=row.has_contact)


def contact_document(row: ContactRow) -> ReportContact:
    """A contact as clients see it."""
    return document_of(ReportContact, row)


# === What everybody may see of a marker, and what an agency releases.


_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


class PublicMarker(NamedTuple):
    """A marker as its agency releases it; what it does not release is None.

    `agency_id` and `id` are for the server.
    """

    id: str
    agency_id: str
    takes_reports: bool
    code: str | None
    agency: str | None
    status: Status | None
    revision: int | None
    road: str | None
    measure_m: float | None


class PublicPages:
    """Use cases on public pages."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database, self._clock = database, clock

    def read(self, marker_id: str) -> PublicMarker:
        """A marker as its agency releases it, for anybody who has its address.

        Raises
        ------
        NotFound
            There is no such marker, or its agency publishes nothing: the error is the same.
        """
        row = None
        if _ID.fullmatch(marker_id):
            with across_agencies():
                row = self._database.ask(lambda connection: store.find_public_marker(connection, marker_id))
        if row is None or not (released := _released(row)):
            raise NotFound("there is no public page here")
        return _public_marker(row, released)

    def settings(self, caller: Caller) -> PublicPageDocument:
        """What the caller's agency releases."""
        with self._database.read() as connection:
            return public_page_document(store.get_public_page(connection, caller.agency_id))

    def change(
        self, caller: Caller, fields: Sequence[PublicField], damage_reports: bool, version: int | None
    ) -> PublicPageDocument:
        """Release other fields, or none.

        Raises
        ------
        InvalidParameter
            Reports would be taken on pages that do not exist.
        StaleVersion
            The settings were changed since the caller read them.
        """
        if damage_reports and not fields:
            raise InvalidParameter(
                "without fields there are no public pages that could take damage reports",
                field="damage_reports",
                limit="false while fields is empty",
                cure="release a field, or set damage_reports to false",
            )
        now = self._clock()
        with self._database.write() as connection:
            known = store.get_public_page(connection, caller.agency_id)
            check_version("public page", caller.agency_id, known.version, version)
            ordered = [name for name in FIELDS if name in fields]
            row = PublicPageRow(ordered, damage_reports, known.version + 1, now)
            store.put_public_page(connection, caller.agency_id, row)
            log_change(
                connection, caller, "public-page.changed", now=now, fields=ordered, damage_reports=damage_reports
            )
            return public_page_document(row)


def _released(row: PublicMarkerRow) -> frozenset[str]:
    return frozenset(store.DEFAULT.fields if row.fields is None else row.fields)


def _public_marker(row: PublicMarkerRow, released: frozenset[str]) -> PublicMarker:
    return PublicMarker(
        id=row.id,
        agency_id=row.agency_id,
        takes_reports=store.DEFAULT.damage_reports if row.damage_reports is None else row.damage_reports,
        code=row.digits if "code" in released else None,
        agency=row.agency if "agency" in released else None,
        status=row.status if "status" in released else None,
        revision=row.version if "revision" in released else None,
        road=row.road if "road" in released else None,
        measure_m=row.measure_m if "measure" in released else None,
    )
