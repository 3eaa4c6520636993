"""A layout with its checks and its bill of materials: what the writers of drilling sheets take."""

from __future__ import annotations

from app.encoders.magnet.layout import MagnetLayout
from app.encoders.magnet.sheet import DrillingSheet
from app.planning.costs import bill_of_materials
from app.planning.magnet_checks import Site, check_layout


def drilling_sheet(layout: MagnetLayout, site: Site | None = None) -> DrillingSheet:
    """Check a layout and count its materials."""
    return DrillingSheet(layout, check_layout(layout, site or Site()), bill_of_materials(layout))
