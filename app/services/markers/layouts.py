"""Sheets of markers for the crew: the drilling sheets of magnets."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from app.encoders.magnet import SheetFormat
from app.errors import NotFound
from app.families import get_family
from app.families.files import MarkerSheet
from app.registry import markers as store
from app.registry.database import Database
from app.registry.marker_rows import MarkerRow
from app.services.access.access import Caller


@dataclass(frozen=True, slots=True)
class LayoutFile:
    """A sheet as a file."""

    content: bytes
    media_type: str
    file_name: str


class Layouts:
    """Use cases on layouts."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def tag(self, caller: Caller, marker_id: str, form: SheetFormat) -> str:
        """A short hash of everything that the sheet depends on.

        Raises
        ------
        NotFound
            There is no such marker, or its family has no layout.
        """
        row, sheet = self._get(caller, marker_id)
        parts = (sheet.version, row.id, row.version, str(form))
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]

    def sheet(self, caller: Caller, marker_id: str, form: SheetFormat) -> LayoutFile:
        """Sheet of a marker; raises as `tag`."""
        row, sheet = self._get(caller, marker_id)
        return LayoutFile(sheet.write(row, form), form.media_type, f"{row.id}-r{row.version}.{form}")

    def _get(self, caller: Caller, marker_id: str) -> tuple[MarkerRow, MarkerSheet]:
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        sheet = get_family(row.family).sheet
        if sheet is None:
            raise NotFound(f"marker {marker_id} has no magnets", field="marker_id", limit="magnets have a layout")
        return row, sheet
