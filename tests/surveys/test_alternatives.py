"""Other readings of coordinates that lie in the wrong place."""

from __future__ import annotations

import pytest

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.surveys.georeference import list_alternatives

AREA = (8.3, 48.9, 8.6, 49.1)


@pytest.mark.parametrize(
    ("row", "code", "proposal"),
    [
        ("{n},32{e}", "swapped_axes", "swap the columns"),
        ("{n},{e}", "swapped_axes", "swap the columns"),
        ("456.850,5428.180", "wrong_unit", "declare unit"),
        ("456850000,5428180000", "wrong_unit", "millimetres"),
    ],
)
def test_the_reading_that_fits_is_found(row: str, code: str, proposal: str) -> None:
    rows = "".join(f"P{k},{row.format(e=456850.0 + k, n=5428180.0)}\n" for k in range(3))
    declaration = ImportDeclaration(crs="EPSG:25832")
    table = read_survey(f"point,easting,northing\n{rows}".encode(), declaration)
    west, south, east, north = AREA
    fits = [a for a in list_alternatives(table, declaration) if west < a.lon_deg < east and south < a.lat_deg < north]
    assert [alternative.code for alternative in fits] == [code]
    assert proposal in fits[0].proposal
