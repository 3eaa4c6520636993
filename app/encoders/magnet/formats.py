"""The file formats of drilling sheets, each with its writer."""

from __future__ import annotations

from app.encoders.magnet.sheet import DrillingSheet, SheetFormat
from app.encoders.magnet.sheet_csv import write_sheet_csv
from app.encoders.magnet.sheet_geojson import write_sheet_geojson
from app.encoders.magnet.sheet_pdf import write_sheet_pdf


def write_sheet(sheet: DrillingSheet, form: SheetFormat) -> bytes:
    """Write a drilling sheet in one format."""
    match form:
        case SheetFormat.PDF:
            return write_sheet_pdf(sheet)
        case SheetFormat.CSV:
            return write_sheet_csv(sheet)
        case SheetFormat.GEOJSON:
            return write_sheet_geojson(sheet)
