"""What everybody may see of a marker, and what an agency releases."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from app.errors import InvalidParameter, NotFound
from app.markers.status import Status
from app.registry import public_pages as store
from app.registry.database import Database
from app.registry.public_pages import FIELDS, PublicMarkerRow, PublicPageRow
from app.registry.resources import check_version
from app.registry.tenancy import across_agencies
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.ports import Clock
from app.services.public_pages.documents import PublicField, PublicPageDocument, public_page_document

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
    """Use cases on public pages.

    Parameters
    ----------
    database : Database
    clock : Clock
    """

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
