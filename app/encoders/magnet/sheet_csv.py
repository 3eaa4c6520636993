"""Drilling sheet -> CSV: one row a hole."""

from __future__ import annotations

import io

from app.encoders.magnet.sheet import DrillingSheet
from app.formats.spreadsheet import TableWriter

COLUMNS = (
    "layout", "code", "meaning", "hole", "chainage_m", "offset_m", "from_first_m", "from_previous_m", "lon_deg",
    "lat_deg", "east_m", "north_m", "polarity", "phi_deg", "north_pole", "north_pole_bearing_deg",
)  # fmt: skip


def write_sheet_csv(sheet: DrillingSheet) -> bytes:
    """Write the holes as rows in UTF-8, with a header.

    Positions are WGS 84 to 0.1 mm; east and north are from the line's first point; from_first_m is along the tag or
    the line, from_previous_m straight. Texts that a spreadsheet would take for a formula begin with an apostrophe.
    """
    layout = sheet.layout
    meaning = layout.meaning.text if layout.meaning else ""
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row(COLUMNS)
    for hole, gap_m in zip(layout.holes, [0.0, *layout.gaps_m], strict=True):
        bearing = hole.north_pole_bearing_deg
        writer.write_row(
            [
                *(layout.name, layout.tag.text, meaning),
                hole.number,
                *(fixed(v, 4) for v in (hole.chainage_m, hole.offset_m, hole.along_m, gap_m)),
                *(fixed(v, 9) for v in (hole.lon_deg, hole.lat_deg)),
                *(fixed(v, 4) for v in (hole.east_m, hole.north_m)),
                hole.polarity.value,
                hole.orientation.phi_deg,
                hole.north_pole,
                "" if bearing is None else fixed(bearing % 360.0, 3),
            ]
        )
    return stream.getvalue().encode()


def fixed(value: float, decimals: int) -> str:
    """A number with so many decimals, without a negative zero."""
    text = f"{value:.{decimals}f}"
    return text[1:] if float(text) == 0 and text.startswith("-") else text
