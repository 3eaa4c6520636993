"""Magnet markers -> drilling sheets for the crew."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from app.encoders.magnet import SheetFormat, write_sheet
from app.errors import NotFound
from app.registry import markers as store
from app.registry.database import Database
from app.registry.markers import Row
from app.services.access import Caller
from app.services.magnet_layouts import sheet_of

LAYOUT_VERSION = 1
"""Goes up when the same marker would get another sheet."""


@dataclass(frozen=True, slots=True)
class LayoutFile:
    """A drilling sheet as a file."""

    content: bytes
    media_type: str
    file_name: str


class Layouts:
    """Use cases on layouts."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def tag(self, caller: Caller, marker_id: str, form: SheetFormat) -> str:
        """What the sheet depends on, as a short hash: it changes when the sheet would.

        Raises
        ------
        NotFound
            There is no such marker of magnets.
        """
        row = self._get_magnets(caller, marker_id)
        parts = (LAYOUT_VERSION, row["id"], row["version"], str(form))
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]

    def sheet(self, caller: Caller, marker_id: str, form: SheetFormat) -> LayoutFile:
        """Drilling sheet of a marker.

        Raises
        ------
        NotFound
            There is no such marker of magnets.
        """
        row = self._get_magnets(caller, marker_id)
        content = write_sheet(sheet_of(row), form)
        return LayoutFile(content, form.media_type, f"{row['id']}-r{row['version']}.{form}")

    def _get_magnets(self, caller: Caller, marker_id: str) -> Row:
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        if row["family"] != "magnet":
            raise NotFound(f"marker {marker_id} has no magnets", field="marker_id", limit="magnets have a layout")
        return row
