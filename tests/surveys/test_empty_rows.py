"""Rows without coordinates show nothing about the place of the others."""

from __future__ import annotations

import numpy as np

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.surveys.georeference import georeference_survey
from app.surveys.location_checks import Neighbours, check_location
from app.values import Floats


def _codes(rows: list[str]) -> set[str]:
    declaration = ImportDeclaration(crs="EPSG:25832")
    table = read_survey("\n".join(["point,easting,northing", *rows]).encode(), declaration)
    none: Floats = np.zeros(0)
    found = check_location(
        georeference_survey(table, declaration, 0.1), declaration, Neighbours(none, none, none, ()), lambda *_: False
    )
    return {fault.code for fault in found if fault.row is None}


def test_empty_rows_do_not_swap_the_axes_of_the_others() -> None:
    good = [f"{k},{457000 + 10 * k},5428000" for k in range(6)]
    assert _codes(good) == {"place_unchecked"}
    assert _codes([*good, *(f"{k},," for k in range(6, 14)), "14,457200,"]) == {"place_unchecked"}
    swapped = [f"{k},5428000,{457000 + 10 * k}" for k in range(6)]
    assert _codes([*swapped, "6,457060,5428000", "7,,"]) == {"swapped_axes"}
