"""Magnet tag -> what is built: codebooks, layouts on a lane, drilling sheets."""

from app.encoders.magnet.codebook import (
    CodebookFull,
    CodebookRules,
    allocate_codes,
    codebook_capacity,
    fitting_codes,
    list_conflicts,
)
from app.encoders.magnet.layout import DrillingSheet, Hole, MagnetLayout, SheetFormat, place_line, place_tag
from app.encoders.magnet.sheets import write_sheet

__all__ = [
    "CodebookFull",
    "CodebookRules",
    "DrillingSheet",
    "Hole",
    "MagnetLayout",
    "SheetFormat",
    "allocate_codes",
    "codebook_capacity",
    "fitting_codes",
    "list_conflicts",
    "place_line",
    "place_tag",
    "write_sheet",
]
