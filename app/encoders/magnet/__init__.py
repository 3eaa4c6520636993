"""Magnet tag -> what is built: codebooks, layouts on a lane, drilling sheets."""

from app.encoders.magnet.checks import Check, Neighbour, Site, check_layout, reaction_distance_m, vehicle_clearances
from app.encoders.magnet.codebook import (
    CodebookFull,
    CodebookRules,
    allocate_codes,
    codebook_capacity,
    list_conflicts,
)
from app.encoders.magnet.costs import Bill, CostRow, UnitCost, bill_of_materials, unit_costs
from app.encoders.magnet.formats import write_sheet
from app.encoders.magnet.lane import LaneLine
from app.encoders.magnet.layout import Hole, MagnetLayout, place_line, place_tag
from app.encoders.magnet.sheet import DrillingSheet, SheetFormat, drilling_sheet

__all__ = [
    "Bill",
    "Check",
    "CodebookFull",
    "CodebookRules",
    "CostRow",
    "DrillingSheet",
    "Hole",
    "LaneLine",
    "MagnetLayout",
    "Neighbour",
    "SheetFormat",
    "Site",
    "UnitCost",
    "allocate_codes",
    "bill_of_materials",
    "check_layout",
    "codebook_capacity",
    "drilling_sheet",
    "list_conflicts",
    "place_line",
    "place_tag",
    "reaction_distance_m",
    "unit_costs",
    "vehicle_clearances",
    "write_sheet",
]
